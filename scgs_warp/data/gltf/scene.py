"""Moving triangle mesh of a glTF file: ``read_scene``, then ``GltfScene.posed`` at any instant. All values are
float64."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .animation import Clip, choose_clip, interpolate, read_clips
from .file import GltfFile
from .geometry import Bone, MeshPart, Morph, read_geometry
from .materials import Material, Texture, read_materials
from .nodes import Nodes

MOMENTS = 16
"""Number of moments at which a node is looked for that has an extent."""
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Rotation from glTF (y up, a figure faces +z) to this package's worlds (z up, the figure faces -y)."""


class Triangles(NamedTuple):
    """The parts of a mesh that do not change with time: faces, materials, texture coordinates and colours."""

    faces: np.ndarray
    """[F, 3] int32"""
    material: np.ndarray
    """[F] int32, index of the material."""
    uv: np.ndarray
    """[P, 2]"""
    colors: np.ndarray
    """[P, 4] linear"""


class Vertices(NamedTuple):
    """The mesh at an instant."""

    positions: np.ndarray
    """[P, 3]"""
    normals: np.ndarray
    """[P, 3] unit; zeros for flat faces."""


@dataclass
class GltfScene:
    """Meshes, materials and motion of one clip of a file."""

    path: Path
    clips: list[Clip]
    clip: Clip | None
    """The chosen clip; None if the file has no animation."""
    nodes: Nodes
    parts: list[MeshPart]
    palette: list[Bone]
    morphs: list[Morph]
    materials: list[Material]
    """Materials; the last one is for primitives without a material."""
    textures: list[Texture]
    triangles: Triangles
    skipped: int
    """Number of primitives that are points or lines, which are not drawn."""
    digest: str
    """SHA-256 of the file and its resources."""
    world_from_gltf: np.ndarray
    """[4, 4] transform applied to everything; it is ``UPRIGHT`` until the scene is fitted into a room."""

    def palette_at(self, seconds: float) -> np.ndarray:
        """Return the matrices [B, 4, 4] that move the vertices of each bone.

        A matrix is ``world(joint) @ inverse_bind``; the transform of a skinned mesh's node is ignored (glTF 2.0,
        3.7.3.3).
        """
        world = self.nodes.world(self.clip, seconds)
        return np.stack([self.world_from_gltf @ world[bone.node] @ bone.inverse_bind for bone in self.palette])

    def posed(self, seconds: float) -> Vertices:
        """Pose all vertices at an instant of the clip by linear blend skinning."""
        matrices = self.palette_at(seconds)
        rest, normals = self._morphed(seconds)
        blended = np.zeros((len(rest), 4, 4))
        start = 0
        for part in self.parts:
            rows = slice(start, start + len(part.positions))
            for k in range(part.bones.shape[1]):
                blended[rows] += part.weights[:, k, None, None] * matrices[part.bones[:, k]]
            start = rows.stop
        linear = blended[:, :3, :3]
        positions = np.einsum("pij,pj->pi", linear, rest) + blended[:, :3, 3]
        return Vertices(positions, _transformed_normals(normals, linear))

    def _morphed(self, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Add the morph targets, weighted for the instant, to the rest positions and normals [P, 3]."""
        rest = np.concatenate([part.positions for part in self.parts])
        normals = np.concatenate([part.normals for part in self.parts])
        curves = {c.node: c.sampler for c in (self.clip.channels if self.clip else []) if c.path == "weights"}
        for morph in self.morphs:
            weights = morph.weights
            if morph.node in curves:
                values = interpolate(curves[morph.node], seconds)
                weights = np.zeros(len(weights))
                weights[: len(values)] = values[: len(weights)]
            rows = slice(morph.first, morph.first + morph.positions.shape[1])
            rest[rows] += np.tensordot(weights, morph.positions, axes=1)
            normals[rows] += np.tensordot(weights, morph.normals, axes=1)
        return rest, normals


def _transformed_normals(normals: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Transform normals by linear maps [P, 3, 3] to unit normals [P, 3]; uses cofactors, so singular maps are
    allowed."""
    a, b, c = linear[:, 0], linear[:, 1], linear[:, 2]
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    sign = np.where(np.einsum("pi,pi->p", a, cofactors[:, 0]) < 0, -1.0, 1.0)
    turned = np.einsum("pij,pj->pi", cofactors, normals) * sign[:, None]
    length = np.linalg.norm(turned, axis=1, keepdims=True)
    return np.where(length > 1e-30, turned / np.maximum(length, 1e-30), 0.0)


def read_scene(path: str | Path, clip: str | None = None) -> GltfScene:
    """Read a file and choose a clip.

    Args:
        path: .glb or .gltf.
        clip: name of an animation; None: the first one that moves something.

    Raises:
        UserError: the file is invalid, or the clip unknown; one line names the field and the remedy, or the clips.
    """
    file = GltfFile(path)
    clips = read_clips(file)
    chosen = choose_clip(file, clips, clip)
    nodes = Nodes(file)
    if chosen is not None:
        nodes.check_clip(chosen)
    materials, textures = read_materials(file)
    geometry = read_geometry(file, nodes, materials)
    scene = GltfScene(
        path=file.path,
        clips=clips,
        clip=chosen,
        nodes=nodes,
        parts=geometry.parts,
        palette=geometry.palette,
        morphs=geometry.morphs,
        materials=materials,
        textures=textures,
        triangles=_triangles(geometry.parts),
        skipped=geometry.skipped,
        digest=file.digest,
        world_from_gltf=UPRIGHT,
    )
    _face_outward(scene)
    return scene


def _triangles(parts: list[MeshPart]) -> Triangles:
    faces, material, count = [], [], 0
    for part in parts:
        faces.append(part.faces + count)
        material.append(np.full(len(part.faces), part.material))
        count += len(part.positions)
    return Triangles(
        np.concatenate(faces).astype(np.int32),
        np.concatenate(material).astype(np.int32),
        np.concatenate([part.uv for part in parts]),
        np.concatenate([part.colors for part in parts]),
    )


def _face_outward(scene: GltfScene) -> None:
    """Reverse the triangles of mirrored nodes, because the specification inverts their winding order (glTF 2.0, 3.7.4),
    also that of skinned meshes. A node counts as it is when it first has an extent."""
    start, clip = 0, scene.clip
    seconds = np.linspace(clip.start, clip.end, MOMENTS) if clip else np.zeros(1)
    mirrors = np.zeros(len(scene.nodes.nodes))
    for second in seconds:
        found = np.linalg.det(scene.nodes.world(clip, float(second))[:, :3, :3])
        mirrors = np.where(mirrors == 0.0, found, mirrors)
        if mirrors.all():
            break
    for part in scene.parts:
        rows = slice(start, start + len(part.faces))
        if mirrors[part.node] < 0:
            scene.triangles.faces[rows] = scene.triangles.faces[rows, ::-1]
        start = rows.stop
