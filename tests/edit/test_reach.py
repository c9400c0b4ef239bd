"""Inverse kinematics of a chain of joints: what a pull costs, and what it bends."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from scgs_warp.edit.part_pose import Rigid
from scgs_warp.edit.reach import BEND, OFF_AXIS, SLIDE, TWIST, Link, Reached, posed_chain, reach
from scgs_warp.edit.rotations import IDENTITY, conjugate, exponential, from_axis, logarithm, multiply, rotate


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_pull_costs_no_more_than_a_general_minimiser_finds(seed):
    random = np.random.default_rng(seed)
    joints = np.cumsum(np.vstack([np.zeros(3), random.normal(size=(2, 3)) * 0.2 + [0.4, 0, 0]]), 0)
    grip = joints[-1] + [0.3, 0.1, 0.0]
    axis = np.array([0.0, 0.0, 1.0])
    links = [
        Link(joint, exponential(0.2 * random.normal(size=3)), np.zeros(3), a)
        for joint, a in zip(joints, (axis, axis, None))
    ]
    base = Rigid(exponential(0.5 * random.normal(size=3)), random.normal(size=3))
    points, now = posed_chain(links, Reached([link.quat for link in links], np.zeros(3)), base, grip)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    place = points[0] + rotate(exponential(random.normal(size=3) * 0.7), 0.85 * (now - points[0]))
    ours = reach(links, base, grip, place)
    assert np.linalg.norm(posed_chain(links, ours, base, grip)[1] - place) < 4e-3

    bone = rotate(links[0].quat, joints[2] - joints[0])
    bone /= np.linalg.norm(bone)

    def cost(vector: np.ndarray) -> float:
        total = SLIDE * float(vector[:3] @ vector[:3]) / length**2 + (TWIST - 1.0) * float(vector[3:6] @ bone) ** 2
        for row, (link, turn) in enumerate(zip(links, vector[3:].reshape(-1, 3))):
            off = np.zeros(3) if link.axis is None or not row else turn - (turn @ link.axis) * link.axis
            total += (turn @ turn + (OFF_AXIS - 1.0) * off @ off) * (BEND if row else 1.0)
        return total

    def end(vector: np.ndarray) -> np.ndarray:
        turns = [multiply(exponential(v), link.quat) for v, link in zip(vector[3:].reshape(-1, 3), links)]
        return posed_chain(links, Reached(turns, vector[:3]), base, grip)[1] - place

    turned = [logarithm(multiply(turn, conjugate(link.quat))) for turn, link in zip(ours.turns, links)]
    found = minimize(
        cost, np.zeros(12), constraints={"type": "eq", "fun": end}, method="SLSQP", options={"maxiter": 500}
    )
    assert found.success
    assert cost(np.concatenate([ours.shift, *turned])) < 1.001 * found.fun + 1e-6


def test_a_chain_that_is_too_short_points_to_the_place():
    links = [Link(np.array([x, 0.0, 0.0]), IDENTITY, np.zeros(3), None) for x in (0.0, 1.0)]
    grip = np.array([2.0, 0.0, 0.0])
    end = posed_chain(links, reach(links, Rigid.none(), grip, np.array([0.0, 9.0, 0.0])), Rigid.none(), grip)[1]
    np.testing.assert_allclose(end, [0.0, 2.0, 0.0], atol=0.01)


def test_a_joint_beside_its_place_does_not_bend_a_swinging_limb():
    """An arm of two links swings by 90 degrees about a point 3 % of its length beside the first joint."""
    links = [Link(np.array([x, 0.0, 0.0]), IDENTITY, np.zeros(3), None) for x in (0.0, 1.0)]
    grip, true = np.array([2.0, 0.0, 0.0]), np.array([-0.04, 0.04, 0.0])
    place = rotate(from_axis((0, 0, 1), 90), grip - true) + true
    found = reach(links, Rigid.none(), grip, place)
    bent = np.degrees(np.linalg.norm(logarithm(np.array(found.turns)), axis=1))
    assert bent[0] == pytest.approx(90, abs=3) and bent[1] < 5
    assert np.linalg.norm(found.shift) < 0.1


@pytest.mark.parametrize("bent", [30, 60])
def test_a_place_near_the_first_joint_bends_the_elbow(bent):
    """The shoulder does not slide instead."""
    elbow = from_axis((0, 1, 0), -bent)
    links = [Link(np.array([x, 0.0, 0.0]), turn, np.zeros(3), None) for x, turn in ((0.0, IDENTITY), (1.0, elbow))]
    grip = np.array([2.0, 0.0, 0.0])
    end = posed_chain(links, Reached([IDENTITY, elbow], np.zeros(3)), Rigid.none(), grip)[1]
    found = reach(links, Rigid.none(), grip, 0.7 * end)
    further = np.degrees(np.linalg.norm(logarithm(multiply(found.turns[1], conjugate(elbow)))))
    assert further > 30 and np.linalg.norm(found.shift) < 0.2, "a tenth of the limb's length"


@pytest.mark.parametrize("degrees", [45, 90, 135])
def test_a_swing_does_not_roll_a_bent_limb(degrees):
    """The hand of an arm whose elbow is bent goes where a swing across the upper arm takes it. The least turn from hand
    to hand would roll the upper arm by a share of that angle."""
    links = [
        Link(np.array([x, 0.0, 0.0]), IDENTITY, np.zeros(3), axis)
        for x, axis in ((0.0, None), (1.0, np.array([0.0, 1.0, 0.0])))
    ]
    grip, swing = np.array([1.8, 0.0, 0.6]), from_axis((0, 0, 1), degrees)
    found = reach(links, Rigid.none(), grip, rotate(swing, grip))
    off = np.degrees(np.linalg.norm(logarithm(multiply(found.turns[0], conjugate(swing)))))
    assert off < 0.05 * degrees and np.degrees(np.linalg.norm(logarithm(found.turns[1]))) < 0.1 * degrees
