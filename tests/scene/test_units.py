"""A scene in other units trains alike: no threshold, plane or tolerance is in the data's own units.

By a power of two every product and sum scales without rounding, so the runs have the same bits; one leak and they part.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.rescaled import VARIANTS, rescale_camera, rescale_dataset
from helpers.tiny import blobs, tiny_camera, tiny_config, tiny_dataset
from scgs_warp.config.presets import MOTIONS
from scgs_warp.data.dataset import Dataset
from scgs_warp.evaluation.motion_metrics import GroundTruth, score_motion
from scgs_warp.geometry import cameras
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.scene.scene import Scene
from scgs_warp.training.loop import fit
from scgs_warp.training.state import TrainState
from scgs_warp.types import Camera, Frame
from scgs_warp.visualization.overlay import Painter

POWERS = [2.0**-7, 2.0**7]
NOWHERE = (0.0, 0.0, 0.0)
CLOUD = 3.0 * torch.rand(50, 3, generator=torch.Generator().manual_seed(5)) - 1.5


def config_of(model: str, steps: int = 30):
    return tiny_config(steps, motion={"model": model})


def data_of(with_points: bool) -> Dataset:
    data = tiny_dataset(8, 32)
    data.points = CLOUD if with_points else None
    return data


def same(scene: Scene, other: Scene) -> None:
    for name, tensor in scene.tensors().items():
        assert torch.equal(tensor, other.tensors()[name]), name


@pytest.mark.parametrize("with_points", [False, True])
@pytest.mark.parametrize("model", MOTIONS)
def test_training_does_not_know_the_unit(model, with_points, tmp_path):
    data = data_of(with_points)
    scene = fit(config_of(model), data, output=tmp_path / "one")
    for power in POWERS:
        other = fit(config_of(model), rescale_dataset(data, power, NOWHERE), output=tmp_path / f"{power}")
        same(scene, other)
        looks_alike(scene, other, power)


def looks_alike(scene: Scene, other: Scene, power: float) -> None:
    """Everything the API gives in world units, at ``power`` times the size."""
    camera = tiny_camera(3, 8, 32)
    for time in (0.0, 0.4):
        image, again = scene.render(camera, time), other.render(rescale_camera(camera, power, NOWHERE), time)
        assert torch.equal(image.rgb, again.rgb) and torch.equal(image.alpha, again.alpha)
        assert torch.equal(image.depth * power, again.depth)
        assert torch.equal(scene.gaussians_at(time).means * power, other.gaussians_at(time).means)
        assert torch.equal(scene.gaussians_at(time).scales * power, other.gaussians_at(time).scales)
        assert torch.equal(scene.control_points_at(time) * power, other.control_points_at(time))
    films = [[(view, 0.5) for view in cameras.turntable(s.overview, 3, 32)] for s in (scene, other)]
    for show in ("rgb", "depth", "trajectories") + (("nodes",) if scene.control_point_count else ()):
        painters = [Painter(s, show, views) for s, views in zip((scene, other), films)]
        for (view, time), (far_view, _) in zip(*films):
            pictures = painters[0].paint(view, time), painters[1].paint(far_view, time)
            assert np.abs(np.subtract(*pictures, dtype=int)).max() <= 1, show  # films' cameras are made in float64
    times = torch.tensor([0.0, 0.5, 1.0])
    tracks = torch.stack([blobs(time).means for time in times.tolist()])
    truth = GroundTruth(tracks, times, torch.ones(2, 120, dtype=torch.bool), 2.0)
    scaled = dataclasses.replace(truth, points=truth.points * power, height=truth.height * power)
    score = score_motion(truth, lambda time: scene.gaussians_at(time).means)
    again = score_motion(scaled, lambda time: other.gaussians_at(time).means)
    assert again == pytest.approx(score, rel=1e-6)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("with_points", [False, True])
def test_the_beginning_is_the_same_within_rounding(variant, with_points):
    scale, shift = VARIANTS[variant]
    data = data_of(with_points)
    moved = rescale_dataset(data, scale, shift)
    config = config_of("control-points")
    state, other = TrainState.begin(config, data, "cpu"), TrainState.begin(config, moved, "cpu")
    assert other.extent == pytest.approx(state.extent, rel=1e-4)
    assert other.normalisation.scale * scale == pytest.approx(state.normalisation.scale, rel=1e-4)
    for frame, far in zip(data, moved):
        views = state.normalisation.apply_camera(frame.camera), other.normalisation.apply_camera(far.camera)
        torch.testing.assert_close(*(view.viewmat for view in views), rtol=0.0, atol=1e-4)
    # A candidate on the border of a pixel may fall into its neighbour; then another point is drawn.
    close = (state.points - other.points).norm(dim=1) < 1e-3
    assert float(close.float().mean()) > 0.9
    radii = cameras.overview(data.cameras).radius, cameras.overview(moved.cameras).radius / scale
    assert radii[0] == pytest.approx(radii[1], rel=1e-4)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_trained_scene_is_as_good(variant, tmp_path):
    scale, shift = VARIANTS[variant]
    data = tiny_dataset(12, 32)
    config = config_of("control-points", 200)
    scores = []
    for name, seen in (("one", data), ("other", rescale_dataset(data, scale, shift))):
        scene = fit(config, seen, output=tmp_path / name)
        errors = [(scene.render(frame.camera, frame.time).rgb - frame.image).square().mean() for frame in seen]
        scores.append(-10.0 * float(torch.stack(errors).mean().log10()))
        assert scene.gaussian_count > 100 and scene.control_point_count >= config.motion.neighbors + 1
    assert scores[0] == pytest.approx(scores[1], abs=1.0)  # rounding grows while a run is short and small


def turning_cameras(offset: float, turn: float) -> list[Camera]:
    """One place, five directions."""
    K = torch.tensor([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]])
    found = []
    for index in range(5):
        angle = torch.tensor(turn * index, dtype=torch.float64)
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3] = torch.tensor([[angle.cos(), 0, -angle.sin()], [0, 1, 0], [angle.sin(), 0, angle.cos()]])
        viewmat[:3, 3] = -viewmat[:3, :3] @ torch.full((3,), offset, dtype=torch.float64)
        found.append(Camera(viewmat.float(), K, 32, 32))
    return found


@pytest.mark.parametrize("turn", [0.0, 0.2])
@pytest.mark.parametrize("offset", [0.1, 50.0, 3000.0])
def test_a_camera_on_a_tripod_far_from_the_origin(offset, turn):
    """What float32 leaves of equal positions is no size."""
    rig, views = turning_cameras(offset, turn), turning_cameras(0.0, turn)
    near, far = Normalisation.fit(views), Normalisation.fit(rig)
    assert far.scale == pytest.approx(near.scale, rel=1e-2)
    np.testing.assert_allclose(far.centre - offset, near.centre, atol=2e-3 * max(1.0, offset / 50.0))
    assert cameras.overview(rig).radius == pytest.approx(cameras.overview(views).radius, rel=1e-2)
    frames = [Frame(camera, 0.1 * index, torch.zeros(32, 32, 3)) for index, camera in enumerate(rig)]
    assert Dataset(frames, folder=Path("rig"), split="train").extent < 1e-5 * offset
