"""Distance of scenes before cameras that look the same way, whose optical axes do not tell it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from helpers.films import pan
from helpers.handheld import handheld
from helpers.layouts import save_json, write_nerfies, write_poses_bounds
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.data import Dataset, load
from scgs_warp.geometry.cameras import overview
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.training.dataset_advice import advise, survey
from scgs_warp.training.loop import fit
from scgs_warp.training.scene_distance import place
from scgs_warp.training.state import TrainState
from scgs_warp.types import Camera, Frame

FOCAL, WALL = 140.0, 4.0
K = torch.tensor([[FOCAL, 0.0, 80.0], [0.0, FOCAL, 60.0], [0.0, 0.0, 1.0]])


def before_a_wall(places, shifts, times, turn: float = 0.0) -> Dataset:
    """Cameras whose pictures are shifted by whole pixels; their poses turn by ``turn`` radians of noise."""
    random, frames = np.random.default_rng(0), []
    for index, (eye, picture, time) in enumerate(zip(places, pan([100 + shift for shift in shifts]), times)):
        viewmat = np.eye(4)
        viewmat[:3, :3] = cv2.Rodrigues(random.normal(0.0, 1.0, 3) * turn)[0]
        viewmat[:3, 3] = -viewmat[:3, :3] @ eye
        image = torch.from_numpy(picture).float() / 255.0
        frames.append(Frame(Camera(torch.from_numpy(viewmat).float(), K, 160, 120), time, image, name=str(index)))
    return Dataset(frames, folder=Path("wall"), split="train")


def parallel_rig() -> Dataset:
    """Five cameras, each 4 pixels of parallax from the next, at three instants."""
    columns, times = np.repeat(range(5), 3), np.tile([0.0, 0.5, 1.0], 5)
    step = 4.0 * WALL / FOCAL
    return before_a_wall([(step * column, 0.0, 0.0) for column in columns], 4 * columns, times.tolist())


def tripod(turn: float) -> Dataset:
    """A camera that stands still, whose poses say that it trembles by a thousandth of the wall's distance."""
    eyes = np.random.default_rng(1).normal(0.0, 1e-3 * WALL, (12, 3))
    return before_a_wall(eyes, [0] * 12, np.linspace(0.0, 1.0, 12).tolist(), turn)


@pytest.mark.parametrize("turn", [0.0, 1e-3])
def test_parallel_cameras_see_the_distance(turn):
    """Axes that are parallel but for errors of the poses meet anywhere."""
    data = parallel_rig()
    places = [camera.position.double().numpy() for camera in data.cameras]
    shifts = np.repeat(range(5), 3) * 4
    placed = place(before_a_wall(places, shifts, data.times.tolist(), turn))
    middle = np.mean(places, axis=0)
    assert np.linalg.norm(placed.normalisation.centre - middle) == pytest.approx(WALL, rel=0.1)
    assert placed.overview.radius == pytest.approx(WALL, rel=0.1) and not placed.guessed


@pytest.mark.parametrize("turn", [0.0, 1e-3, 1e-2])
def test_a_trembling_tripod_stands_outside_the_scene(turn):
    data = tripod(turn)
    placed = place(data)
    assert placed.guessed
    distance = float(np.linalg.norm(placed.normalisation.centre))
    assert distance > 0.4 and placed.normalisation.centre[2] > 0.9 * distance  # the poses tremble by 0.004
    for camera in data.cameras:
        assert float(placed.normalisation.apply_camera(camera).position.norm()) > 1.5
    assert "remains a guess, as they look the same way" in advise(survey(data), tiny_config())[1]


def test_pictures_without_texture_leave_a_guess():
    data = parallel_rig()
    grey = [dataclasses.replace(frame, image=torch.full_like(frame.image, 0.5)) for frame in data]
    placed = place(Dataset(grey, folder=Path("grey"), split="train"))
    spread = 2 * 4.0 * WALL / FOCAL
    assert placed.guessed and placed.normalisation.centre[2] == pytest.approx(20 * spread, rel=1e-3)


def test_axes_that_meet_tell_the_distance():
    for data in (tiny_dataset(8), handheld(20, 2.0)):
        placed, plain = place(data), Normalisation.fit(data.cameras)
        assert placed.normalisation.scale == plain.scale and (placed.normalisation.centre == plain.centre).all()
        assert placed.overview == overview(data.cameras) and not placed.guessed


def test_points_and_bounds_tell_the_distance(tmp_path):
    data = parallel_rig()
    data.points = torch.randn(100, 3, generator=torch.Generator().manual_seed(0)) * 0.3 + torch.tensor([0.2, 0.0, 7.0])
    placed = place(data)
    assert placed.normalisation.scale == Normalisation.fit(data.cameras, data.points).scale
    assert placed.overview.radius == pytest.approx(7.0, rel=0.05) and not placed.guessed
    write_poses_bounds(tmp_path)
    rows = np.load(tmp_path / "poses_bounds.npy")
    for index, row in enumerate(rows):
        row[:15] = rows[0, :15]
        row[3] += 0.1 * index
    np.save(tmp_path / "poses_bounds.npy", rows)
    data = load(tmp_path)
    assert data.bounds == (1.0, 9.0) and place(data).overview.radius == pytest.approx(1.8, rel=0.02)
    rows[:, 15:] = 0.0
    np.save(tmp_path / "poses_bounds.npy", rows)
    assert load(tmp_path).bounds is None


def test_near_and_far_of_nerfies_tell_the_distance(tmp_path):
    """They are in the scaled world, as its programs take them."""
    write_nerfies(tmp_path)
    (tmp_path / "points.npy").unlink()
    for index, file in enumerate(sorted((tmp_path / "camera").iterdir())):
        content = json.loads(file.read_text())
        save_json(file, content | {"orientation": np.eye(3).tolist(), "position": [0.01 * index, 0.0, 0.0]})
    data = load(tmp_path)
    assert data.bounds == (0.1, 9.0)
    placed = place(data)
    assert placed.overview.radius == pytest.approx(2.0 / (1 / 0.1 + 1 / 9.0), rel=0.02) and not placed.guessed
    for wrong in ({"near": 9.0}, {"near": 0.0}, {"far": "x"}, {"far": None}):
        content = json.loads((tmp_path / "scene.json").read_text())
        save_json(tmp_path / "scene.json", content | wrong)
        assert load(tmp_path).bounds is None
        save_json(tmp_path / "scene.json", content)


def test_depth_maps_tell_the_distance():
    data = tripod(1e-3)
    depth = torch.full((12, 16), 3.0)
    depth[0] = 0.0  # unknown
    mapped = [dataclasses.replace(frame, depth=depth) for frame in data]
    placed = place(Dataset(mapped, folder=Path("mapped"), split="train"))
    assert not placed.guessed and float(np.linalg.norm(placed.normalisation.centre)) == pytest.approx(3.0, rel=1e-2)


def test_a_run_continues_wherever_it_placed_the_scene(tmp_path):
    """Versions place such scenes differently."""
    config, data = tiny_config(20), tripod(1e-3)
    fit(config, data, output=tmp_path / "run")
    state = TrainState.resume(tmp_path / "run", config, data, "cpu")
    state.overview = overview(data.cameras, 0.5)
    state.save(tmp_path / "run")
    assert TrainState.resume(tmp_path / "run", config, data, "cpu").overview == state.overview
