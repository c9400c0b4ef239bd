"""Edits beside one another: handles that do not last, control points tied to nobody, masks, frames of a film."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
import torch

from helpers.edit_scenes import OVERVIEW, bar_scene
from scgs_warp.edit import Edit, EditSession, Exaggerate, Film, Hold, Playback, film_camera
from scgs_warp.edit.document import frame_reach
from scgs_warp.edit.filming import film_frame
from scgs_warp.edit.pose import NodePose, pose_gaussians
from scgs_warp.edit.rotations import from_axis, multiply, rotate, to_matrix
from scgs_warp.formats.gaussian_ply import read_gaussian_ply
from scgs_warp.geometry import cameras
from scgs_warp.ops.harmonics_rotation import rotate_harmonics
from scgs_warp.runtime import environment
from scgs_warp.types import Gaussians, Image
from scgs_warp.visualization.figures import to_bytes

CAMERA = cameras.orbit_camera(dataclasses.replace(OVERVIEW, centre=(0.5, -1.0, 0.25), radius=2.0), 20.0, 48)
TURN = from_axis([0, 0, 1], 40).tolist()
STRAY = (2.2, 0.0, 0.0)


def same(first: Gaussians | Image, second: Gaussians | Image) -> bool:
    return all(torch.equal(a, b) for a, b in zip(dataclasses.astuple(first), dataclasses.astuple(second)))


def part(session: EditSession, low: float, high: float) -> np.ndarray:
    """Control points between two quantiles along the bar, at time 0."""
    x = session.node_positions(0.0)[:60, 0]
    return np.flatnonzero((x >= np.quantile(x, low)) & (x <= np.quantile(x, high)))


def motion(session: EditSession, time: float) -> np.ndarray:
    return session.engine.to_world(session.engine.motion_at(time).positions)


# Handles that do not last


@pytest.mark.parametrize("lasts", ["frame", "fade"])
@pytest.mark.parametrize("stiffness", [None, 0.5])
def test_handles_have_no_effect_outside_their_time(lasts, stiffness):
    """Beside another one, too: it is as if they were not there."""
    session = EditSession(bar_scene())
    session.pin(part(session, 0.0, 0.2))
    session.add_handle(part(session, 0.8, 1.0), 0.0, "end")
    session.move("end", [0.0, 0.1, 0.0], TURN)
    alone = [session.node_positions(time) for time in (0.0, 0.4, 0.69, 1.0)]
    session.add_handle(part(session, 0.45, 0.6), 0.5, "middle", lasts=lasts, window=0.18, stiffness=stiffness)
    for target in ([0.0, 0.0, 0.0], [0.0, 0.0, 0.1]):
        session.move("middle", target)
        beside = [session.node_positions(time) for time in (0.0, 0.4, 0.69, 1.0)]
        shown = [np.array_equal(a, b) for a, b in zip(alone, beside)]
        assert shown == [True, lasts == "frame", True, True]


def test_fading_handles_let_go_without_a_jump():
    session = EditSession(bar_scene())
    session.pin(part(session, 0.0, 0.2))
    session.add_handle(part(session, 0.8, 1.0), 0.0, "end")
    session.move("end", [0.0, 0.15, 0.0], TURN)
    session.add_handle(part(session, 0.45, 0.6), 0.0, "middle", lasts="fade", window=0.5)
    session.move("middle", [0.0, 0.0, 0.1])

    def jump(first: float, second: float) -> float:
        """Beyond what the motion does."""
        before, after = (session.node_positions(time) - motion(session, time) for time in (first, second))
        return float(np.abs(after - before).max())

    assert jump(0.0, 0.5) > 0.05, "it does something"
    for time in (0.0, 1e-4, 0.25, 0.49, 0.4999, 0.5 - 1e-7):
        assert jump(time, time + 2e-4) < 2e-3, time
    times = np.linspace(0.0, 0.52, 27)
    assert max(jump(a, b) for a, b in pairwise(times)) < 0.03


def test_a_fading_handle_alone_moves_its_piece_by_its_share():
    session = EditSession(bar_scene())
    session.add_handle(part(session, 0.8, 1.0), 0.0, "end", lasts="fade", window=1.0)
    session.move("end", [0.0, 0.0, 0.2], TURN)
    share = session.edit.handles[0].strength(0.4)
    assert 0.3 < share < 0.7
    base = session.engine.motion_at(0.4).positions
    bent = session.engine.bend(session.edit, 0.4)
    assert bent is not None
    lengths = [np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (base, bent.positions)]
    np.testing.assert_allclose(lengths[1], lengths[0], atol=2e-3)
    turned = np.degrees(2 * np.arccos(np.abs(bent.turns[:, 0]).clip(max=1.0)))
    np.testing.assert_allclose(turned, 40 * share, atol=0.5)


# Control points that are tied to nobody


@pytest.fixture
def straying() -> EditSession:
    session = EditSession(bar_scene(stray=STRAY))
    assert session.graph.stray[60] in part(session, 0.8, 1.0) and len(session.graph.led) == 1
    return session


def test_a_stray_that_is_pinned_or_held_stays(straying):
    right, rest = part(straying, 0.8, 1.0), motion(straying, 0.0)
    straying.add_handle(right, 0.0, "right")
    straying.move("right", [0.0, 0.1, 0.0], TURN)
    assert np.abs(straying.node_positions(0.0) - rest)[60].max() > 0.2, "left alone it goes along"
    straying.pin([60])
    np.testing.assert_array_equal(straying.node_positions(0.0)[60], rest[60])
    straying.unpin()
    straying.add_handle([60], 0.0, "stray")
    np.testing.assert_array_equal(straying.node_positions(0.0)[60], rest[60])
    straying.move("stray", [0.3, 0.0, 0.0])
    np.testing.assert_allclose(straying.node_positions(0.0)[60], rest[60] + [0.3, 0.0, 0.0], atol=1e-9)


def test_pinning_the_rest_leaves_no_stray_behind(straying):
    straying.add_handle(part(straying, 0.8, 1.0), 0.0, "right")
    straying.pin_rest(1)
    assert 60 not in straying.edit.pins and len(straying.edit.pins) > 20
    straying.reset()
    straying.add_handle(part(straying, 0.0, 0.2), 0.0, "left")
    straying.pin_rest(1)
    assert 60 in straying.edit.pins
    straying.move("left", [0.0, 0.1, 0.0])
    np.testing.assert_array_equal(straying.node_positions(0.3)[60], motion(straying, 0.3)[60])


def test_strays_follow_in_holds_and_exaggeration(straying):
    right = tuple(part(straying, 0.7, 1.0).tolist())
    straying.apply(Edit(holds=(Hold(right, 0.0, "world"),)))
    start, end = motion(straying, 0.0), motion(straying, 1.0)
    assert np.abs(end - start)[60].max() > 0.5
    np.testing.assert_allclose(straying.node_positions(1.0)[60], start[60], atol=1e-9)
    straying.apply(Edit(exaggerate=Exaggerate(1.5, 0.0)))
    leader = straying.graph.stray[60]
    bent = straying.engine.bend(straying.edit, 1.0)
    assert bent is not None
    np.testing.assert_allclose(bent.turns[60], bent.turns[leader])
    found = straying.node_positions(1.0)
    away = [np.linalg.norm(x[60] - x[leader]) for x in (start, found)]
    assert away[1] == pytest.approx(away[0], rel=1e-6)
    assert np.degrees(np.arctan2(-(found[60, 2] - 0.25), found[60, 0] - 0.5)) == pytest.approx(90, abs=10)


# Masks


def test_with_a_mask_holds_turn_colours_as_far_as_gaussians():
    scene = bar_scene(share=0.5)
    session = EditSession(scene)
    everything = tuple(range(len(session)))
    turn = from_axis([0, 1, 0], 135)
    rest = session.engine.motion_at(0.0).positions
    turns = np.tile(turn, (len(everything), 1))
    bent = NodePose(rotate(turn, rest), turns, turns)
    engine = session.engine
    posed = pose_gaussians(engine.rig, scene.gaussians, engine.motion_at(0.0), bent, engine.binding, True)
    before = torch.nn.functional.normalize(scene.gaussians.quats.detach().double(), dim=1)
    after = torch.nn.functional.normalize(posed.quats.double(), dim=1)
    own = multiply(after.numpy(), before.numpy() * [1, -1, -1, -1])
    np.testing.assert_allclose(np.degrees(2 * np.arccos(np.abs(own[:, 0]))), 67.5, atol=0.1)
    expected = rotate_harmonics(scene.gaussians.sh_rest, torch.from_numpy(own).float())
    torch.testing.assert_close(posed.sh_rest, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("share", [0.001, 0.5, 1.0])
def test_with_a_mask_handles_move_everything(share):
    scene = bar_scene(share=share, shaded=True)
    session = EditSession(scene)
    session.add_handle(range(len(session)), 0.6, "all")
    assert same(session.gaussians_at(0.6), scene.gaussians_at(0.6))
    session.move("all", [0.3, -0.2, 0.1], TURN)
    before, after = scene.gaussians_at(0.6), session.gaussians_at(0.6)
    R, pivot = torch.from_numpy(to_matrix(np.array(TURN))), torch.from_numpy(session.pivot("all"))
    expected = (before.means.double() - pivot) @ R.T + pivot + torch.tensor([0.3, -0.2, 0.1])
    torch.testing.assert_close(after.means.double(), expected, rtol=0, atol=1e-5)
    quats = torch.tensor(TURN).float().expand(len(before.means), 4).contiguous()
    torch.testing.assert_close(after.sh_rest, rotate_harmonics(before.sh_rest, quats), rtol=0, atol=1e-4)
    assert torch.equal(after.sh_dc, before.sh_dc) and torch.equal(after.scales, before.scales)


def test_with_a_mask_what_is_pinned_keeps_its_bits():
    scene = bar_scene(share=0.7)
    session = EditSession(scene)
    session.add_handle(part(session, 0.8, 1.0), 0.0, "right")
    session.pin(part(session, 0.0, 0.5))
    session.move("right", [0.0, 0.1, 0.0], TURN)
    before, after = scene.gaussians_at(0.4), session.gaussians_at(0.4)
    held = torch.isin(session.engine.binding[0].long(), torch.tensor(session.edit.pins)).all(1)
    assert 20 < int(held.sum()) < 380
    assert all(torch.equal(a[held], b[held]) for a, b in zip(dataclasses.astuple(before), dataclasses.astuple(after)))
    assert float((before.means - after.means).abs().max()) > 0.1


def test_with_a_mask_holds_keep_the_pose_of_their_time():
    scene = bar_scene(share=0.6)
    session = EditSession(scene)
    session.apply(Edit(holds=(Hold(tuple(range(len(session))), 0.2, "world"),)))
    before, after = scene.gaussians_at(0.2), session.gaussians_at(0.9)
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=1e-5)
    torch.testing.assert_close(after.quats.abs(), before.quats.abs(), rtol=0, atol=1e-5)


@pytest.mark.parametrize("share", [None, 0.5])
def test_same_bits_on_any_number_of_threads_where_torch_cuts_its_work(share, all_threads):
    """It does so above 32,768 elements, here at an odd place."""
    scene = bar_scene(gaussians=40_030, share=share, shaded=True)
    if share is not None:
        with torch.no_grad():
            scene.gaussians.hyper[:, -1] = torch.randn(40_030, generator=torch.Generator().manual_seed(5))
    results = []
    for threads in (1, 2):
        environment.configure(threads=threads)
        session = EditSession(scene)
        session.apply(Edit(holds=(Hold((0, 1, 2), 0.0, "world"),), exaggerate=Exaggerate(1.3)))
        session.add_handle(part(session, 0.8, 1.0), 0.0, "right")
        session.move("right", [0.0, 0.1, 0.0], TURN)
        results.append(session.gaussians_at(0.4))
    assert same(*results)


def test_results_are_no_parameters():
    session = EditSession(bar_scene())
    session.add_handle([3, 4, 5], 0.0, "a")
    session.move("a", [0.1, 0.0, 0.0])
    assert not any(tensor.requires_grad for tensor in dataclasses.astuple(session.gaussians_at(0.3)))


# Frames of a film


def test_an_edit_of_one_frame_is_one_frame_of_the_film_everywhere(tmp_path):
    """Ten frames in one second, a tenth of the motion each: the frame nearest to .54 shows what was made at .5."""
    scene = bar_scene()
    session = EditSession(scene)
    session.apply(Edit(film=Film(seconds=1.0, fps=10.0, size=32), playback=Playback(seconds=1.0)))
    session.add_handle(part(session, 0.8, 1.0), 0.5, "right", lasts="frame")
    session.move("right", [0.0, 0.3, 0.0])
    camera = film_camera(session, 0.5)
    for time, shown in ((0.54, True), (0.56, False)):
        assert same(session.render(camera, time), scene.render(camera, time)) != shown
        assert same(session.gaussians_at(time), scene.gaussians_at(time)) != shown
        moved = session.node_positions(time)
        assert np.array_equal(moved, motion(session, time)) != shown
        session.export_ply(tmp_path / "edited.ply", time)
        found = read_gaussian_ply(tmp_path / "edited.ply").means
        assert torch.equal(found, scene.gaussians_at(time).means) != shown
        end = moved[part(session, 0.95, 1.0)[0]]
        assert session.nearest(end, time) == part(session, 0.95, 1.0)[0]
        assert part(session, 0.95, 1.0)[0] in session.within(end, 1e-6, time)
    found = film_frame(session, 0.5)
    np.testing.assert_array_equal(found, to_bytes(session.render(camera, 0.5, 0.5).rgb))
    assert same(session.gaussians_at(0.54, frame=1e-3), scene.gaussians_at(0.54)), "but for those who say otherwise"


@pytest.mark.parametrize(
    "playback",
    [
        Playback(),
        Playback(speed=-0.3, repeat="loop"),
        Playback(speed=3.7, start=0.2, repeat="swing"),
        Playback(freeze=0.3),
        Playback(map=((0.0, 0.2), (2.0, 0.8), (3.0, 0.4))),
    ],
)
def test_the_reach_of_a_frame_is_half_a_step(playback):
    film = Film(seconds=3.0, fps=7.0)
    times = [playback.time_at(index / film.fps, film.seconds) for index in range(film.frames)]
    steps = [abs(b - a) for a, b in pairwise(times) if a != b]
    expected = float(np.median(steps)) / 2 if steps else 5e-3
    assert frame_reach(film, playback) == pytest.approx(expected, rel=1e-8)
