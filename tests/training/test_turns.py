"""Turns of round bodies: found in the views of a ball whose turns are known, and not where nothing turns."""

from __future__ import annotations

import dataclasses
import json
import signal
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.config.presets import preset
from scgs_warp.data import load
from scgs_warp.data.dataset import Dataset
from scgs_warp.gaussians import gaussians_from_points
from scgs_warp.storage import checkpoint
from scgs_warp.training import loop, round_bodies, turns
from scgs_warp.training.frames import Frames
from scgs_warp.training.loop import fit
from scgs_warp.training.round_bodies import RoundBody, find_round_bodies
from scgs_warp.training.state import TrainState
from scgs_warp.training.turn_search import CLEARER, LONG, find_turns
from scgs_warp.training.turn_views import Views

INSTANTS, SIZE, FOCAL, RADIUS = 36, 72, 100.0, 0.4


def sphere(count: int) -> np.ndarray:
    """Return directions [count, 3] all around."""
    number = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1.0 - 2.0 * number / count), np.pi * (1.0 + 5.0**0.5) * number
    return np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], 1)


def spots(directions: np.ndarray) -> np.ndarray:
    """Return the colours [..., 3] of a spotted ball in directions [..., 3] of its own frame."""
    waves = np.array([[5.0, 1.0, -2.0], [-1.0, 4.0, 3.0], [2.0, -3.0, 5.0]])
    return 0.5 + 0.4 * np.sin(directions @ waves.T)


def plain(directions: np.ndarray) -> np.ndarray:
    """Return one colour for all directions."""
    return np.full(directions.shape, 0.6)


def spin(instant: float) -> np.ndarray:
    """Return the rotation of the ball, which changes its axis and its speed."""
    share = instant / (INSTANTS - 1)
    turn = Rotation.from_rotvec(np.radians(4.0 * instant) * np.array([0.2, 0.3, 1.0]) / np.linalg.norm([0.2, 0.3, 1.0]))
    return (Rotation.from_rotvec([0.5 * share**2, 0.3 * share, 0.0]) * turn).as_matrix()


def still(instant: float) -> np.ndarray:
    return np.eye(3)


def centre(instant: int) -> np.ndarray:
    """Return the centre of the ball, which moves."""
    share = instant / (INSTANTS - 1)
    return np.array([0.3 * np.sin(4.0 * share), 0.2 * share, 0.25 * np.cos(5.0 * share)])


def here(instant: int) -> np.ndarray:
    return np.zeros(3)


def viewmat(instant: int) -> np.ndarray:
    """Return the camera of an instant, [4, 4]: all around, far from those of its neighbours."""
    angle, height = 2.4 * instant, 1.2 * np.sin(1.7 * instant)
    eye = 3.0 * np.array([np.cos(angle), np.sin(angle), height]) / np.hypot(1.0, height)
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = rotation, -rotation @ eye
    return made


