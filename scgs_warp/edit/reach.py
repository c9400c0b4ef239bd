"""Inverse kinematics: the least turns of a chain of joints that take a point to a place."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ..kernels import inverse_kinematics as kernels
from ..runtime.launch import launch
from .part_pose import Rigid
from .rotations import multiply, rotate, to_matrix

BEND = 100.0
"""Cost of a turn of an inner joint, relative to a swing of the first one: a limb swings as a whole, and its inner
joints bend as far as the distance of the place requires."""
TWIST = 1000.0
"""Cost of a twist of the first joint about the line to the last one, likewise: the place of a hand leaves it open, and
the least turn from hand to hand would roll the upper arm."""
SLIDE = 3000.0
"""Cost of a squared shift of the first joint, in lengths of the chain, likewise. A nearly straight limb bends a lot for
a small change of distance, so that a joint beside its true place would bend the elbow of an arm that only swings. The
shoulder gives way a little instead. With less than 10 times ``BEND``, it slides where the elbow should bend."""
OFF_AXIS = 4.0
"""Cost of a turn across the axis about which the motion turned an inner joint, relative to a turn about it: a knee
bends forwards."""
PULL = 1e6
"""Weight of the squared distance from the place, in lengths of the chain, relative to squared angles of a swing."""
STEPS = 6
"""Number of places on the way to the wanted one, which keep the solution from turning inside out."""
STEP_ITERATIONS = 4
FINAL_ITERATIONS = 40
LONGEST_TURN = 0.5
"""Largest turn of a joint in one iteration, radians."""
TOLERANCE = 1e-6
"""Turn in one iteration below which iterations stop, radians."""


class Reached(NamedTuple):
    """Pose of a chain."""

    turns: list[np.ndarray]
    """Quaternions [4], one for each link."""
    shift: np.ndarray
    """[3] displacement of the first joint."""


class Link(NamedTuple):
    """Joint of a chain in the unturned pose at one instant, normalised units."""

    joint: np.ndarray
    """[3]"""
    quat: np.ndarray
    """[4] present turn relative to the parent, in the frame of the unturned pose."""
    shift: np.ndarray
    """[3] present displacement relative to the parent."""
    axis: np.ndarray | None
    """[3] unit direction about which the motion turned the joint most, in that frame; None: any direction alike."""


def reach(links: list[Link], base: Rigid, grip: np.ndarray, place: np.ndarray) -> Reached:
    """Return the pose of a chain that takes a point to a place, or as near as the chain reaches.

    Among the poses that reach it, the one that differs least from the present one is taken: the sum of squared angles
    is least, where angles of inner joints count ``BEND`` times, those across known axes ``OFF_AXIS`` times as much, a
    twist of the first joint ``TWIST`` times, and its shift ``SLIDE`` times. The result depends on the arguments alone.

    Args:
        links: joints from the base to the end.
        base: motion of the part that carries the first joint.
        grip: [3] point of the last part in its unturned pose.
        place: [3] where it goes.
    """
    pose = Reached([link.quat for link in links], links[0].shift)
    points, now = posed_chain(links, pose, base, grip)
    centre, here = points[0], now - points[0]
    length = max(sum(float(np.linalg.norm(b - a)) for a, b in pairwise(points)), 1e-12)
    there = (place - centre) * min(1.0, length / max(float(np.linalg.norm(place - centre)), 1e-300))
    costs = [_swing_cost(links), *(BEND * _cost(link.axis) for link in links[1:])]
    aims = [centre + _between(here, there, step / STEPS) for step in range(1, STEPS + 1)]
    turns, shift = _solve(links, costs, base, grip, aims, length)
    return Reached(list(multiply(turns, np.array(pose.turns))), pose.shift + shift)


def _cost(axis: np.ndarray | None) -> np.ndarray:
    """Return the quadratic form [3, 3] of a rotation vector's cost."""
    return np.eye(3) if axis is None else OFF_AXIS * np.eye(3) - (OFF_AXIS - 1.0) * np.outer(axis, axis)


def _swing_cost(links: list[Link]) -> np.ndarray:
    """Return the quadratic form [3, 3] of the first joint's cost: a twist about the line to the last joint costs
    ``TWIST`` times more than a swing. A chain of one joint has no such line."""
    bone = rotate(links[0].quat, links[-1].joint - links[0].joint)
    length2 = float(bone @ bone)
    return np.eye(3) if length2 < 1e-18 else np.eye(3) + (TWIST - 1.0) * np.outer(bone, bone) / length2


def posed_chain(links: list[Link], pose: Reached, base: Rigid, grip: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the posed joints with the point at their end, [C + 1, 3], and that point."""
    motion, points = base, []
    for row, (link, turn) in enumerate(zip(links, pose.turns)):
        joint = link.joint + (link.shift if row else pose.shift)
        points.append(motion.apply(joint))
        motion = motion.after(Rigid(turn, joint - rotate(turn, link.joint)))
    end = motion.apply(grip)
    return np.array([*points, end]), end


def _solve(
    links: list[Link], costs: list[np.ndarray], base: Rigid, grip: np.ndarray, aims: list[np.ndarray], length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the turns [C, 4] and the shift [3] since the present pose that minimise their cost plus the pull."""

    def tensor(values: ArrayLike) -> Tensor:
        return torch.from_numpy(np.array(values, np.float64))

    count = len(links)
    present = to_matrix(np.array([link.quat for link in links]))
    inputs = (
        *(tensor([link.joint for link in links]), tensor([link.shift for link in links])),
        *(tensor(present), tensor(costs), tensor([to_matrix(base.quat)]), tensor([base.shift, grip]), tensor(aims)),
        torch.tensor([STEP_ITERATIONS] * (len(aims) - 1) + [FINAL_ITERATIONS], dtype=torch.int32),
        *(PULL / length**2, SLIDE / length**2, LONGEST_TURN, TOLERANCE),
    )
    scratch = torch.empty(count, 3, 3, dtype=torch.float64), torch.empty(count, 3, dtype=torch.float64)
    turns, shift = tensor([[0.0, 0.0, 0.0, 1.0]] * count), tensor([[0.0] * 3])
    launch(kernels.reach_place, 1, *inputs, *scratch, turns, shift)
    return turns.numpy()[:, [3, 0, 1, 2]], shift.numpy()[0]


def _between(here: np.ndarray, there: np.ndarray, share: float) -> np.ndarray:
    """Return a vector between two, turned and lengthened evenly."""
    near, far = float(np.linalg.norm(here)), float(np.linalg.norm(there))
    if share == 1.0 or min(near, far) < 1e-12:
        return here + share * (there - here)
    a, b = here / near, there / far
    angle = float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
    across = b - (a @ b) * a
    size = float(np.linalg.norm(across))
    if size < 1e-9:
        return here + share * (there - here)
    return (near + share * (far - near)) * (np.cos(share * angle) * a + np.sin(share * angle) * across / size)
