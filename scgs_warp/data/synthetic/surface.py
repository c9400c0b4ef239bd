"""Moving surfaces with solid textures, as ``Raycaster`` renders them, and their simplest form: rigid parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from .solids import Vector, vertex_normals


class Material(NamedTuple):
    """Look of a part: a pattern of ``kernels/solid_textures.py`` and a highlight."""

    kind: int
    colors: tuple[Vector, Vector, Vector]
    frequency: Vector = (6.0, 6.0, 6.0)
    shine: float = 0.0
    """Strength of the highlight, 0 to 1."""
    exponent: float = 40.0
    """Exponent of the highlight: larger is sharper."""


class Surface(Protocol):
    """A closed triangle mesh with fixed faces and moving vertices."""

    rest: np.ndarray
    """[P, 3] float64 positions in the frame of the texture."""
    faces: np.ndarray
    """[F, 3] int32, counter-clockwise from outside."""
    face_part: np.ndarray
    """[F] int32, part of each face."""
    materials: tuple[Material, ...]
    """Look of each part."""

    def posed(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices and unit normals, [P, 3] float64 each, at ``time`` in [0, 1]."""
        ...


class Piece(NamedTuple):
    """A solid of one material, rigid on a bone."""

    vertices: np.ndarray
    """[P, 3] in the piece's own frame, which is also that of its texture."""
    faces: np.ndarray
    """[F, 3]"""
    material: Material
    bone: str
    to_bone: np.ndarray
    """[4, 4] rigid transform from the piece's frame to that of its bone."""


@dataclass(frozen=True)
class PartMesh:
    """All pieces as one triangle mesh; the index of a piece is its part."""

    rest: np.ndarray
    """[P, 3] float64 vertices in their piece's frame."""
    local: np.ndarray
    """[P, 3] float64 vertices in their bone's frame."""
    faces: np.ndarray
    """[F, 3] int32, counter-clockwise from outside."""
    vertex_part: np.ndarray
    """[P] int32, part of each vertex."""
    face_part: np.ndarray
    """[F] int32, part of each face."""
    normals: np.ndarray
    """[P, 3] unit, in the bone's frame."""
    materials: tuple[Material, ...]
    bones: tuple[str, ...]
    """Bone of each part."""


def merge(pieces: Sequence[Piece]) -> PartMesh:
    """Join pieces to one mesh."""
    faces, local, normals, count = [], [], [], 0
    for piece in pieces:
        turn = piece.to_bone[:3, :3]
        faces.append(piece.faces + count)
        local.append(piece.vertices @ turn.T + piece.to_bone[:3, 3])
        normals.append(vertex_normals(piece.vertices, piece.faces) @ turn.T)
        count += len(piece.vertices)
    return PartMesh(
        rest=np.concatenate([piece.vertices for piece in pieces]),
        local=np.concatenate(local),
        faces=np.concatenate(faces).astype(np.int32),
        vertex_part=np.repeat(np.arange(len(pieces), dtype=np.int32), [len(piece.vertices) for piece in pieces]),
        face_part=np.repeat(np.arange(len(pieces), dtype=np.int32), [len(piece.faces) for piece in pieces]),
        normals=np.concatenate(normals),
        materials=tuple(piece.material for piece in pieces),
        bones=tuple(piece.bone for piece in pieces),
    )


class RigidParts:
    """A ``Surface`` of rigid parts, posed by the transforms of its bones."""

    def __init__(self, mesh: PartMesh, bone_transforms: Callable[[float], dict[str, np.ndarray]]) -> None:
        """
        Args:
            bone_transforms: returns bone-to-world [4, 4] of every bone at a time in [0, 1].
        """
        self.mesh = mesh
        self.rest, self.faces, self.face_part = mesh.rest, mesh.faces, mesh.face_part
        self.materials = mesh.materials
        self.bone_transforms = bone_transforms

    def part_transforms(self, time: float) -> np.ndarray:
        """Return bone-to-world [parts, 4, 4] of each part."""
        transforms = self.bone_transforms(time)
        return np.stack([transforms[bone] for bone in self.mesh.bones])

    def posed(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices and unit normals, [P, 3] float64 each, at ``time`` in [0, 1]."""
        transforms = self.part_transforms(time)[self.mesh.vertex_part]
        vertices = np.einsum("pij,pj->pi", transforms[:, :3, :3], self.mesh.local) + transforms[:, :3, 3]
        return vertices, np.einsum("pij,pj->pi", transforms[:, :3, :3], self.mesh.normals)


def placed(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: np.ndarray | None = None) -> np.ndarray:
    """Return the rigid transform [4, 4] that turns by ``turn`` [3, 3], then moves to (x, y, z)."""
    matrix = np.eye(4)
    if turn is not None:
        matrix[:3, :3] = turn
    matrix[:3, 3] = x, y, z
    return matrix


class DeformedParts:
    """A ``Surface`` whose vertices move by any function of their position and of time."""

    def __init__(self, mesh: PartMesh, deform: Callable[[np.ndarray, float], np.ndarray]) -> None:
        """
        Args:
            deform: returns world positions [P, 3] of the vertices ``mesh.local`` [P, 3] at a time in [0, 1].
        """
        self.mesh = mesh
        self.rest, self.faces, self.face_part = mesh.rest, mesh.faces, mesh.face_part
        self.materials = mesh.materials
        self.deform = deform

    def posed(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices and unit normals, [P, 3] float64 each, at ``time`` in [0, 1]."""
        vertices = self.deform(self.mesh.local, time)
        return vertices, vertex_normals(vertices, self.faces)


class JoinedSurfaces:
    """Several surfaces as one."""

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self.surfaces = surfaces
        vertices = np.cumsum([0, *(len(surface.rest) for surface in surfaces)])
        parts = np.cumsum([0, *(len(surface.materials) for surface in surfaces)])
        self.rest = np.concatenate([surface.rest for surface in surfaces])
        self.faces = np.concatenate(
            [surface.faces + first for surface, first in zip(surfaces, vertices.tolist())]
        ).astype(np.int32)
        self.face_part = np.concatenate(
            [surface.face_part + first for surface, first in zip(surfaces, parts.tolist())]
        ).astype(np.int32)
        self.materials = tuple(material for surface in surfaces for material in surface.materials)

    def posed(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices and unit normals, [P, 3] float64 each, at ``time`` in [0, 1]."""
        posed = [surface.posed(time) for surface in self.surfaces]
        return np.concatenate([vertices for vertices, _ in posed]), np.concatenate([normals for _, normals in posed])
