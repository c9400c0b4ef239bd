"""The state of a run: what it starts from, and which checkpoints it resumes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.errors import UserError
from scgs_warp.geometry.normalisation import FEWEST_POINTS
from scgs_warp.scene.scene import Scene
from scgs_warp.storage import checkpoint
from scgs_warp.training.automatic import has_initial_points, resolve_auto
from scgs_warp.training.initial_points import HALF_SIZE
from scgs_warp.training.loop import fit
from scgs_warp.training.state import TrainState
from scgs_warp.types import Camera


def checkpoint_bytes(folder: Path) -> bytes:
    return (folder / "checkpoint.safetensors").read_bytes()


def test_a_camera_that_stands_still():
    """Its centres have no extent; Gaussians must not all count as too large."""
    data = tiny_dataset(6)
    frames = [dataclasses.replace(frame, camera=data[0].camera) for frame in data]
    still = type(data)(frames, folder=Path("still"), split="train")
    assert still.extent == 0.0
    assert TrainState.begin(tiny_config(), still, "cpu").extent > 1.0


def test_resume_refuses_other_frames(tmp_path):
    config = tiny_config(20)
    fit(config, tiny_dataset(3), output=tmp_path / "run")
    with pytest.raises(UserError, match="other frames"):
        fit(config, tiny_dataset(4), output=tmp_path / "run", resume=True)


@pytest.mark.parametrize("change", ["farther", "turned", "wider"])
def test_resume_refuses_other_cameras(change, tmp_path):
    """Names, times and sizes stay if cameras are found anew in the same folder."""
    config, data = tiny_config(20), tiny_dataset(6)
    fit(config, data, output=tmp_path / "run")
    turn = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    frames = []
    for frame in data:
        viewmat, K = frame.camera.viewmat.clone(), frame.camera.K.clone()
        if change == "farther":
            viewmat[:3, 3] *= 1.1
        elif change == "turned":
            viewmat = viewmat @ turn
        else:
            K[:2, :2] *= 0.9
        frames.append(dataclasses.replace(frame, camera=Camera(viewmat, K, 48, 48)))
    other = type(data)(frames, folder=data.folder, split="train")
    with pytest.raises(UserError, match="other cameras than those of tiny; restore them"):
        fit(config, other, output=tmp_path / "run", resume=True)
    fit(config, data, output=tmp_path / "run", resume=True)


def test_resume_refuses_other_images_of_the_same_names(tmp_path):
    config, data = tiny_config(20), tiny_dataset(6)
    fit(config, data, output=tmp_path / "run")
    frames = [dataclasses.replace(frame, image=frame.image.flip(1)) for frame in data]
    with pytest.raises(UserError, match="other images than those of tiny, which have the same names; give the same"):
        fit(config, type(data)(frames, folder=data.folder, split="train"), output=tmp_path / "run", resume=True)
    moved = type(data)(list(data), folder=Path("elsewhere"), split="train")
    fit(config, moved, output=tmp_path / "run", resume=True)


def test_runs_without_thumbnails_are_resumed(tmp_path):
    config, data = tiny_config(20), tiny_dataset(6)
    fit(config, data, output=tmp_path / "run")
    tensors, metadata = checkpoint.read(tmp_path / "run")
    del metadata["images"], metadata["crc32"]
    checkpoint.write(tmp_path / "run", tensors, metadata)
    fit(config, data, output=tmp_path / "run", resume=True)


def test_resume_names_settings_of_the_data_before_the_frames(tmp_path):
    config = tiny_config(20)
    fit(config, tiny_dataset(3), output=tmp_path / "run")
    smaller = dataclasses.replace(config, data=dataclasses.replace(config.data, downscale=2))
    with pytest.raises(UserError, match=r"made with data\.downscale = "):
        fit(smaller, tiny_dataset(3, size=24), output=tmp_path / "run", resume=True)


@pytest.mark.parametrize(("section", "field"), [("motion", "shading"), (None, "half_size")])
def test_resume_refuses_a_run_of_another_version(section, field, tmp_path):
    """What it did without the field is no value that could be given."""
    config, data = tiny_config(20), tiny_dataset(3)
    fit(config, data, output=tmp_path / "run")
    tensors, metadata = checkpoint.read(tmp_path / "run")
    del (metadata["config"][section] if section else metadata["config"])[field]
    checkpoint.write(tmp_path / "run", tensors, metadata)
    name = f"{section}.{field}" if section else field
    with pytest.raises(UserError, match=f"made by another version, which had no {name}; train again with another --"):
        fit(config, data, output=tmp_path / "run", resume=True)


@pytest.mark.parametrize("stop", [3, 12])
def test_points_that_are_found_later_change_no_run(stop, tmp_path, monkeypatch):
    """Earlier versions did not find the points of depth maps."""
    cut_out = tiny_dataset(6)
    data = type(cut_out)([dataclasses.replace(frame, alpha=None) for frame in cut_out], folder=Path("a"), split="train")
    config, save = tiny_config(20), TrainState.save
    fit(config, data, output=tmp_path / "whole")

    def save_and_stop(state: TrainState, folder: Path) -> None:
        save(state, folder)
        if state.step == stop:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(TrainState, "save", save_and_stop)
        with pytest.raises(KeyboardInterrupt):
            fit(dataclasses.replace(config, checkpoint_seconds=0.0), data, output=tmp_path / "cut")
    found = data.subset(range(len(data)))
    found.points = torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    assert resolve_auto(config, found).init_from == "points"
    fit(config, found, output=tmp_path / "cut", resume=True)
    assert checkpoint_bytes(tmp_path / "cut") == checkpoint_bytes(tmp_path / "whole")


def test_what_changes_no_bit_may_differ_on_resume(tmp_path):
    fit(tiny_config(20), tiny_dataset(3), output=tmp_path / "run")
    before = checkpoint_bytes(tmp_path / "run")
    other = tiny_config(20, evaluate_every=7, checkpoint_seconds=0.0)
    assert fit(other, tiny_dataset(3), output=tmp_path / "run", resume=True).step == 20
    fit(other, tiny_dataset(3), output=tmp_path / "again")
    assert checkpoint_bytes(tmp_path / "again") == before


def test_auto_follows_alpha_when_there_are_no_points():
    data, config = tiny_dataset(3), tiny_config(20, motion={"hyper_dim": 0})
    assert not has_initial_points(data, config)
    resolved = resolve_auto(config, data)
    assert resolved.densify.prune_large == "always" and resolved.motion.hyper_dim == config.motion.hyper_dim
    filled = type(data)([dataclasses.replace(f, alpha=None) for f in data], folder=Path("filled"), split="train")
    resolved = resolve_auto(config, filled)
    assert resolved.densify.prune_large == "never" and resolved.motion.hyper_dim == 1
    assert resolved.pretrain_steps == config.pretrain_steps > 0


def test_the_main_stage_begins_with_control_points():
    state = TrainState.begin(tiny_config(60), tiny_dataset(3), "cpu")
    assert (state.stage, state.motion.name, state.stage_step) == ("pretrain", "spheres", 0)
    state.step = state.config.pretrain_steps
    state.begin_main()
    assert (state.stage, state.motion.name, state.stage_step) == ("main", "control-points", 0)
    assert len(state.gaussians) == len(state.stats.count) == state.config.init_points


@pytest.mark.parametrize("model", ["control-points", "per-gaussian", "hexplane", "static"])
def test_gaussians_are_sharp_and_spheres_are_not(model, tmp_path):
    """Also after a checkpoint of either stage has been read."""
    config = tiny_config(60, motion={"model": model}, sharpness=0.7)
    state = TrainState.begin(config, tiny_dataset(3), "cpu")
    if model == "control-points":
        state.save(tmp_path)
        for read in (state, TrainState.resume(tmp_path, config, tiny_dataset(3), "cpu")):
            assert read.gaussians.sharpness == read.motion.gaussians_at(read.gaussians, 0.3).sharpness == 0.0
        state.step = config.pretrain_steps
        state.begin_main()
    state.save(tmp_path)
    for read in (state, TrainState.resume(tmp_path, config, tiny_dataset(3), "cpu"), Scene.load(tmp_path)):
        assert read.gaussians.sharpness == read.motion.gaussians_at(read.gaussians, 0.3).sharpness == 0.7


def test_random_points_of_the_official_code_are_grey_in_a_cube():
    """Whatever alpha shows; and nothing is added to the points that the data has."""
    data = tiny_dataset(3)
    cube, covered = (
        TrainState.begin(tiny_config(20, init_points=1000, init_random=way), data, "cpu") for way in ("cube", "covered")
    )
    count = round(256 * cube.config.pretrain.start_ratio)
    assert cube.points.shape == covered.points.shape == (count, 3)
    assert bool((cube.colors == 0.5).all()) and not bool((covered.colors == 0.5).all())
    assert float(cube.points.std()) == pytest.approx(HALF_SIZE / 3**0.5, rel=0.05)
    assert float(covered.points.std()) < 0.9 * float(cube.points.std())
    filled = type(data)([dataclasses.replace(f, alpha=None) for f in data], folder=Path("filled"), split="train")
    filled.points = torch.randn(40, 3)
    counts = [
        len(TrainState.begin(tiny_config(20, init_points=1000, init_random=way), filled, "cpu").points)
        for way in ("cube", "covered")
    ]
    assert counts[0] == 40 < counts[1]


def test_resume_counts_dropped_steps_on(tmp_path):
    """Otherwise a run that is killed and resumed would never reach the number of dropped steps at which it ends."""
    config, data = tiny_config(20, motion={"model": "static"}), tiny_dataset(3)
    state = TrainState.begin(config, data, "cpu")
    state.failures = 7
    state.save(tmp_path)
    assert TrainState.resume(tmp_path, config, data, "cpu").failures == 7


@pytest.mark.parametrize(("neighbors", "fewest"), [(4, FEWEST_POINTS), (FEWEST_POINTS, FEWEST_POINTS + 1)])
def test_a_handful_of_points_is_noise(neighbors, fewest):
    data, config = tiny_dataset(3), tiny_config(20, motion={"neighbors": neighbors, "nodes": 64})
    for count in (1, fewest - 1, fewest):
        data.points = torch.zeros(count, 3)
        assert has_initial_points(data, config) == (count == fewest)
