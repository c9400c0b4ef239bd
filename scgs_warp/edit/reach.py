"""Inverse kinematics: the least turns of a chain of joints that take a point to a place."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .part_pose import Rigid
from .rotations import conjugate, exponential, logarithm, multiply, rotate, to_matrix

OFF_AXIS = 4.0
"""Cost of a turn across the axis about which the motion turned a joint, relative to a turn about it: a knee bends
forwards."""
BEND = 10.0
"""Cost of a turn of any joint but the first, relative to one of the first: a limb swings as a whole, and its inner
joints bend as far as the distance of the place requires."""
PULL = 1e5
"""Weight of the squared distance from the place, in lengths of the chain, relative to squared angles."""
STEPS = 6
"""Number of places on the way to the wanted one, which keep the solution from turning inside out."""
STEP_ITERATIONS = 4
FINAL_ITERATIONS = 40
LONGEST_TURN = 0.5
"""Largest turn of a joint in one iteration, radians."""
TOLERANCE = 1e-6
"""Turn in one iteration below which iterations stop, radians."""


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


def reach(links: list[Link], base: Rigid, grip: np.ndarray, place: np.ndarray) -> list[np.ndarray]:
    """Return the turns of all joints that take a point to a place, or as near as the chain reaches.

    Among the turns that reach it, those that differ least from the present ones are taken: the sum of squared angles is
    least, where angles of inner joints count ``BEND`` times, and those across a known axis ``OFF_AXIS`` times. The
    result depends on the arguments alone.

    Args:
        links: joints from the base to the end.
        base: motion of the part that carries the first joint.
        grip: [3] point of the last part in its unturned pose.
        place: [3] where it goes.

    Returns:
        Quaternions [4], one for each link.
    """
    turns = [link.quat for link in links]
    points, now = _posed(links, turns, base, grip)
    centre, here = points[0], now - points[0]
    length = max(sum(float(np.linalg.norm(b - a)) for a, b in pairwise(points)), 1e-12)
    there = (place - centre) * min(1.0, length / max(float(np.linalg.norm(place - centre)), 1e-300))
    costs = [_cost(link.axis) * (BEND if row else 1.0) for row, link in enumerate(links)]
    for step in range(1, STEPS + 1):
        aim = centre + _between(here, there, step / STEPS)
        most = FINAL_ITERATIONS if step == STEPS else STEP_ITERATIONS
        turns = _solve(links, turns, costs, base, grip, aim, length, most)
    return turns


def _cost(axis: np.ndarray | None) -> np.ndarray:
    """Return the quadratic form [3, 3] of a rotation vector's cost."""
    return np.eye(3) if axis is None else OFF_AXIS * np.eye(3) - (OFF_AXIS - 1.0) * np.outer(axis, axis)


def _posed(links: list[Link], turns: list[np.ndarray], base: Rigid, grip: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the posed joints with the point at their end, [C + 1, 3], and that point."""
    motion, points = base, []
    for link, turn in zip(links, turns):
        points.append(motion.apply(link.joint + link.shift))
        motion = motion.after(Rigid(turn, link.joint + link.shift - rotate(turn, link.joint)))
    end = motion.apply(grip)
    return np.array([*points, end]), end


def _solve(
    links: list[Link],
    turns: list[np.ndarray],
    costs: list[np.ndarray],
    base: Rigid,
    grip: np.ndarray,
    aim: np.ndarray,
    length: float,
    iterations: int,
) -> list[np.ndarray]:
    """Minimise the cost of the turns since the present pose plus the pull, by Gauss-Newton steps."""
    pull, turns = PULL / length**2, list(turns)
    for _ in range(iterations):
        points, end = _posed(links, turns, base, grip)
        frame, columns = base.quat, []
        for row, turn in enumerate(turns):
            arm = end - points[row]
            columns.append(_cross(-arm) @ to_matrix(frame))
            frame = multiply(frame, turn)
        J = np.concatenate(columns, axis=1)
        normal, slope = pull * J.T @ J, pull * J.T @ (end - aim)
        for row, (link, turn, cost) in enumerate(zip(links, turns, costs)):
            block = slice(3 * row, 3 * row + 3)
            normal[block, block] += cost
            slope[block] += cost @ logarithm(multiply(turn, conjugate(link.quat)))
        change = -np.linalg.solve(normal, slope).reshape(-1, 3)
        change *= min(1.0, LONGEST_TURN / max(float(np.linalg.norm(change, axis=1).max()), 1e-300))
        turns = [multiply(exponential(further), turn) for further, turn in zip(change, turns)]
        if np.abs(change).max() < TOLERANCE:
            break
    return turns


def _cross(vector: np.ndarray) -> np.ndarray:
    """Return the matrix [3, 3] of the cross product ``vector x ...``."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


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
