"""Kept poses: exact where they were sampled, within the error they state in between, and dropped with the motion."""

from __future__ import annotations

import math

import pytest
import torch

from scgs_warp.benchmark.scenes import scene_camera, synthetic_scene
from scgs_warp.motion.pose_track import BATCH, FIRST, MOST, RELATIVE, PoseTrack
from scgs_warp.types import Pose

COUNT = 5
TOLERANCE = 1e-3


def turned(angle: torch.Tensor) -> torch.Tensor:
    """Return unit quaternions [..., 4] about z."""
    half, zero = 0.5 * angle, torch.zeros_like(angle)
    return torch.stack([half.cos(), zero, zero, half.sin()], dim=-1)


def swing(times: torch.Tensor, sign: float = 1.0) -> list[Pose]:
    """Return poses that swing and turn, with the quaternions of every second instant negated if ``sign`` is -1."""
    phase = torch.arange(COUNT)
    poses = []
    for time in times:
        shift = torch.stack([torch.sin(6.0 * time + phase), torch.cos(5.0 * time + phase), time * phase], dim=1)
        rotations = turned(2.0 * time + 0.1 * phase)
        flip = sign if int(torch.floor(128.0 * time)) % 2 else 1.0
        poses.append(Pose(shift, flip * rotations, tints=0.1 * shift))
    return poses


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_interpolated_poses_err_by_no_more_than_they_state(sign: float):
    track = PoseTrack.of(lambda times: swing(times, sign), 0.5, TOLERANCE)
    assert track is not None and track.error <= TOLERANCE and track.intervals % FIRST == 0
    generator = torch.Generator().manual_seed(1)
    times = [0.0, 1.0, 0.5, *torch.rand(200, generator=generator).tolist()]
    for time, truth in zip(times, swing(torch.tensor(times))):
        pose = track.at(time)
        assert float((pose.translations - truth.translations).norm(dim=1).max()) <= TOLERANCE
        alike = (pose.rotations * truth.rotations).sum(1).abs().clamp(max=1.0)
        assert float(2.0 * torch.acos(alike.double()).max()) * 0.5 <= TOLERANCE + 1e-3
        assert torch.allclose(pose.rotations.norm(dim=1), torch.ones(COUNT), atol=1e-6)
        assert pose.tints is not None and torch.allclose(pose.tints, truth.tints, atol=TOLERANCE)
        assert pose.shape_rotations is None and pose.log_scales is None


def test_samples_are_exact_and_more_are_taken_for_a_smaller_error():
    tracks = [PoseTrack.of(swing, 0.5, tolerance) for tolerance in (1e-2, 1e-3, 1e-4)]
    assert all(track is not None for track in tracks)
    counts = [track.intervals for track in tracks if track]
    assert counts == sorted(counts) and counts[0] < counts[-1]
    track = tracks[0]
    assert track is not None
    for index in (0, 1, 37, track.intervals):
        (truth,) = swing(torch.tensor([index / track.intervals]))
        assert torch.equal(track.at(index / track.intervals).translations, truth.translations)


def test_a_jump_is_not_interpolated():
    def jumping(times: torch.Tensor) -> list[Pose]:
        rest = turned(torch.zeros(COUNT))
        return [Pose(torch.full((COUNT, 3), float(time > 0.3)), rest) for time in times]

    told: list[tuple[int, int]] = []
    assert PoseTrack.of(jumping, 0.5, TOLERANCE, lambda done, total: told.append((done, total))) is None
    assert told == [(FIRST * 2**k + 1, MOST + 1) for k in range(int(math.log2(MOST / FIRST)))]


def turning(times: torch.Tensor) -> list[Pose]:
    """Return poses that stay in place and turn, faster and faster."""
    rest = torch.zeros(COUNT, 3)
    return [Pose(rest, turned(8.0 * time * time + torch.zeros(COUNT))) for time in times]


def tinted(times: torch.Tensor) -> list[Pose]:
    """Return poses that stay in place and change colour."""
    rest, still = torch.zeros(COUNT, 3), turned(torch.zeros(COUNT))
    return [Pose(rest, still, tints=torch.sin(9.0 * time).expand(COUNT, 3)) for time in times]


def test_turns_count_by_how_far_they_reach():
    near, far = (PoseTrack.of(turning, reach, 1e-5) for reach in (0.01, 10.0))
    assert near is not None and near.intervals == 2 * FIRST and 0.0 < near.error <= 1e-5
    assert far is None or far.intervals > near.intervals
    times = [(index + 0.37) / 50 for index in range(50)]
    for time, truth in zip(times, turning(torch.tensor(times))):
        alike = (near.at(time).rotations.double() * truth.rotations.double()).sum(1).abs().clamp(max=1.0)
        assert 0.01 * float(2.0 * torch.acos(alike).max()) <= 2e-5


