"""Interpolation between keyframes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import EditSession, Keyframe, Target
from scgs_warp.edit.keyframes import targets_at
from scgs_warp.edit.rotations import angle, from_axis
from scgs_warp.errors import UserError

FRAMES = (
    Keyframe(0.0, {"a": Target()}),
    Keyframe(1.0, {"a": Target((1.0, 0.0, 0.0), tuple(from_axis([0, 0, 1], 90).tolist()))}),
    Keyframe(3.0, {"a": Target((1.0, 2.0, 0.0), tuple(from_axis([0, 0, 1], 170).tolist()))}),
)


def at(frames, moment: float) -> Target:
    return targets_at(frames, moment)["a"]


@pytest.mark.parametrize("easing", ["smooth", "linear", "ease", "step"])
def test_keyframes_are_met_and_ends_hold(easing):
    frames = [dataclasses.replace(frame, easing=easing) for frame in FRAMES]
    for frame in frames:
        assert at(frames, frame.at) == frame.targets["a"]
    assert at(frames, -1.0) == at(frames, 0.0) and at(frames, 9.0) == at(frames, 3.0)
    if easing == "step":
        assert at(frames, 0.999) == at(frames, 0.0)
    else:
        turned = [float(np.degrees(angle(np.array(at(frames, t).rotation)))) for t in (0.25, 0.5, 0.75, 2.0)]
        assert 0 < turned[0] < turned[1] < turned[2] < 90 < turned[3] < 170
    if easing == "linear":
        assert turned[1] == pytest.approx(45.0) and at(frames, 2.0).translation == pytest.approx((1.0, 1.0, 0.0))
    if easing == "ease":
        assert at(frames, 0.001).translation[0] < 1e-6


def test_smooth_keyframes_neither_stop_nor_overshoot():
    moments = np.linspace(0, 3, 601)
    shifts = np.array([at(FRAMES, float(t)).translation for t in moments])
    turned = np.array([np.degrees(angle(np.array(at(FRAMES, float(t)).rotation))) for t in moments])
    assert shifts.min() >= 0 and shifts[:, 0].max() <= 1 + 1e-12 and shifts[:, 1].max() <= 2 + 1e-12
    speed = np.diff(turned) / np.diff(moments)
    assert speed.min() > -1e-6 and speed[198:203].min() > 10, "it does not stop at the middle keyframe"
    assert np.abs(np.diff(speed)).max() < 3.0, "no jolt"
    assert turned.max() <= 170 + 1e-6


def test_a_limb_between_keyframes_turns_and_keeps_its_length():
    session = EditSession(bar_scene())
    x = session.node_positions(0.0)[:, 0]
    session.add_handle(np.flatnonzero(x > np.quantile(x, 0.6)), 0.0, "a", pivot=(0.6, -1.0, 0.25))
    session.pin(np.flatnonzero(x < np.quantile(x, 0.4)))
    session.add_keyframe(0.0)
    session.move("a", None, from_axis([0, 0, 1], 120))
    session.add_keyframe(1.0)
    nodes = list(session.edit.handles[0].nodes)
    rest = session.node_positions(0.0, 0.0)[nodes]
    away = [np.linalg.norm(session.node_positions(0.0, t)[nodes] - [0.6, -1.0, 0.25], axis=1) for t in (0.3, 0.5, 0.8)]
    for found in away:
        np.testing.assert_allclose(found, np.linalg.norm(rest - [0.6, -1.0, 0.25], axis=1), atol=1e-9)


def test_handles_without_a_keyframe_stay_where_they_are():
    session = EditSession(bar_scene())
    session.add_handle([1], 0.0, "a")
    session.add_handle([2], 0.0, "b")
    session.move("b", [0.5, 0, 0])
    edit = dataclasses.replace(session.edit, keyframes=(Keyframe(0.0, {"a": Target((1.0, 0.0, 0.0))}),))
    assert session.engine.targets(edit, 2.0) == {"a": Target((1.0, 0.0, 0.0)), "b": Target((0.5, 0.0, 0.0))}
    assert session.engine.targets(edit, None)["a"] == Target()


@pytest.mark.parametrize(
    ("at", "easing", "words"), [(-1.0, "smooth", "at"), (None, "smooth", "at is missing"), (0.0, "bouncy", "easing")]
)
def test_a_keyframe_refuses_fields_that_no_file_may_hold(at, easing, words):
    with pytest.raises(UserError, match=words):
        Keyframe(at, {}, easing)


def test_smooth_rotation_at_constant_speed_stays_constant():
    """Between equal steps of rotation and of translation, the curve is a straight line in time."""
    frames = [
        Keyframe(float(k), {"a": Target((1.0 * k, 0.0, 0.0), tuple(from_axis([0, 0, 1], 30 * k).tolist()))})
        for k in range(4)
    ]
    for moment in (1.0, 1.25, 1.5, 1.9):
        found = at(frames, moment)
        assert np.degrees(angle(np.array(found.rotation))) == pytest.approx(30 * moment, abs=1e-9)
        assert found.translation[0] == pytest.approx(moment, abs=1e-12)


def along(times, values) -> list[Keyframe]:
    return [Keyframe(float(t), {"a": Target((float(x), 0.0, 0.0))}) for t, x in zip(times, values)]


@pytest.mark.parametrize("turning", [0.4, 1.0, -3.0])
def test_smooth_motion_turns_back_at_the_keyframe(turning):
    frames = along((0, 1, 3), (0.0, 1.0, turning))
    shifts = np.array([at(frames, float(t)).translation[0] for t in np.linspace(0, 3, 601)])
    assert shifts.max() <= 1.0 + 1e-12 and shifts.argmax() >= 200
    assert (np.diff(shifts[:201]) >= 0).all() and (np.diff(shifts[200:]) <= 1e-15).all()


def test_smooth_motion_is_the_monotone_cubic_where_keyframes_are_uneven():
    """Against SciPy's, whose ends have another rule."""
    times, values = (0.0, 1.0, 1.5, 4.0, 4.25, 7.0), (0.0, 0.5, 2.0, 3.0, 3.2, 9.0)
    frames, reference = along(times, values), PchipInterpolator(times, values)
    for moment in np.linspace(1.0, 4.25, 40):
        assert at(frames, float(moment)).translation[0] == pytest.approx(float(reference(moment)), abs=1e-12)


def test_signs_of_quaternions_change_no_number_between_keyframes():
    """q and -q are one rotation, whichever of them a file holds."""
    quats = [from_axis([0, 0, 1], 100 * k) for k in range(4)]

    def moving(signs) -> list[Keyframe]:
        targets = [Target((0.0, 0.0, 0.0), tuple((sign * quat).tolist())) for sign, quat in zip(signs, quats)]
        return [Keyframe(float(k), {"a": target}) for k, target in enumerate(targets)]

    for moment in (0.5, 1.5, 2.3):
        found = [at(moving(signs), moment).rotation for signs in ((1, 1, 1, 1), (1, -1, 1, -1), (1, -1, -1, 1))]
        assert found[1] == pytest.approx(found[0], abs=1e-12) and found[2] == pytest.approx(found[0], abs=1e-12)
