"""Triangles of a glTF scene and the bones that move each vertex, in one set of arrays for all meshes and primitives.

A skinned vertex follows joints, any other vertex its node. Both are rows of one palette of matrices, so that one
formula poses the whole file (``scene.GltfScene``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .file import REMEDIES, GltfFile
from .materials import Material, transformed
from .nodes import Nodes

TRIANGLES, STRIP, FAN = 4, 5, 6
DRACO = "KHR_draco_mesh_compression"


class Bone(NamedTuple):
    """A row of the palette: the matrix ``world[node] @ inverse_bind``."""

    node: int
    inverse_bind: np.ndarray
    """[4, 4]; the identity for vertices without a skin."""


class Morph(NamedTuple):
    """Morph targets of a mesh at a node."""

    node: int
    first: int
    """Index of the first vertex to which the targets apply."""
    positions: np.ndarray
    """[targets, P, 3]"""
    normals: np.ndarray
    """[targets, P, 3]; zeros if the file has none."""
    weights: np.ndarray
    """[targets], weights at rest."""


class MeshPart(NamedTuple):
    """One mesh primitive attached to one node."""

    positions: np.ndarray
    """[P, 3]"""
    normals: np.ndarray
    """[P, 3]; zeros if the file has none, so that faces are flat."""
    uv: np.ndarray
    """[P, 2]"""
    colors: np.ndarray
    """[P, 4] linear"""
    faces: np.ndarray
    """[F, 3]"""
    material: int
    bones: np.ndarray
    """[P, K] indices of rows of the palette."""
    weights: np.ndarray
    """[P, K], rows sum to 1."""
    targets: tuple[np.ndarray, np.ndarray] | None
    """Position and normal differences of the morph targets, each [targets, P, 3]."""
    node: int = 0


class Geometry(NamedTuple):
    """All triangles of a file."""

    parts: list[MeshPart]
    palette: list[Bone]
    morphs: list[Morph]
    skipped: int
    """Number of primitives that are points or lines."""


def read_geometry(file: GltfFile, nodes: Nodes, materials: list[Material]) -> Geometry:
    """Read every triangle of the scene.

    Raises:
        UserError: the scene has no triangles, or an attribute is invalid; the message names it.
    """
    parts: list[MeshPart] = []
    palette: list[Bone] = []
    morphs: list[Morph] = []
    skins: dict[int, int] = {}
    skipped = count = 0
    for index in nodes.drawn():
        node = nodes.nodes[index]
        if node.mesh is None:
            continue
        mesh = file.item("meshes", node.mesh, f"nodes[{index}].mesh")
        for number, primitive in enumerate(mesh.primitives or []):
            where = f"meshes[{node.mesh}].primitives[{number}]"
            mode = TRIANGLES if primitive.mode is None else primitive.mode
            if mode not in (TRIANGLES, STRIP, FAN):
                skipped += 1
                continue
            skin = node.skin if _attribute(primitive.attributes, "JOINTS_0") is not None else None
            if skin is None:
                first, joints = len(palette), 0
                palette.append(Bone(index, np.eye(4)))
            else:
                if skin not in skins:
                    skins[skin] = len(palette)
                    palette.extend(_skin(file, skin, f"nodes[{index}].skin"))
                first = skins[skin]
                joints = len(file.document.skins[skin].joints)
            _refuse_compressed(file, primitive, where)
            part = _part(file, primitive, mode, materials, first, joints, where)._replace(node=index)
            if part.targets is not None:
                rest = file.node_weights(index) or mesh.weights or []
                weights = np.zeros(len(part.targets[0]))
                weights[: len(rest)] = rest[: len(weights)]
                morphs.append(Morph(index, count, *part.targets, weights))
            parts.append(part)
            count += len(part.positions)
    if not sum(len(part.faces) for part in parts):
        only = f" (only {skipped} sets of points or lines)" if skipped else ""
        raise file.error("meshes", f"draw no triangles{only}; export a file with a surface")
    return Geometry(parts, palette, morphs, skipped)


def _refuse_compressed(file: GltfFile, primitive: Any, where: str) -> None:
    """Refuse a primitive that has compressed data only, though the file does not require the extension."""
    accessor = _attribute(primitive.attributes, "POSITION")
    if DRACO in (primitive.extensions or {}) and accessor is not None:
        stored = file.item("accessors", accessor, f"{where}.attributes.POSITION")
        if stored.bufferView is None and stored.sparse is None:
            raise file.error(f"{where}.extensions", f"has {DRACO}, which is not supported; {REMEDIES[DRACO]}")


def _attribute(attributes: Any, name: str) -> Any:
    return attributes.get(name) if isinstance(attributes, dict) else getattr(attributes, name, None)


def _skin(file: GltfFile, index: int, field: str) -> list[Bone]:
    skin = file.item("skins", index, field)
    joints = skin.joints or []
    for joint in joints:
        file.item("nodes", joint, f"skins[{index}].joints")
    if not joints:
        raise file.error(f"skins[{index}].joints", "is empty; export the file again")
    if skin.inverseBindMatrices is None:
        inverse = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    else:
        inverse = file.array(skin.inverseBindMatrices, f"skins[{index}].inverseBindMatrices", 16)
    if len(inverse) < len(joints):
        raise file.error(f"skins[{index}]", f"has {len(inverse)} matrices for {len(joints)} joints; export it again")
    return [Bone(joint, matrix.astype(np.float64)) for joint, matrix in zip(joints, inverse)]


def _part(
    file: GltfFile, primitive: Any, mode: int, materials: list[Material], first: int, joints: int, where: str
) -> MeshPart:
    attributes = primitive.attributes
    accessor = _attribute(attributes, "POSITION")
    if accessor is None:
        raise file.error(f"{where}.attributes.POSITION", "is missing; export the file again")
    positions = file.array(accessor, f"{where}.attributes.POSITION", 3).astype(np.float64)
    count = len(positions)

    def numbers(name: str, width: int | None, default: np.ndarray) -> np.ndarray:
        index = _attribute(attributes, name)
        if index is None:
            return default
        values = file.array(index, f"{where}.attributes.{name}", width)
        if len(values) != count:
            raise file.error(f"{where}.attributes.{name}", f"has {len(values)} rows, POSITION {count}; export it again")
        return values

    index = primitive.material
    if index is not None:
        file.item("materials", index, f"{where}.material")
    index = len(materials) - 1 if index is None else index
    material = materials[index]
    colors = numbers("COLOR_0", None, np.ones((count, 4)))
    if colors.shape[1] not in (3, 4):
        raise file.error(f"{where}.attributes.COLOR_0", "must be VEC3 or VEC4; export the file again")
    if colors.shape[1] == 3:
        colors = np.concatenate([colors, np.ones((count, 1))], axis=1)
    uv = numbers(f"TEXCOORD_{material.coordinates}", 2, np.zeros((count, 2)))
    bones, weights = _carriers(numbers, count, first, joints, file, where)
    normals = _unit_rows(numbers("NORMAL", 3, np.zeros((count, 3))))
    faces = _faces(file, primitive, mode, count, where)
    targets = _targets(file, primitive, count, where)
    used, faces = np.unique(faces, return_inverse=True)  # Primitives often share one long list of vertices.
    return MeshPart(
        positions=positions[used],
        normals=normals[used],
        uv=transformed(uv, material)[used],
        colors=colors[used].astype(np.float64),
        faces=faces.reshape(-1, 3),
        material=index,
        bones=bones[used],
        weights=weights[used],
        targets=None if targets is None else (targets[0][:, used], targets[1][:, used]),
    )


def _unit_rows(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), 0.0)


def _carriers(
    numbers: Any, count: int, first: int, joints: int, file: GltfFile, where: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return bones [P, K] and weights [P, K] that sum to 1; a vertex without weights follows its first joint."""
    if not joints:
        return np.full((count, 1), first), np.ones((count, 1))
    indices, weights = [], []
    for number in range(8):  # Sets of four; files rarely have more than two.
        none = np.zeros((count, 0))
        carriers, share = numbers(f"JOINTS_{number}", 4, none), numbers(f"WEIGHTS_{number}", 4, none)
        if carriers.shape != share.shape:
            raise file.error(f"{where}.attributes.WEIGHTS_{number}", "does not match JOINTS; export the file again")
        indices.append(carriers.astype(np.int64))
        weights.append(share.astype(np.float64))
    bones, share = np.concatenate(indices, axis=1), np.concatenate(weights, axis=1)
    bones = np.where(share > 0, bones, 0)  # Indices without weight may be out of range.
    if bones.size and (int(bones.max()) >= joints or int(bones.min()) < 0):
        raise file.error(f"{where}.attributes.JOINTS_0", f"names joint {int(bones.max())} of {joints}; export it again")
    share = share.clip(0.0)
    total = share.sum(axis=1, keepdims=True)
    share[:, 0] += np.where(total[:, 0] > 0, 0.0, 1.0)
    return bones + first, share / np.where(total > 0, total, 1.0)


