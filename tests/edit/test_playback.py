"""A motion played differently, and keyframes between keyframes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import Edit, EditSession, Exaggerate, Hold, Keyframe, Playback, Target
from scgs_warp.edit.keyframes import targets_at
from scgs_warp.edit.rotations import angle, conjugate, from_axis, from_matrix, mean, multiply, power, rigid_fit, rotate

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
    ("playback", "times"),
    [
        (Playback(), [0.0, 0.25, 0.5, 1.0, 1.0]),
        (Playback(speed=0.5), [0.0, 0.125, 0.25, 0.5, 0.75]),
        (Playback(speed=-1.0), [1.0, 0.75, 0.5, 0.0, 0.0]),
        (Playback(seconds=2.0, repeat="loop"), [0.0, 0.5, 0.0, 0.0, 0.0]),
        (Playback(seconds=2.0, repeat="swing"), [0.0, 0.5, 1.0, 0.0, 1.0]),
        (Playback(freeze=0.3), [0.3] * 5),
        (Playback(start=0.5, seconds=4.0), [0.5, 0.75, 1.0, 1.0, 1.0]),
        (Playback(map=((0.0, 0.2), (2.0, 0.8), (4.0, 0.4))), [0.2, 0.5, 0.8, 0.4, 0.4]),
    ],
)
def test_playback(playback, times):
    found = [playback.time_at(moment, 4.0) for moment in (0.0, 1.0, 2.0, 4.0, 6.0)]
    assert found == pytest.approx(times)


def test_a_held_region_keeps_its_pose_while_the_rest_moves():
    scene = bar_scene()
    session = EditSession(scene)
    x = session.node_positions(0.0)[:, 0]
    right = tuple(np.flatnonzero(x > np.quantile(x, 0.75)).tolist())
    left = np.flatnonzero(x < np.quantile(x, 0.3))
    session.apply(Edit(holds=(Hold(right, 0.0, "world"),)))
    start = session.engine.to_world(session.engine.motion_at(0.0).positions)
    moved = session.engine.to_world(session.engine.motion_at(1.0).positions)
    assert np.abs(moved - start)[list(right)].max() > 0.2
    found = session.node_positions(1.0)
    np.testing.assert_allclose(found[list(right)], start[list(right)], atol=1e-9)
    np.testing.assert_array_equal(found[left], moved[left])
    assert torch.equal(session.gaussians_at(0.0).means, scene.gaussians_at(0.0).means), "at its own time it is no edit"
    # Gaussians that hang on held control points alone look as they did: same place, same shape, same colours
    own = torch.isin(session.engine.binding[0].long(), torch.tensor(right)).all(1)
    before, after = scene.gaussians_at(0.0), session.gaussians_at(1.0)
    torch.testing.assert_close(after.means[own], before.means[own], rtol=0, atol=1e-5)
    torch.testing.assert_close(after.quats[own].abs(), before.quats[own].abs(), rtol=0, atol=1e-5)
    torch.testing.assert_close(after.sh_rest[own], before.sh_rest[own], rtol=0, atol=1e-5)
    session.apply(Edit(holds=(Hold(right, 0.0, "body"),)))
    body = session.node_positions(1.0)
    assert np.abs(body - moved)[list(right)].max() > 0.01, "it does not bend on"
    assert np.abs(body - start)[list(right)].max() > 0.2, "it goes along with what it hangs on"
    lengths = [np.linalg.norm(p[list(right)] - p[right[0]], axis=1) for p in (start, body)]
    np.testing.assert_allclose(lengths[1], lengths[0], atol=1e-9)


def test_exaggeration_turns_further_and_keeps_lengths():
    scene = bar_scene()
    session = EditSession(scene)
    start = session.engine.to_world(session.engine.motion_at(0.0).positions)
    centre = np.array([0.5, -1.0, 0.25])
    far = np.flatnonzero(start[:, 0] > 0.9)

    def swing(factor: float, about: float | None = 0.0) -> float:
        session.apply(Edit(exaggerate=Exaggerate(factor, about)))
        moved = session.node_positions(1.0)[far] - centre
        return float(np.degrees(np.median(np.arctan2(-moved[:, 2], moved[:, 0]))))

    assert swing(1.5) == pytest.approx(90.0, abs=8.0)
    assert swing(0.5) == pytest.approx(30.0, abs=5.0)
    edges = session.graph.edges
    lengths = [np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1) for p in (start, session.node_positions(1.0))]
    assert np.percentile(np.abs(lengths[1] / lengths[0] - 1), 95) < 0.25
    session.apply(Edit(exaggerate=Exaggerate(1.0)))
    assert torch.equal(session.gaussians_at(1.0).means, scene.gaussians_at(1.0).means)
    session.apply(Edit(exaggerate=Exaggerate(2.0, None, tuple(far.tolist()))))
    others = np.setdiff1d(np.arange(len(session)), far)
    moved = session.engine.to_world(session.engine.motion_at(1.0).positions)
    np.testing.assert_array_equal(session.node_positions(1.0)[others], moved[others])


def test_edits_compose_with_holds_and_exaggeration():
    session = EditSession(bar_scene())
    x = session.node_positions(0.0)[:, 0]
    right = np.flatnonzero(x > np.quantile(x, 0.8))
    session.apply(Edit(exaggerate=Exaggerate(1.5, 0.0), holds=(Hold((0, 1), 0.5),)))
    base = session.node_positions(0.7)
    session.add_handle(right, 0.7, "right")
    np.testing.assert_array_equal(session.node_positions(0.7), base)
    session.move("right", [0.0, 0.3, 0.0])
    np.testing.assert_allclose(session.node_positions(0.7)[right], base[right] + [0, 0.3, 0], atol=1e-9)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**31), st.integers(0, 100))
def test_rotation_algebra(seed, percent):
    random = np.random.default_rng(seed)
    a, b = (from_axis(random.normal(size=3), random.uniform(-179, 179)) for _ in range(2))
    assert power(a, 0.0)[0] == 1.0 and np.array_equal(power(a, 1.0), a)
    part = multiply(power(a, percent / 100), power(a, 1 - percent / 100))
    np.testing.assert_allclose(abs(part @ a), 1.0, atol=1e-12)
    np.testing.assert_allclose(multiply(multiply(a, b), conjugate(b)), a, atol=1e-12)
    points = random.normal(size=(6, 3))
    quat, before, after = rigid_fit(points, rotate(a, points) + b[:3])
    assert abs(quat @ a) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(rotate(quat, points - before) + after, rotate(a, points) + b[:3], atol=1e-9)
    np.testing.assert_allclose(np.abs(mean(np.stack([a, -a])[:, None]) @ a), 1.0, atol=1e-12)
    assert from_matrix(np.eye(3)).tolist() == [1.0, 0.0, 0.0, 0.0]
