"""Motion of a body of parts over time: taken from a scene or from a glTF character, to be played on another scene."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..data.gltf.scene import GltfScene, read_scene
from ..errors import UserError
from .rotations import IDENTITY, conjugate, from_matrix, least_turn, multiply, rigid_fit, rotate

if TYPE_CHECKING:
    from .session import EditSession

FPS = 12.0
"""Instants per second at which a motion is sampled; playing interpolates between them."""
MAX_INSTANTS = 2000
UP = (0.0, 0.0, 1.0)
"""Up direction of motions of bodies."""


@dataclass(frozen=True)
class BodyMotion:
    """P parts at T instants, all relative to the first instant. Any units of length; up is z."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    """Row of each part's parent; -1: none."""
    joints: np.ndarray
    """[P, 3] joint with the parent at the first instant; the centre of a part without one."""
    centres: np.ndarray
    """[P, 3] centre of each part at the first instant."""
    seconds: np.ndarray
    """[T] from 0 on, ascending."""
    turns: np.ndarray
    """[T, P, 4] wxyz rotation since the first instant, in the world."""
    shifts: np.ndarray
    """[T, P, 3] displacement of each part's joint since the first instant."""
    height: float
    """Extent along z at the first instant."""

    @property
    def moves(self) -> bool:
        """Whether any part turns or moves."""
        least = 1e-6
        return bool(
            (np.ptp(self.turns, axis=0) > least).any() or (np.ptp(self.shifts, axis=0) > least * self.height).any()
        )

    def row(self, name: str) -> int:
        """Return the row of a part.

        Raises:
            UserError: there is none of that name.
        """
        if name not in self.names:
            raise UserError(f"the motion has no part {name!r}; there is {', '.join(self.names)}")
        return self.names.index(name)

    def turned(self, quat: np.ndarray) -> BodyMotion:
        """Return the same motion in axes that a rotation [4] takes the present ones to."""
        return dataclasses.replace(
            self,
            joints=rotate(quat, self.joints),
            centres=rotate(quat, self.centres),
            turns=multiply(multiply(quat, self.turns), conjugate(quat)),
            shifts=rotate(quat, self.shifts),
        )


def motion_of_session(session: EditSession, seconds: float) -> BodyMotion:
    """Take the motion of a trained scene's parts, as the film of the session's edit shows it, with its playback and
    keyframes.

    Args:
        seconds: duration of the whole film, above 0.
    """
    skeleton, times = session.skeleton, _instants(seconds)
    # A film that is played again has jumped back at its end.
    moments = session.edit.film.seconds * np.minimum(times / seconds, 1.0 - 1e-9)
    tracks = np.stack([session.node_positions(session.scene_time(at), at) for at in moments.tolist()])
    rows = {name: row for row, name in enumerate(skeleton.names)}
    turns = np.tile(IDENTITY, (len(times), len(rows), 1))
    shifts, centres = np.zeros((len(times), len(rows), 3)), np.zeros((len(rows), 3))
    joints = np.array([session.joint_of(name, session.scene_time(0.0), 0.0) for name in skeleton.names])
    for row, part in enumerate(skeleton.parts):
        nodes = list(part.nodes if len(part.nodes) > 3 else session.ring(part.nodes, 1))
        centres[row] = tracks[0, list(part.nodes)].mean(0)
        for index in range(1, len(times)):
            if np.array_equal(tracks[0, nodes], tracks[index, nodes]):
                continue  # few points that stand still fit any rotation about the line through them
            quat, before, after = rigid_fit(tracks[0, nodes], tracks[index, nodes])
            turns[index, row] = quat
            shifts[index, row] = after - before + rotate(quat, joints[row] - before) - (joints[row] - before)
    parents = tuple(-1 if part.parent is None else rows[part.parent] for part in skeleton.parts)
    up = np.array(session.scene.overview.up)
    height = float(np.ptp(tracks[0] @ up))
    motion = BodyMotion(skeleton.names, parents, joints, centres, times, turns, shifts, height)
    return motion.turned(least_turn(up, np.array(UP)))


def motion_of_gltf(path: str | Path, clip: str | None = None) -> BodyMotion:
    """Take the motion of the joints of a glTF character. Parts are its joints, with their names; z is up, and the
    figure faces -y, as in data sets made of such files.

    Args:
        clip: name of an animation; None: the first one.

    Raises:
        UserError: the file is invalid, the clip unknown, or nothing moves.
    """
    scene = read_scene(path, clip)
    if scene.clip is None or not scene.clip.end > scene.clip.start:
        raise UserError(f"{path}: holds no animation; give a file with one")
    start = scene.clip.start
    times = _instants(scene.clip.end - start)
    bones = sorted({bone.node for bone in scene.palette})
    world = np.stack([scene.world_from_gltf @ scene.nodes.world(scene.clip, start + time)[bones] for time in times])
    rotations = _rotations(world[..., :3, :3])
    relative = np.einsum("tpij,pkj->tpik", rotations, rotations[0])
    turns = from_matrix(relative.reshape(-1, 3, 3)).reshape(len(times), len(bones), 4)
    joints, parents = world[0, :, :3, 3], [_above(scene, node, bones) for node in bones]
    children = [[row for row, parent in enumerate(parents) if parent == own] for own in range(len(bones))]
    centres = np.array([joints[[own, *children[own]]].mean(0) for own in range(len(bones))])
    names = tuple(scene.nodes.nodes[node].name or f"joint-{node}" for node in bones)
    height = float(np.ptp(scene.posed(start).positions[:, 2]))
    shifts = world[..., :3, 3] - joints
    return BodyMotion(_unique(names), tuple(parents), joints, centres, times, turns, shifts, height)


def _instants(seconds: float) -> np.ndarray:
    if not 0.0 < seconds <= 3600.0:
        raise UserError(f"seconds {seconds:g}: give more than 0 and at most 3600")
    return np.linspace(0.0, seconds, min(MAX_INSTANTS, max(2, round(FPS * seconds) + 1)))


def _rotations(matrices: np.ndarray) -> np.ndarray:
    """Return the rotations nearest to matrices [..., 3, 3]."""
    U, _, Vt = np.linalg.svd(matrices)
    U[..., 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[..., None]
    return U @ Vt


def _above(scene: GltfScene, node: int, bones: list[int]) -> int:
    """Return the row of the nearest joint above a node; -1: none."""
    parent = scene.nodes.parent[node]
    while parent >= 0 and parent not in bones:
        parent = scene.nodes.parent[parent]
    return bones.index(parent) if parent >= 0 else -1


def _unique(names: tuple[str, ...]) -> tuple[str, ...]:
    found: list[str] = []
    for name in names:
        other, count = name, 2
        while other in found:
            other, count = f"{name} ({count})", count + 1
        found.append(other)
    return tuple(found)
