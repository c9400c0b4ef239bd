"""Only real motion passes: control points beat every scene at rest by far, and carry the surface where it goes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from helpers.tiny import blobs, tiny_camera, tiny_config
from scgs_warp.data.dataset import Dataset
from scgs_warp.evaluation.evaluate import evaluate
from scgs_warp.evaluation.image_metrics import psnr
from scgs_warp.evaluation.motion_metrics import GroundTruth, score_motion
from scgs_warp.rendering.render import render
from scgs_warp.scene.scene import Scene
from scgs_warp.training.loop import fit
from scgs_warp.types import Camera, Frame

INSTANTS, SIZE = 6, 40
FAST = {
    "freeze": 0,
    "optim": {"network": 5e-3, "means": 2e-3},
    "pretrain": {"steps": 250, "warm_up": 5, "densify_until": 180, "densify_every": 20},
}
"""A schedule in which a small network learns the motion within some hundred steps."""


def picture(camera: Camera, time: float) -> torch.Tensor:
    with torch.no_grad():
        return render(blobs(time), camera, torch.zeros(3)).rgb.clamp(0, 1)


def seen(split: str, cameras: int) -> Dataset:
    """Six instants of the swinging blob, each from several sides."""
    frames = []
    for index in range(INSTANTS * cameras):
        time = (index % INSTANTS) / (INSTANTS - 1)
        camera = tiny_camera(index if split == "train" else index + 100, 1, SIZE)
        with torch.no_grad():
            image = render(blobs(time), camera, torch.zeros(3))
        frames.append(Frame(camera, time, image.rgb.clamp(0, 1), image.alpha, None, f"{split}_{index:03d}"))
    return Dataset(frames, folder=Path("tiny"), split=split)


def true_motion() -> GroundTruth:
    """The blob that swings, in a scene that is about 2 high."""
    times = torch.linspace(0.0, 1.0, INSTANTS)
    points = torch.stack([blobs(float(time)).means[:60] for time in times])
    return GroundTruth(points, times, torch.ones(1, 60, dtype=torch.bool), 2.0)


@pytest.fixture(scope="module")
def moving(tmp_path_factory) -> Scene:
    return fit(tiny_config(700, **FAST), seen("train", 6), output=tmp_path_factory.mktemp("moving") / "run")


def test_control_points_beat_every_scene_at_rest(moving, tmp_path):
    """The best scene at rest that there could be shows the mean over the time in every view."""
    test = seen("test", 1)
    still = fit(tiny_config(400, motion={"model": "static"}), seen("train", 6), output=tmp_path / "run")
    means = [torch.stack([picture(frame.camera, k / 10) for k in range(11)]).mean(0) for frame in test]
    best = sum(float(psnr(mean, frame.image)) for mean, frame in zip(means, test)) / len(test)
    found, at_rest = evaluate(moving, test)["psnr"], evaluate(still, test)["psnr"]
    print(f"moving {found:.2f} dB, at rest {at_rest:.2f} dB, best at rest {best:.2f} dB")
    assert at_rest < best + 0.5
    assert found > max(at_rest, best) + 5.0


def test_the_surface_goes_where_it_went(moving):
    """End-point errors are percentages of the height; that of a scene at rest is the length of the way."""
    rest = moving.gaussians_at(0.0)
    assert score_motion(true_motion(), lambda _: rest.means).epe > 15.0
    found = score_motion(true_motion(), lambda time: moving.gaussians_at(time).means, rest.opacities).epe
    print(f"end-point error {found:.2f} %")
    assert found < 4.0
