"""Motion learnt from clouds of points: it carries what moves, holds what rests, and is the same at every run."""

from __future__ import annotations

import math

import pytest
import torch

from helpers.tiny import tiny_config
from scgs_warp.training import start_motion
from scgs_warp.training.clouds import Cloud
from scgs_warp.training.initial_models import initial_motion
from scgs_warp.training.start_motion import SeenMotion, _carried, _Target, learn_motion, start_cloud
from scgs_warp.training.tracks import gather

TIMES = tuple(moment / 12 for moment in range(13))
TURN = 100.0


def arm() -> torch.Tensor:
    """A rod of length 0.5 along x, of radius 0.05."""
    generator = torch.Generator().manual_seed(1)
    along = torch.rand(500, 1, generator=generator) * 0.5
    across = torch.randn(500, 2, generator=generator)
    return torch.cat([along, 0.05 * across / across.norm(dim=1, keepdim=True)], 1)


def turned(points: torch.Tensor, time: float) -> torch.Tensor:
    """Turn about y by ``TURN`` degrees in all, the middle of the time at rest."""
    angle = math.radians(TURN) * (time - 0.5)
    cosine, sine = math.cos(angle), math.sin(angle)
    matrix = torch.tensor([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    return points @ matrix.T


def colors_of(points: torch.Tensor) -> torch.Tensor:
    """Bright at one end, with one colour on each side."""
    return torch.stack([points[:, 0] * 2, (points[:, 1] > 0).float(), (points[:, 2] > 0).float()], 1)


def clouds(times=TIMES) -> list[Cloud]:
    """Clouds in which each moment has lost another fifth of the points, as hidden parts are."""
    found = []
    for number, time in enumerate(times):
        kept = torch.arange(len(arm())) % 5 != number % 5
        points = turned(arm(), time)[kept]
        found.append(Cloud(points, colors_of(arm())[kept], torch.ones(len(points)) > 0, time))
    return found


def seen_in(found: list[Cloud]) -> SeenMotion:
    start = [cloud.time for cloud in found].index(start_cloud(found).time)
    source, tracks = gather(found, start, 1_500, 0)
    return SeenMotion(source, found, tracks)


def wall() -> torch.Tensor:
    x, z = torch.meshgrid(torch.linspace(-1, 1, 15), torch.linspace(-1, 1, 15), indexing="ij")
    return torch.stack([x.flatten(), torch.full((x.numel(),), 0.8), z.flatten()], 1)


@pytest.fixture(scope="module")
def learnt():
    config = tiny_config(40, motion={"nodes": 80, "width": 128, "layers": 6})
    points = torch.cat([arm(), wall()])
    motion = initial_motion(config, points, moves=torch.arange(len(points)) < len(arm()))
    learn_motion(motion, seen_in(clouds()), wall(), config)
    return config, motion


def carried(learnt, points: torch.Tensor, time: float) -> torch.Tensor:
    config, motion = learnt
    seen = Cloud(points, colors_of(points), torch.ones(len(points)) > 0, 0.5)
    source = _Target(seen, 0, 0)
    source.points = points
    gaussians = _carried(source, torch.zeros(0, 3), config)
    with torch.no_grad():
        return motion.gaussians_at(gaussians, time).means


@pytest.mark.parametrize("time", TIMES)
def test_points_are_carried_to_where_they_are_seen(learnt, time):
    error = (carried(learnt, arm(), time) - turned(arm(), time)).norm(dim=1)
    moved = (turned(arm(), time) - arm()).norm(dim=1).mean()
    assert float(error.mean()) < max(0.02, 0.2 * float(moved)), (float(error.mean()), float(moved))


@pytest.mark.parametrize("time", [0.125, 0.375, 0.625, 0.875])
def test_between_moments_points_are_near_their_path(learnt, time):
    error = (carried(learnt, arm(), time) - turned(arm(), time)).norm(dim=1).mean()
    moved = (turned(arm(), time) - arm()).norm(dim=1).mean()
    assert float(error) < max(0.03, 0.35 * float(moved))


def test_what_rests_is_held(learnt):
    for time in TIMES:
        assert float((carried(learnt, wall(), time) - wall()).norm(dim=1).max()) < 0.03


def test_two_runs_give_the_same_bits(learnt):
    config, motion = learnt
    points = torch.cat([arm(), wall()])
    again = initial_motion(config, points, moves=torch.arange(len(points)) < len(arm()))
    learn_motion(again, seen_in(clouds()), wall(), config)
    one, two = motion.state_dict(), again.state_dict()
    assert [name for name in one if not torch.equal(one[name], two[name])] == []
    assert all(parameter.grad is None for parameter in again.parameters())


def test_a_few_points_and_nothing_at_rest_suffice():
    config = tiny_config(40, motion={"nodes": 12})
    points = arm()[:12]
    pair = [Cloud(points[:2] + t, points[:2], torch.ones(2) > 0, t) for t in (0.0, 1.0)]
    motion = initial_motion(config, points, moves=torch.ones(12) > 0)
    learn_motion(motion, seen_in(pair), torch.zeros(0, 3), config)
    assert all(torch.isfinite(value).all() for value in motion.state_dict().values())


def test_the_start_is_the_middle_of_the_time():
    assert start_cloud(clouds()).time == 0.5 and start_cloud(clouds((0.1, 0.45, 0.9))).time == 0.45


def test_tracks_show_what_nearest_points_cannot():
    """A disc of one colour that spins looks the same at all times; its tracks turn it."""
    generator = torch.Generator().manual_seed(4)
    angle, radius = torch.rand(500, generator=generator) * 2 * math.pi, torch.rand(500, generator=generator).sqrt()
    disc = torch.stack([0.4 * radius * angle.cos(), torch.zeros(500), 0.4 * radius * angle.sin()], 1)
    times = tuple(moment / 6 for moment in range(7))
    spinning = []
    for number, time in enumerate(times):
        later = turned(disc, times[number + 1]) if number < 6 else None
        points = turned(disc, time)
        spinning.append(Cloud(points, torch.full_like(points, 0.5), torch.ones(500) > 0, time, later))
    config = tiny_config(40, motion={"nodes": 80, "width": 128, "layers": 6})
    errors = {}
    for name, seen in (("tracks", spinning), ("nearest", [cloud._replace(later=None) for cloud in spinning])):
        motion = initial_motion(config, disc, moves=torch.ones(500) > 0)
        learn_motion(motion, seen_in(seen), wall(), config)
        apart = [(carried((config, motion), disc, time) - turned(disc, time)).norm(dim=1).mean() for time in times]
        errors[name] = float(torch.stack(apart).mean())
    still = float(torch.stack([(disc - turned(disc, time)).norm(dim=1).mean() for time in times]).mean())
    assert errors["tracks"] < 0.15 * still < 0.5 * still < errors["nearest"]


@pytest.mark.parametrize(("moments", "tracked", "steps"), [(3, False, 600), (3, True, 1500), (24, True, 6000)])
def test_each_moment_has_its_steps(monkeypatch, moments, tracked, steps):
    at = [turned(arm(), moment / (moments - 1)) for moment in range(moments)]
    seen = []
    for moment, (points, later) in enumerate(zip(at, [*at[1:], None])):
        time = moment / (moments - 1)
        seen.append(Cloud(points, colors_of(arm()), torch.ones(500) > 0, time, later if tracked else None))

    class Begun(Exception):
        pass

    def begin(total: int, text: str):
        raise Begun(total)

    monkeypatch.setattr(start_motion, "progress", begin)
    config = tiny_config(40, motion={"nodes": 12})
    motion = initial_motion(config, arm(), moves=torch.ones(500) > 0)
    with pytest.raises(Begun) as begun:
        learn_motion(motion, seen_in(seen), wall(), config)
    assert begun.value.args == (steps,)