def _faces(file: GltfFile, primitive: Any, mode: int, count: int, where: str) -> np.ndarray:
    """Return faces [F, 3] of triangles, strips and fans, with or without indices."""
    if primitive.indices is None:
        indices = np.arange(count)
    else:
        indices = file.array(primitive.indices, f"{where}.indices", 1)[:, 0].astype(np.int64)
    if len(indices) and int(indices.max()) >= count:
        raise file.error(f"{where}.indices", f"names vertex {int(indices.max())} of {count}; export the file again")
    if mode == TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if len(indices) < 3:
        return np.zeros((0, 3), np.int64)
    i = np.arange(len(indices) - 2)
    if mode == FAN:
        return np.stack([indices[i + 1], indices[i + 2], np.broadcast_to(indices[0], i.shape)], axis=1)
    odd = i % 2
    return np.stack([indices[i], indices[i + 1 + odd], indices[i + 2 - odd]], axis=1)


def _targets(file: GltfFile, primitive: Any, count: int, where: str) -> tuple[np.ndarray, np.ndarray] | None:
    if not primitive.targets:
        return None
    arrays = []
    for number, target in enumerate(primitive.targets):
        for name in ("POSITION", "NORMAL"):
            index, field = _attribute(target, name), f"{where}.targets[{number}].{name}"
            values = np.zeros((count, 3)) if index is None else file.array(index, field, 3).astype(np.float64)
            if len(values) != count:
                raise file.error(field, f"has {len(values)} rows, the primitive {count}; export the file again")
            arrays.append(values)
    return np.stack(arrays[0::2]), np.stack(arrays[1::2])
