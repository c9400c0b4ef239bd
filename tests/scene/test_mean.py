"""The mean of several trainings of one data set."""

from __future__ import annotations

import dataclasses
import shutil

import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.data.dataset import Dataset
from scgs_warp.errors import UserError
from scgs_warp.scene.mean import MeanScene, load_mean
from scgs_warp.scene.scene import Scene
from scgs_warp.training.loop import fit


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder, data = tmp_path_factory.mktemp("mean"), tiny_dataset(6)
    for seed in (0, 1, 2):
        fit(dataclasses.replace(tiny_config(40), seed=seed), data, output=folder / f"seed-{seed}")
    return [folder / f"seed-{seed}" for seed in (0, 1, 2)]


def test_pictures_are_means(runs, device):
    scenes = [Scene.load(run, device) for run in runs]
    mean, camera = load_mean(runs, device), tiny_dataset(6)[2].camera
    assert isinstance(mean, MeanScene)
    for time, background in ((0.3, None), (0.3, (0.2, 0.5, 0.1))):
        images = [scene.render(camera, time, background) for scene in scenes]
        kept = [(image.rgb.clone(), image.alpha.clone(), image.depth.clone()) for image in images]
        rgbs, alphas, depths = map(torch.stack, zip(*kept))
        found = mean.render(camera, time, background)
        torch.testing.assert_close(found.rgb, rgbs.mean(0))
        torch.testing.assert_close(found.alpha, alphas.mean(0))
        depth = (depths * alphas).sum(0) / alphas.sum(0).clamp_min(1e-12)
        torch.testing.assert_close(found.depth, torch.where(alphas.sum(0) > 0, depth, 0.0))
        assert not torch.allclose(kept[0][0], kept[1][0]), "the runs differ"


def test_everything_else_is_that_of_the_first(runs):
    mean, first = load_mean(runs), Scene.load(runs[0])
    assert mean.gaussian_count == sum(Scene.load(run).gaussian_count for run in runs)
    assert mean.step == first.step and mean.folder == first.folder and mean.overview == first.overview
    assert torch.equal(mean.control_points_at(0.4), first.control_points_at(0.4))


def test_a_single_run_is_its_scene(runs):
    assert not isinstance(load_mean(runs[:1]), MeanScene)


def test_runs_that_have_no_mean_are_refused(runs, tmp_path):
    """Those of other frames, of frames with the same names by other cameras or of something else, and a run with
    itself."""
    data = tiny_dataset(6)
    moved = [dataclasses.replace(each.camera, viewmat=each.camera.viewmat.clone()) for each in data]
    for camera in moved:
        camera.viewmat[2, 3] += 1.0
    negative = [dataclasses.replace(frame, image=1.0 - frame.image) for frame in data]
    others = {
        "fewer": data.subset(range(5)),
        "moved": data.with_cameras(moved),
        "negative": Dataset(negative, folder=data.folder, split="train"),
    }
    for name, other in others.items():
        fit(tiny_config(40), other, output=tmp_path / name)
        told = rf"{name}: was trained on other frames than .*seed-0; give runs of one data set"
        with pytest.raises(UserError, match=told):
            load_mean([runs[0], tmp_path / name])
    with pytest.raises(UserError, match=r"seed-0: is given twice"):
        load_mean([runs[0], runs[1], str(runs[0])])


def test_an_unfinished_run_is_told(runs, tmp_path):
    config = tiny_config(40)
    shutil.copytree(runs[1], tmp_path / "part")
    mean = load_mean([runs[0], tmp_path / "part"])
    assert isinstance(mean, MeanScene) and mean.unfinished is None
    mean.scenes[1].step = 35
    assert mean.unfinished == f"step 35 of {config.steps}, unfinished"
    assert mean._repr_html_() is None
