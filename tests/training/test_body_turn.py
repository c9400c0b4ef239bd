"""Turn of the whole subject: found in silhouettes of one whose turn is known, and not where nothing turns."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.scenes import look_at
from helpers.tiny import tiny_camera, tiny_config, tiny_dataset
from scgs_warp.data.dataset import Dataset
from scgs_warp.motion.spheres import Spheres
from scgs_warp.rendering.render import render
from scgs_warp.training import second_try, second_try_config
from scgs_warp.training.body_turn import BodyTurn, find_body_turn, learn_turn, turns_round
from scgs_warp.training.initial_points import sample_initial_points
from scgs_warp.training.loop import fit
from scgs_warp.training.scene_distance import place
from scgs_warp.training.second_try_config import may_be_tried_again
from scgs_warp.training.state import TrainState
from scgs_warp.types import Camera, Frame, Gaussians

INSTANTS = 40


def arms(swing: float = 0.0) -> np.ndarray:
    """Return points [60, 3] of a body with three arms of different lengths, of which the first may swing, radians."""
    along = np.linspace(0.0, 1.0, 20)[:, None]
    first = Rotation.from_rotvec([0.0, 0.0, swing]).apply([1.1, 0.0, 0.2])
    return np.concatenate([along * first, along * [0.0, 0.7, -0.3], along * [-0.2, -0.2, 0.9]])


def spinning(instant: int) -> np.ndarray:
    """Turn by three degrees per instant about an axis that changes, and wander."""
    axis = np.array([0.2, 0.1 * np.sin(0.1 * instant), 1.0])
    turn = Rotation.from_rotvec(np.radians(3.0 * instant) * axis / np.linalg.norm(axis))
    return turn.apply(arms()) + np.array([0.3 * np.sin(0.08 * instant), 0.01 * instant, 0.0])


def waving(instant: int) -> np.ndarray:
    return arms(0.4 * np.sin(0.1 * instant)) + np.array([0.01 * instant, 0.0, 0.0])


def resting(instant: int) -> np.ndarray:
    return arms()


def beside(degrees: float, instant: int, size: int) -> Camera:
    """Return a camera that goes round the body by ``degrees`` per instant."""
    eye = 4.0 * torch.tensor(
        [math.cos(math.radians(degrees) * instant), math.sin(math.radians(degrees) * instant), 0.3]
    )
    viewmat = look_at(eye.double(), torch.zeros(3).double(), torch.tensor([0.0, 0.0, 1.0]).double())
    K = torch.tensor([[1.4 * size, 0, size / 2], [0, 1.4 * size, size / 2], [0, 0, 1]])
    return Camera(viewmat.float(), K, size, size)


def filmed(
    body: Callable[[int], np.ndarray], count: int = INSTANTS, size: int = 64, degrees: float | None = None
) -> Dataset:
    """``degrees``: per instant, by which the camera goes round the body; None: it stands elsewhere at each instant."""
    frames = []
    for instant in range(count):
        means = torch.from_numpy(body(instant)).float()
        n = len(means)
        quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(n, 4)
        colors = torch.linspace(-1.0, 1.0, n)[:, None].expand(n, 3)
        shape = torch.full((n, 3), 0.07), torch.full((n,), 0.95)
        camera = tiny_camera(instant, count, size) if degrees is None else beside(degrees, instant, size)
        with torch.no_grad():
            image = render(Gaussians(means, quats, *shape, colors, torch.zeros(n, 0, 3)), camera, torch.zeros(3))
        time = instant / (count - 1)
        frames.append(Frame(camera, time, image.rgb.clamp(0, 1), image.alpha, None, f"train_{instant:03d}"))
    return Dataset(frames, folder=Path("spun"), split="train")


@pytest.fixture(scope="module")
def spun() -> Dataset:
    return filmed(spinning)


@pytest.fixture(scope="module")
def found(spun) -> BodyTurn:
    turn = find_body_turn(spun, place(spun).normalisation)
    assert turn is not None
    return turn


def test_the_turn_is_found(found):
    assert len(found.times) == len(found.rotations) == len(found.centres) == INSTANTS
    spread = [spinning(instant) - spinning(instant)[0] for instant in range(INSTANTS)]
    true = np.stack([Rotation.align_vectors(one, spread[INSTANTS // 2])[0].as_matrix() for one in spread])
    off = np.degrees(Rotation.from_matrix(found.rotations @ true.transpose(0, 2, 1)).magnitude())
    assert off.max() < 15.0 and np.median(off) < 8.0, "of 117 degrees"
    assert found.total == pytest.approx(117.0, abs=15.0)
    assert np.allclose(found.rotations[INSTANTS // 2], np.eye(3))


def test_points_are_carried_with_the_body(found, spun):
    to = place(spun).normalisation.apply
    middle = to(torch.from_numpy(spinning(INSTANTS // 2))).float()
    assert torch.allclose(found.carry(middle, 20 / 39), middle, atol=1e-5)
    for instant in (0, 10, 30, 39):
        there = to(torch.from_numpy(spinning(instant))).float()
        apart = (found.carry(middle, instant / 39) - there).norm(dim=1).mean()
        assert apart < 0.2 * found.radius
        assert apart < 0.4 * (middle - there).norm(dim=1).mean()


@pytest.mark.parametrize("body", [waving, resting])
def test_nothing_is_found_where_the_body_does_not_turn(body):
    data = filmed(body)
    assert not turns_round(data, place(data).normalisation)
    assert find_body_turn(data, place(data).normalisation) is None


@pytest.mark.parametrize("degrees", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("body", [waving, resting, spinning])
def test_nothing_is_found_in_views_from_one_side(body, degrees):
    """They fit many turns as well as the true one, so that a body at rest seemed to turn."""
    data = filmed(body, degrees=degrees)
    assert not turns_round(data, place(data).normalisation)


def test_nothing_is_found_with_too_few_instants_or_without_silhouettes(spun):
    few = filmed(spinning, 23)
    assert find_body_turn(few, place(few).normalisation) is None
    filled = Dataset([dataclasses.replace(frame, alpha=None) for frame in spun], folder=spun.folder, split="train")
    assert find_body_turn(filled, place(filled).normalisation) is None
    empty = [dataclasses.replace(frame, alpha=torch.zeros(64, 64)) for frame in spun]
    assert find_body_turn(Dataset(empty, folder=spun.folder, split="train"), place(spun).normalisation) is None


def test_initial_points_lie_where_the_turning_body_is(found, spun):
    normalisation = place(spun).normalisation
    body = normalisation.apply(torch.from_numpy(spinning(INSTANTS // 2))).float()

    def near(turn: BodyTurn | None) -> float:
        points = sample_initial_points(2_000, spun, normalisation, 0, turn)[0]
        return float((torch.cdist(points, body).amin(1) < 0.15 * found.radius).float().mean())

    assert near(found) > 1.2 * near(None)


def begun(config, data: Dataset, turn: BodyTurn | None) -> tuple[TrainState, Spheres]:
    state = TrainState.begin(config, data, "cpu", turn)
    assert isinstance(state.motion, Spheres)
    return state, state.motion


def test_the_network_learns_the_turn(found, spun):
    config = tiny_config(40, pretrain={"steps": 12, "warm_up": 5})
    state, spheres = begun(config, spun, found)
    points, told = state.gaussians.means.detach(), []
    learn_turn(spheres, points, found, 7, 0, told.append)
    assert spheres.held == 7 and len(told) > 10
    for time in (0.0, 0.3, 1.0):
        with torch.no_grad():
            moved = points + spheres.translations(points, torch.tensor([time]))[0]
        assert (moved - found.carry(points, time)).norm(dim=1).mean() < 0.15 * found.radius


def test_a_network_that_is_held_does_not_learn(found, spun):
    config = tiny_config(40, pretrain={"steps": 12, "warm_up": 0})
    _, spheres = begun(config, spun, found)
    spheres.held = 5
    before, after = spheres.rates(4, config), spheres.rates(5, config)
    network = [name for name in before if name.startswith("network.")]
    assert network and all(before[name] == 0.0 < after[name] for name in network)
    assert before["log_radius"] > 0.0


def test_a_subject_that_turns_is_tried_again_with_fewer_steps(spun, monkeypatch):
    config = tiny_config(5_000, pretrain={"steps": 600})
    assert may_be_tried_again(config, spun, thin=False)
    short = tiny_config(5_000, pretrain={"steps": 499})
    assert not may_be_tried_again(short, spun, thin=False)
    assert not may_be_tried_again(config, filmed(resting), thin=False)
    monkeypatch.setattr(second_try_config, "is_one_piece", lambda data: False)
    assert not may_be_tried_again(config, spun, thin=False)


def test_the_second_try_begins_with_the_turn(found, tmp_path, device, monkeypatch):
    """Found from other images here, to spare time."""
    monkeypatch.setattr(second_try_config, "LEAST_VISITS", 1)
    config = tiny_config(40, pretrain={"steps": 20, "densify_until": 8, "warm_up": 3, "progressive_every": 1})
    asked, seen = [], []
    monkeypatch.setattr(second_try, "find_body_turn", lambda data, normalisation, tell: asked.append(data) or found)
    monkeypatch.setattr(second_try, "is_one_piece", lambda data: True)
    take = second_try.take_step

    def noted(state, frames, *rest, **options):
        seen.append((state.motion.held, state.config.pretrain.warm_up, state.config.pretrain.progressive))
        return take(state, frames, *rest, **options)

    monkeypatch.setattr(second_try, "take_step", noted)
    fit(config, tiny_dataset(6), output=tmp_path / "run", device=device)
    assert len(asked) == 1 and seen == 20 * [(2, 0, False)]
    assert "turned by" in (tmp_path / "run/log.jsonl").read_text()