def picture(
    instant: int,
    turn: Callable[[float], np.ndarray],
    paint: Callable[[np.ndarray], np.ndarray],
    place: Callable[[int], np.ndarray] = centre,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the ball: colours [H, W, 3], black around it, and depth [H, W], infinite around it."""
    camera = viewmat(instant)
    row, column = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    rays = np.stack([column / FOCAL, row / FOCAL, np.ones_like(row)], -1)
    middle = camera[:3, :3] @ place(instant) + camera[:3, 3]
    along, squared = rays @ middle, (rays**2).sum(-1)
    root = along**2 - squared * (middle @ middle - RADIUS**2)
    depth = np.where(root > 0, (along - np.sqrt(np.maximum(root, 0))) / squared, np.inf)
    outward = (np.where(root > 0, depth, 0.0)[..., None] * rays - middle) @ camera[:3, :3] / RADIUS
    color = np.where((root > 0)[..., None], paint(outward @ turn(instant)), 0.0)
    return color.astype(np.float32), depth.astype(np.float32)


def views_of(turn: Callable[[float], np.ndarray], paint: Callable[[np.ndarray], np.ndarray]) -> Views:
    drawn = [picture(instant, turn, paint) for instant in range(INSTANTS)]
    K = np.array([[FOCAL, 0.0, SIZE / 2], [0.0, FOCAL, SIZE / 2], [0.0, 0.0, 1.0]])
    viewmats = np.stack([viewmat(instant) for instant in range(INSTANTS)])
    intrinsics = np.broadcast_to(K, (INSTANTS, 3, 3))
    return Views(np.arange(INSTANTS), viewmats, intrinsics, [c for c, _ in drawn], [d for _, d in drawn])


def tracks_of(directions: np.ndarray) -> np.ndarray:
    """Return the tracks [T, n, 3] of points that move with the ball, but do not turn."""
    return np.stack([centre(instant) + RADIUS * directions for instant in range(INSTANTS)]).astype(np.float32)


def ball(views: Views) -> RoundBody:
    tracks = tracks_of(sphere(400))
    (body,) = find_round_bodies(tracks, np.ones(400, bool), views)
    return body


def off_by(found: np.ndarray, true: Callable[[float], np.ndarray]) -> np.ndarray:
    """Return the error of the turn over 12 instants, degrees."""
    first, last = np.arange(INSTANTS - 12), np.arange(12, INSTANTS)
    wanted = np.stack([true(b) @ true(a).T for a, b in zip(first.tolist(), last.tolist())])
    got = found[last] @ found[first].transpose(0, 2, 1)
    return np.degrees(Rotation.from_matrix(got @ wanted.transpose(0, 2, 1)).magnitude())


def test_the_body_of_a_ball():
    views = views_of(spin, spots)
    body = ball(views)
    assert np.abs(body.centres - np.stack([centre(i) for i in range(INSTANTS)])).max() < 0.02
    assert body.radius == pytest.approx(RADIUS, abs=0.02)
    assert np.abs(body.rotations - np.eye(3)).max() < 1e-3
    assert len(body.points) > 300


def test_turns_are_found_to_a_few_degrees():
    views = views_of(spin, spots)
    found = find_turns(ball(views), views)
    assert found is not None
    assert found.clearer < 0.5
    assert np.abs(found.rotations[INSTANTS // 2] - np.eye(3)).max() < 1e-9
    errors = off_by(found.rotations, spin)
    assert errors.max() < 6.0, errors
    assert off_by(np.stack([np.eye(3)] * INSTANTS), spin).min() > 40.0


@pytest.mark.parametrize(("turn", "paint"), [(still, spots), (spin, plain), (still, plain)])
def test_no_turns_where_nothing_turns_or_shows_it(turn, paint):
    views = views_of(turn, paint)
    assert find_turns(ball(views), views) is None


def test_noise_is_not_taken_for_a_turn():
    views = views_of(still, plain)
    random = np.random.default_rng(0)
    noisy = [color + random.normal(0.0, 0.1, color.shape).astype(np.float32) for color in views.colors]
    assert find_turns(ball(views), views._replace(colors=noisy)) is None


def test_the_colour_of_the_light_is_no_turn():
    """Each view is lit by another colour; only the pattern may tell."""
    views = views_of(spin, spots)
    tints = np.random.default_rng(1).uniform(-0.3, 0.3, (INSTANTS, 1, 1, 3)).astype(np.float32)
    found = find_turns(ball(views), views._replace(colors=[c + t for c, t in zip(views.colors, tints)]))
    assert found is not None and off_by(found.rotations, spin).max() < 6.0


def test_too_few_instants():
    views = views_of(spin, spots)
    kept = LONG - 1
    few = Views(views.instants[:kept], views.viewmats[:kept], views.intrinsics[:kept], views.colors, views.depths)
    body = ball(views)
    assert find_turns(body._replace(centres=body.centres[:kept], rotations=body.rotations[:kept]), few) is None


def test_bodies_are_told_apart_and_long_ones_left_out():
    views = views_of(still, plain)
    round_one = tracks_of(sphere(300))
    line = np.linspace(-1.0, 1.0, 300)[:, None] * np.array([0.0, 0.0, 1.0]) + np.array([2.0, 0.0, 0.0])
    rod = np.broadcast_to(line.astype(np.float32), (INSTANTS, 300, 3))
    bodies = find_round_bodies(np.concatenate([rod, round_one], 1), np.ones(600, bool), views)
    assert [sorted(body.members) for body in bodies] == [list(range(300, 600))]
    assert find_round_bodies(round_one, np.zeros(300, bool), views) == []


@pytest.fixture(scope="module")
def spinning(tmp_path_factory) -> Dataset:
    """Pictures of the spotted ball that spins in one place."""
    folder = tmp_path_factory.mktemp("spinning")
    frames = []
    for instant in range(INSTANTS):
        color, depth = picture(instant, spin, spots, here)
        alpha = np.isfinite(depth)[..., None].astype(np.float32)
        pixels = (np.concatenate([color[..., ::-1], alpha], -1) * 255.0 + 0.5).astype(np.uint8)
        cv2.imwrite(str(folder / f"{instant:03d}.png"), pixels)
        pose = np.linalg.inv(viewmat(instant)) @ np.diag([1.0, -1.0, -1.0, 1.0])
        time = instant / (INSTANTS - 1)
        frames.append({"file_path": f"{instant:03d}", "time": time, "transform_matrix": pose.tolist()})
    document = {"camera_angle_x": 2.0 * np.arctan(0.5 * SIZE / FOCAL), "frames": frames}
    (folder / "transforms_train.json").write_text(json.dumps(document))
    return load(folder, "train")


def grey_ball(data: Dataset, device: str) -> TrainState:
    """Begin the main stage with opaque grey Gaussians on the ball, which rest."""
    config = dataclasses.replace(preset("cpu"), init_points=600)
    state = TrainState.begin(config, data, device)
    state.begin_main()
    state.step = config.pretrain_steps
    places = state.normalisation.apply(torch.from_numpy(RADIUS * sphere(600)).float()).to(device)
    options = {"hyper_columns": config.motion.hyper_columns, "shaded": True, "corrected": True}
    gaussians = gaussians_from_points(places, None, sh_degree=3, scale=0.4, sharpness=config.sharpness, **options)
    with torch.no_grad():
        gaussians.opacity_logits.fill_(4.0)
        gaussians.shading.fill_(0.1)
    state.enter(gaussians, state.motion)
    return state


def frames_of(state: TrainState, data: Dataset) -> Frames:
    return Frames(data, state.normalisation, state.config, str(state.device), None)


@torch.no_grad()
def error(state: TrainState, data: Dataset) -> float:
    """Return the mean squared error over the views."""
    scene = state.scene()
    scene.motion.eval()
    drawn = [
        (scene.render(frame.camera, frame.time).rgb.cpu(), frame.image)
        for frame in map(data.__getitem__, range(len(data)))
    ]
    return float(np.mean([float((rgb - image).square().mean()) for rgb, image in drawn]))


def test_the_motion_takes_the_turns_and_the_gaussians_their_colours(spinning, device, monkeypatch):
    monkeypatch.setattr(turns, "STEPS", 800)
    monkeypatch.setattr(turns, "TRIAL", 0.01)
    state = grey_ball(spinning, device)
    grey = error(state, spinning)
    note = turns.add_turns(state, frames_of(state, spinning))
    assert note is not None and note.startswith("1 round body turns by ")
    assert error(state, spinning) < 0.6 * grey
    assert float(state.gaussians.shading.detach().abs().max()) == 0.0
    assert state.motion.graph is None

    motion, times = state.motion, spinning.times
    motion.eval()
    with torch.no_grad():
        first, last = (motion.gaussians_at(state.gaussians, float(times[i])).means for i in (12, 24))
    moved = rotation_between(first.cpu().numpy(), last.cpu().numpy())
    wanted = spin(24) @ spin(12).T
    assert np.degrees(Rotation.from_matrix(moved @ wanted.T).magnitude()) < 12.0


def rotation_between(first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Fit the rotation [3, 3] about the origin from points to points (Kabsch)."""
    left, _, right = np.linalg.svd(last.T @ first)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def test_the_result_does_not_depend_on_the_threads(spinning, monkeypatch):
    monkeypatch.setattr(turns, "STEPS", 20)
    monkeypatch.setattr(turns, "TRIAL", 0.001)
    monkeypatch.setattr(turns, "MOST_LOSS", 100.0)
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        state = grey_ball(spinning, "cpu")
        assert turns.add_turns(state, frames_of(state, spinning)) is not None
        results.append(state.scene().tensors())
    torch.set_num_threads(1)
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])


