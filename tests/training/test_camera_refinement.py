"""Refined cameras: the algebra, what is recovered of a perturbation, and the same bits after a resume."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path

import pytest
import torch

from helpers.steps import check_resumed
from helpers.tiny import blobs, tiny_camera, tiny_config, tiny_dataset, write_dnerf
from scgs_warp.apps import evaluate as app
from scgs_warp.config.presets import OptimConfig
from scgs_warp.data import load
from scgs_warp.data.dataset import Dataset
from scgs_warp.evaluation.evaluate import evaluate
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.rendering.render import render
from scgs_warp.scene.scene import Scene
from scgs_warp.storage.checkpoint import read
from scgs_warp.training.camera_refinement import CameraRefinement, camera_rate, refined
from scgs_warp.training.frames import Frames
from scgs_warp.training.loop import fit
from scgs_warp.training.run import train_and_evaluate
from scgs_warp.training.state import TrainState
from scgs_warp.training.step import training_step
from scgs_warp.types import Camera, Frame

COUNT, SIZE = 24, 48


def refinement(twists: torch.Tensor) -> CameraRefinement:
    made = CameraRefinement(len(twists))
    made.twists.data[:] = twists
    return made


def test_identity_at_first_with_a_gradient():
    made = CameraRefinement(3)
    matrices = made.matrices([0, 2])
    assert torch.equal(matrices, torch.eye(4).expand(2, 4, 4))
    matrices[1, 2, 1].backward()  # turning about x moves y to z
    assert made.twists.grad is not None
    assert made.twists.grad[2].tolist() == [1.0, 0.0, 0.0, 0.0, 0.0, 0.0] and not made.twists.grad[:2].any()


def test_a_twist_is_a_screw():
    matrix = refinement(torch.tensor([[0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.3]])).matrices([0])[0]
    expected = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0.3], [0, 0, 0, 1]])
    torch.testing.assert_close(matrix, expected, atol=1e-6, rtol=0)


def test_a_correction_moves_the_scene_before_the_camera():
    """Its axes are those of the scene, whichever way the camera looks."""
    made, camera = refinement(torch.tensor([[0.0] * 6, [0.3, -0.2, 0.5, 0.4, 0.1, -0.3]])), tiny_camera(1, 3, SIZE)
    points = torch.randn(4, 9, generator=torch.Generator().manual_seed(0))
    points[3] = 1.0
    corrected = made.apply(camera, 1)
    torch.testing.assert_close(corrected.viewmat @ points, camera.viewmat @ (made.matrices([1])[0] @ points))
    assert torch.equal(made.apply(camera, 0).viewmat, camera.viewmat)
    assert torch.equal(corrected.K, camera.K) and (corrected.width, corrected.height) == (SIZE, SIZE)


def test_the_mean_is_taken_out():
    made = refinement(torch.arange(12.0).view(2, 6))
    made.centre()
    assert made.twists.detach().tolist() == [[-3.0] * 6, [3.0] * 6]


def test_the_rate_waits_then_decays():
    optim = OptimConfig(cameras=1e-3, means_until=100)
    rates = [camera_rate(step, optim, 20) for step in (0, 19, 20, 60, 100, 500)]
    assert rates[:2] == [0.0, 0.0] and rates[2] == pytest.approx(1e-3)
    assert rates[3] == pytest.approx(1e-4) and rates[4:] == pytest.approx([1e-5, 1e-5])


def still_dataset(perturbed: torch.Tensor | None = None, split: str = "train", count: int = COUNT) -> Dataset:
    """A scene at rest; the poses given are those of the images turned by the twists ``perturbed`` [V, 6]."""
    frames = []
    for index in range(count):
        camera = tiny_camera(index if split == "train" else index + 100, count, SIZE)
        with torch.no_grad():
            image = render(blobs(0.5), camera, torch.zeros(3))
        if perturbed is not None:
            camera = refinement(perturbed).apply(camera, index)
            camera = Camera(camera.viewmat.detach(), camera.K, camera.width, camera.height)
        frames.append(Frame(camera, index / count, image.rgb.clamp(0, 1), image.alpha, None, f"{split}_{index}"))
    return Dataset(frames, folder=Path("still"), split=split)


def between(cameras: list[Camera]) -> torch.Tensor:
    """[V, V, 4, 4] poses of the cameras relative to each other: no motion of the scene as a whole changes them."""
    stacked = torch.stack([camera.viewmat for camera in cameras]).double()
    return stacked[:, None] @ torch.linalg.inv(stacked)[None]


def turned_by(first: torch.Tensor, second: torch.Tensor) -> float:
    """Root mean square angle between relative rotations, radians."""
    relative = first[..., :3, :3].transpose(-1, -2) @ second[..., :3, :3]
    cosine = (relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return float(cosine.clamp(-1, 1).acos().square().mean().sqrt())


def test_most_of_a_perturbation_is_recovered(tmp_path, device):
    noise = 0.02 * torch.randn(COUNT, 6, generator=torch.Generator().manual_seed(5))
    data, truth = still_dataset(noise), between(still_dataset().cameras)
    config = tiny_config(800, motion={"model": "static"})
    scene = fit(config, data, output=tmp_path / "given", device=device)
    refining = dataclasses.replace(config, optim=dataclasses.replace(config.optim, cameras=5e-3))
    refined = fit(refining, data, output=tmp_path / "refined", device=device)
    found = corrected(data, tmp_path / "refined", refined.normalisation)
    before, after = turned_by(between(data.cameras), truth), turned_by(between(found.cameras), truth)
    print(before, after, evaluate(scene, data)["psnr"], evaluate(refined, found)["psnr"])
    assert after < 0.4 * before
    assert evaluate(refined, found)["psnr"] > evaluate(scene, data)["psnr"] + 3.0


def corrected(data: Dataset, run: Path, normalisation: Normalisation) -> Dataset:
    """The data with the poses that the run found, in world units."""
    made = refinement(read(run)[0]["cameras.twists"].cpu())
    frames = []
    for index, frame in enumerate(data):
        camera = made.apply(normalisation.apply_camera(frame.camera), index)
        viewmat = camera.viewmat.detach().double()
        centre = torch.as_tensor(normalisation.centre)
        viewmat[:3, 3] = viewmat[:3, 3] / normalisation.scale - viewmat[:3, :3] @ centre
        moved = Camera(viewmat.float(), camera.K, camera.width, camera.height)
        frames.append(dataclasses.replace(frame, camera=moved))
    return Dataset(frames, folder=data.folder, split=data.split)


@pytest.fixture(scope="module")
def refined_run(tmp_path_factory) -> tuple[Path, Path]:
    """A data set on disk, and a run that refined its poses."""
    data = write_dnerf(tmp_path_factory.mktemp("data") / "blobs")
    run = tmp_path_factory.mktemp("runs") / "refined"
    config = tiny_config(120, motion={"model": "static"}, optim={"cameras": 2e-2}, coarse=0)
    train_and_evaluate(config, data, run, frames=0)
    return data, run


def test_training_frames_are_scored_from_the_poses_that_were_found(refined_run, tmp_path, capsys):
    folder, run = refined_run
    scene, given = Scene.load(run), load(folder)
    found = corrected(given, run, scene.normalisation)
    ours = refined(given, run, scene.normalisation)
    assert ours is not None and ours.fingerprint == given.fingerprint
    for one, other in zip(ours, found):
        torch.testing.assert_close(one.camera.viewmat, other.camera.viewmat)
        assert torch.equal(one.image, other.image)
    expected, without = (evaluate(scene, frames)["psnr"] for frames in (found, given))
    assert abs(expected - without) > 0.05
    arguments = ["--run", str(run), "--device", "cpu", "--json", str(tmp_path / "metrics.json")]
    assert app.cli([*arguments, "--split", "train"]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["psnr"] == pytest.approx(expected, abs=1e-3) and metrics["poses"] == "refined"
    assert "poses: as training refined them" in capsys.readouterr().out
    assert app.cli(arguments) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["poses"] == "given" and metrics["psnr"] == json.loads((run / "metrics.json").read_text())["psnr"]


def test_other_frames_are_scored_from_the_poses_they_were_given(refined_run, tmp_path, capsys):
    folder, run = refined_run
    other = Path(shutil.copytree(folder, tmp_path / "other"))
    path = other / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"][0]["time"] = 0.01
    path.write_text(json.dumps(content))
    target = tmp_path / "metrics.json"
    assert app.cli(["--run", str(run), "--split", "train", "--data", str(other), "--json", str(target)]) == 0
    assert json.loads(target.read_text())["poses"] == "given"
    assert "poses: as the data give them" in capsys.readouterr().out


def test_a_run_that_refined_none_has_none(tmp_path):
    data = tiny_dataset(4)
    scene = fit(tiny_config(12), data, output=tmp_path / "run")
    assert refined(data, tmp_path / "run", scene.normalisation) is None


def test_a_run_resumes_to_the_same_bits(tmp_path, device, monkeypatch):
    data = tiny_dataset(6)
    config = tiny_config(40, optim={"cameras": 1e-3}, motion={"mask": True, "time_noise": 0.1})
    whole = check_resumed(config, data, tmp_path, device, monkeypatch, 25)
    assert whole["cameras.twists"].any() and "adam.cameras.twists.exp_avg" in whole


def test_a_training_step_takes_the_mean_out():
    """A step sees one camera; what it moves in common with the others is not determined by the images."""
    config = tiny_config(60, motion={"model": "static"}, coarse=0, optim={"cameras": 5e-3})
    data = still_dataset(count=4)
    state = TrainState.begin(config, data, "cpu")
    frames = Frames(data, state.normalisation, config, "cpu")
    assert state.refines_cameras
    for _ in range(2):
        assert training_step(state, frames).failed is None
        state.step += 1
    twists = state.cameras.twists.detach()
    assert float(twists.abs().max()) > 1e-3 and float(twists.mean(0).abs().max()) < 1e-8