def test_colours_have_an_error_of_their_own():
    track = PoseTrack.of(tinted, 1.0, 1e-9)
    assert track is not None and track.error == 0.0
    times = [(index + 0.37) / 50 for index in range(50)]
    for time, truth in zip(times, tinted(torch.tensor(times))):
        tints = track.at(time).tints
        assert tints is not None and float((tints - truth.tints).abs().max()) <= RELATIVE

    def flickering(times: torch.Tensor) -> list[Pose]:
        rest, still = torch.zeros(COUNT, 3), turned(torch.zeros(COUNT))
        return [Pose(rest, still, tints=torch.full((COUNT, 3), float(time > 0.3))) for time in times]

    assert PoseTrack.of(flickering, 1.0, 1e-3) is None


def test_nothing_is_kept_without_memory(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("scgs_warp.motion.pose_track.memory.fits", lambda need, device: False)
    assert PoseTrack.of(turning, 1.0, 1e-9) is None
    assert PoseTrack.of(tinted, 1.0, 1.0) is not None


def test_the_network_is_asked_in_batches():
    sizes: list[int] = []

    def counted(times: torch.Tensor) -> list[Pose]:
        sizes.append(len(times))
        return swing(times)

    PoseTrack.of(counted, 0.5, 1e-2)
    assert max(sizes) == BATCH


def test_a_scene_plays_kept_poses_until_its_motion_changes():
    scene = synthetic_scene("control-points", 600, 40, "cpu")
    scene.freeze_binding()
    camera = scene_camera(scene, (64, 64))
    exact = [scene.render(camera, time).rgb for time in (0.111, 0.512, 0.9)]
    assert scene.prepare_playback(1e-3)
    motion = scene.motion
    asked: list[int] = []
    network = motion.poses  # type: ignore[attr-defined]
    motion.poses = lambda times: asked.append(len(times)) or network(times)  # type: ignore[attr-defined]
    played = [scene.render(camera, time).rgb for time in (0.111, 0.512, 0.9)]
    assert not asked
    assert any(not torch.equal(a, b) for a, b in zip(played, exact))
    assert all(float((a - b).abs().max()) < 0.02 for a, b in zip(played, exact))
    with torch.no_grad():
        motion.network.head.weight.mul_(3.0)  # type: ignore[union-attr]
    changed = scene.render(camera, 0.512).rgb
    assert asked == [1]
    assert scene.prepare_playback(1e-2) and not torch.equal(scene.render(camera, 0.512).rgb, changed)
    motion.network.head.bias = torch.nn.Parameter(motion.network.head.bias + 0.01)  # type: ignore[union-attr]
    replaced = scene.render(camera, 0.512).rgb
    assert asked[-1] == 1 and not torch.equal(replaced, changed)
    assert not scene.prepare_playback(1e-9)
    assert torch.equal(scene.render(camera, 0.512).rgb, replaced)


def changed_position(motion) -> None:
    with torch.no_grad():
        motion.positions.add_(0.01)


def replaced_layer(motion) -> None:
    motion.network.head = torch.nn.Linear(motion.network.head.in_features, motion.network.head.out_features)


@pytest.mark.parametrize("change", [changed_position, replaced_layer])
def test_kept_poses_do_not_outlive_a_change(change):
    motion, before = kept_motion()
    with torch.no_grad():
        motion.pose_at(0.31)
    assert motion.kept_poses is before
    change(motion)
    with torch.no_grad():
        pose = motion.pose_at(0.31)
        assert motion.kept_poses is None
        assert torch.equal(pose.translations, motion.poses(torch.tensor([0.31]))[0].translations)


def kept_motion():
    scene = synthetic_scene("control-points", 300, 20, "cpu")
    assert scene.prepare_playback(1e-3)
    return scene.motion, scene.motion.kept_poses


def test_a_change_while_sampling_keeps_nothing():
    scene = synthetic_scene("control-points", 300, 20, "cpu")

    @torch.no_grad()
    def tell(done: int, total: int) -> None:
        scene.motion.log_radii.add_(0.1)  # type: ignore[operator, union-attr]

    assert not scene.prepare_playback(1e-3, tell) and scene.motion.kept_poses is None


def test_inference_tensors_are_not_kept():
    """They count no changes, so a change would go unnoticed."""
    with torch.inference_mode():
        scene = synthetic_scene("control-points", 300, 20, "cpu")
    assert not scene.prepare_playback(1e-3)


def test_times_beyond_the_ends_are_the_ends():
    _, track = kept_motion()
    for time, end in ((-0.5, 0.0), (1.5, 1.0)):
        assert torch.equal(track.at(time).translations, track.at(end).translations)


def test_gradients_are_those_of_the_network():
    scene = synthetic_scene("control-points", 300, 20, "cpu")
    assert scene.prepare_playback(1e-3)
    scene.motion.gaussians_at(scene.gaussians, 0.3).means.sum().backward()
    assert float(scene.motion.network.head.weight.grad.abs().max()) > 0.0  # type: ignore[union-attr]


@pytest.mark.parametrize("motion", ["static", "hexplane", "per-gaussian"])
def test_models_without_control_points_have_nothing_to_keep(motion: str):
    scene = synthetic_scene(motion, 300, 20, "cpu")
    camera = scene_camera(scene, (48, 48))
    before = scene.render(camera, 0.4).rgb
    assert not scene.prepare_playback()
    assert torch.equal(scene.render(camera, 0.4).rgb, before)