def schedule(step: int, **changes) -> bool:
    config = preset("cpu")
    motion = turns.ControlPoints.__new__(turns.ControlPoints)
    state = SimpleNamespace(
        config=dataclasses.replace(config, **changes),
        stage="main",
        stage_step=step,
        group=None,
        exposure_optimizer=None,
        gaussians=[None] * 1000,
        motion=motion,
    )
    data = SimpleNamespace(with_alpha=True, times=torch.linspace(0, 1, LONG))
    return turns.turns_due(cast("Any", state), cast("Any", data))


def test_turns_are_due_before_opacity_resets_from_the_second_on():
    due = [step for step in range(24_000) if schedule(step)]
    assert due == [5_999, 8_999, 11_999]


def test_turns_are_off_where_they_cannot_be_found():
    config = preset("cpu")
    assert schedule(5_999)
    assert not schedule(5_999, motion=dataclasses.replace(config.motion, turns=False))
    assert not schedule(5_999, pretrain=dataclasses.replace(config.pretrain, steps=0))
    assert not schedule(5_999, freeze=6_000)
    assert preset("best").motion.turns and not preset("paper").motion.turns and not preset("quick").motion.turns
    assert CLEARER < 1.0


def test_turns_that_show_the_views_worse_change_nothing(spinning, device, monkeypatch):
    monkeypatch.setattr(turns, "STEPS", 20)
    monkeypatch.setattr(turns, "TRIAL", 0.001)
    monkeypatch.setattr(turns, "MOST_LOSS", -100.0)
    state = grey_ball(spinning, device)
    before = {name: value.clone() for name, value in state.scene().tensors().items()}
    models = state.gaussians, state.motion, state.gaussian_optimizer, state.stats
    assert turns.add_turns(state, frames_of(state, spinning)) is None
    assert all(torch.equal(value, before[name]) for name, value in state.scene().tensors().items())
    assert (state.gaussians, state.motion, state.gaussian_optimizer, state.stats) == models


def test_a_mirrored_fit_is_no_rotation():
    """A nearly flat body whose small bumps have changed sides is mirrored with less error than turned."""
    flat, bumps = sphere(60) * np.array([1.0, 1.0, 0.0]), sphere(60) * np.array([0.0, 0.0, 1e-3])
    wanted = Rotation.from_rotvec([0.2, -0.4, 0.9]).as_matrix()
    tracks = np.stack([flat + bumps, flat + bumps, (flat - bumps) @ wanted.T])
    assert np.abs(round_bodies._rotations(tracks)[2] - wanted).max() < 1e-3


def test_bodies_that_touch_for_a_moment_are_two():
    first = tracks_of(sphere(200))
    apart = np.zeros((INSTANTS, 1, 3), np.float32)
    apart[:, 0, 0] = 2.0 * RADIUS + np.linspace(0.0, 1.0, INSTANTS)
    labels = round_bodies._together(np.concatenate([first, first + apart], 1))
    assert labels.max() == 1 and (labels[:200] == labels[0]).all() and (labels[200:] == labels[200]).all()


def test_long_bodies_are_left_out(monkeypatch):
    views, tracks = views_of(still, plain), tracks_of(sphere(300))
    for stretch, count in ((1.5, 1), (2.5, 0)):
        points = RADIUS * sphere(200) * np.array([1.0, 1.0, stretch])
        monkeypatch.setattr(round_bodies, "_surface", lambda *_, points=points: points)
        assert len(find_round_bodies(tracks, np.ones(300, bool), views)) == count


def test_bodies_of_a_few_pixels_are_left_out(monkeypatch):
    views, tracks = views_of(spin, spots), tracks_of(sphere(300))
    pixels = RADIUS * FOCAL / 3.0
    for smallest, count in ((0.9 * pixels, 1), (1.1 * pixels, 0)):
        monkeypatch.setattr(round_bodies, "SMALLEST", smallest)
        assert len(find_round_bodies(tracks, np.ones(300, bool), views)) == count


def test_a_run_that_is_stopped_while_it_looks_for_turns_repeats_this(tmp_path, monkeypatch):
    config, data, looked = tiny_config(30, pretrain={"steps": 8}), tiny_dataset(6), []

    def add(state, frames, tell):
        looked.append(state.step)
        if len(looked) == 1:
            signal.raise_signal(signal.SIGINT)
        tell("looking")
        with torch.no_grad():
            state.gaussians.sh_dc += 0.1
        return "1 round body turns"

    monkeypatch.setattr(loop, "turns_due", lambda state, data: state.step == 20)
    monkeypatch.setattr(loop, "add_turns", add)
    with pytest.raises(KeyboardInterrupt):
        fit(config, data, output=tmp_path / "run")
    assert checkpoint.read(tmp_path / "run", ())[1]["step"] == 20
    resumed = fit(config, data, output=tmp_path / "run", resume=True).tensors()
    assert looked == [20, 20]
    whole = fit(config, data, output=tmp_path / "whole").tensors()
    assert looked == [20, 20, 20]
    assert all(torch.equal(resumed[name], whole[name]) for name in whole)
    for run in ("run", "whole"):
        lines = (tmp_path / run / "log.jsonl").read_text(encoding="utf-8").splitlines()
        assert sum("round body" in line for line in lines) == 1
