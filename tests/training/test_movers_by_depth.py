"""Points of what moves in a film with depth maps: where they lie, what counts as moving, and how training uses them."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import pytest
import torch

from helpers.ball_and_wall import ball, filmed, scene, walking_camera, wall
from helpers.tiny import tiny_config
from scgs_warp.data.dataset import Dataset
from scgs_warp.gaussians import SH_C0
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.rendering.render import render
from scgs_warp.training import movers_by_depth as depth_module
from scgs_warp.training import points_on_movers as module
from scgs_warp.training.clouds import Cloud
from scgs_warp.training.depth import Depths
from scgs_warp.training.flow import Flows
from scgs_warp.training.movers_by_depth import GHOST, depth_clouds, on_movers
from scgs_warp.training.points_on_movers import points_on_movers
from scgs_warp.training.state import TrainState

COUNT = 24
WALKS = [(walking_camera(0.3 * index / (COUNT - 1)), index / (COUNT - 1)) for index in range(COUNT)]


def place_at(time: float) -> torch.Tensor:
    """The ball moves to the right and towards the camera, by more than the camera moves."""
    return torch.tensor([1.6 * time - 0.8, -0.8 * time, 0.2])


def with_depth(data: Dataset, factor: float = 1.0) -> Dataset:
    frames = []
    for frame in data:
        with torch.no_grad():
            image = render(scene(place_at(frame.time)), frame.camera)
        depth = torch.where(image.alpha > 0.9, factor * image.depth, 0.0)
        frames.append(dataclasses.replace(frame, depth=depth))
    return Dataset(frames, folder=data.folder, split="train", points=data.points, colors=data.colors)


@pytest.fixture(scope="module")
def film() -> Dataset:
    return with_depth(filmed(WALKS, place_at))


def clouds_of(data: Dataset, count: int = 500) -> tuple[list[Cloud], Normalisation]:
    normalisation = Normalisation.fit(data.cameras, data.points)
    views = [normalisation.apply_camera(camera) for camera in data.cameras]
    return depth_clouds(count, data, Flows(data, views), Depths(data, views, normalisation.scale), 0), normalisation


def test_clouds_lie_on_the_ball_at_every_moment(film):
    clouds, normalisation = clouds_of(film)
    assert len(clouds) >= 0.8 * COUNT and [cloud.time for cloud in clouds] == sorted(cloud.time for cloud in clouds)
    for cloud in clouds:
        places = normalisation.undo(cloud.points)
        distances = (places - place_at(cloud.time)).norm(dim=1)
        assert 100 <= len(places) <= 500 and cloud.moves.all()
        assert float((distances - 0.5).abs().median()) < 0.06, "the ball has a radius of 0.5"
        assert float((distances < 0.65).float().mean()) > 0.8, cloud.time


def test_points_are_followed_to_the_next_moment(film):
    """Flow and the depth there say where a point has gone: with the ball, which does not turn."""
    clouds, normalisation = clouds_of(film)
    for one, two in itertools.pairwise(clouds):
        assert one.later is not None
        known = one.later.isfinite().all(1)
        there, here = (normalisation.undo(points[known]) for points in (one.later, one.points))
        moved = place_at(two.time) - place_at(one.time)
        errors = (there - here - moved).norm(dim=1) / moved.norm()
        assert float(known.float().mean()) > 0.5 and float(errors.median()) < 0.5, one.time
    assert clouds[-1].later is None


def test_a_mover_that_goes_away_is_found_at_every_moment(film, monkeypatch):
    """It covers fewer and fewer pixels."""
    numbers = iter([*range(1000, 0, -40), 0, 0])
    found = depth_module._cloud
    monkeypatch.setattr(depth_module, "_cloud", lambda *arguments: (found(*arguments)[0], next(numbers)))
    moments = [cloud.time for cloud in clouds_of(film)[0]]
    assert moments == [entry.time for entry in film.entries][: len(moments)]
    assert len(moments) == 20, "those with 40 % of 520, the median"


def test_colours_are_those_of_the_image(film):
    clouds, normalisation = clouds_of(film)
    errors = []
    for cloud in clouds:
        own = ball(place_at(cloud.time))
        nearest = torch.cdist(normalisation.undo(cloud.points), own.means).argmin(1)
        colors = (own.sh_dc * SH_C0 + 0.5).clamp(0, 1)
        errors.append(float((cloud.colors - colors[nearest]).abs().mean()))
    assert sum(errors) / len(errors) < 0.065


def test_nothing_moves_where_nothing_does():
    def resting(time: float) -> torch.Tensor:
        return torch.tensor([0.0, 0.0, 0.2])

    frames = []
    for frame in filmed(WALKS, resting):
        with torch.no_grad():
            frames.append(dataclasses.replace(frame, depth=render(scene(resting(0.0)), frame.camera).depth))
    still = Dataset(frames, folder=Path("film"), split="train", points=wall().means[::10])
    assert clouds_of(still)[0] == []


def test_depth_that_is_a_few_percent_wrong_makes_nothing_move():
    """The tolerance grows with the parallax: the wall, 4 % too near, does not move."""
    data = filmed(WALKS, None)
    frames = []
    for frame in data:
        with torch.no_grad():
            frames.append(dataclasses.replace(frame, depth=0.96 * render(wall(), frame.camera).depth))
    assert clouds_of(Dataset(frames, folder=data.folder, split="train", points=data.points))[0] == []


def test_the_same_points_every_time_and_others_with_another_seed(film):
    one, two = (clouds_of(film, 100)[0] for _ in range(2))
    assert all(torch.equal(a.points, b.points) for a, b in zip(one, two, strict=True))
    normalisation = Normalisation.fit(film.cameras, film.points)
    views = [normalisation.apply_camera(camera) for camera in film.cameras]
    other = depth_clouds(100, film, Flows(film, views), Depths(film, views, normalisation.scale), 1)
    assert not torch.equal(one[0].points, other[0].points)


def test_sparse_points_on_the_mover_are_ghosts():
    clouds = [
        Cloud(torch.rand(200, 3, generator=torch.Generator().manual_seed(k)) + k, torch.zeros(200, 3),
                      torch.ones(200, dtype=torch.bool), float(k))
        for k in (0, 1)
    ]  # fmt: skip
    spacing = torch.cdist(clouds[0].points, clouds[0].points).fill_diagonal_(9.0).min(1).values.median()
    far = clouds[0].points.min(0).values - 2.0 * GHOST * spacing
    points = torch.cat([clouds[0].points[:5], clouds[1].points[:5] + 0.5 * spacing, far[None], torch.full((3, 3), 9.0)])
    assert on_movers(points, clouds).tolist() == [True] * 10 + [False] * 4


def test_training_begins_with_the_cloud_of_the_middle_and_without_ghosts(film):
    """Sparse points on the ball at other moments are dropped, and the network moves the ball's points before step 1."""
    fronts = []
    for time in (0.1, 0.9):  # what the camera sees of the ball
        means = ball(place_at(time)).means
        fronts.append(means[means[:, 1] < place_at(time)[1] - 0.2][::2])
    ghosts = torch.cat(fronts)
    points = torch.cat([film.points, ghosts])
    data = Dataset(film.entries, folder=film.folder, split="train", points=points, colors=torch.full_like(points, 0.5))
    normalisation = Normalisation.fit(data.cameras, data.points)
    known = normalisation.apply(points).float()
    found = points_on_movers(300, 1_000, known, data, normalisation, 0)
    assert abs(found.seen.time - 0.5) < 0.05 and found.motion is not None and len(found.motion.clouds) > 10
    rest, dropped = found.keep[: len(film.points)], ~found.keep[len(film.points) :]
    assert float(rest.float().mean()) > 0.9
    assert float(dropped.float().mean()) > 0.8
    config = tiny_config(100, flow_points=300, init_points=1_000, pretrain={"steps": 0})
    state = TrainState.begin(config, data, "cpu")
    start = normalisation.apply(place_at(0.5)[None]).float()
    own = (state.gaussians.means.detach() - start).norm(dim=1) < 0.6 * normalisation.scale
    errors = []
    with torch.no_grad():
        for time in (0.1, 0.9):
            moved = state.motion.gaussians_at(state.gaussians, time).means[own].median(0).values
            there, here = (normalisation.apply(place_at(each)[None]).float()[0] for each in (time, 0.5))
            still = state.gaussians.means[own].median(0).values
            errors.append(float(((moved - still) - (there - here)).norm() / (there - here).norm()))
    assert max(errors) < 0.3, "the points of the ball go where it goes"


def test_a_few_useless_maps_do_not_replace_flow(film, monkeypatch):
    """Without a cloud from maps, points come from flow as they would without any map."""
    bare = filmed(WALKS, place_at)
    blank = dataclasses.replace(bare[0], depth=torch.zeros(8, 8))
    data = Dataset([blank, *bare[1:]], folder=film.folder, split="train", points=bare.points, colors=bare.colors)
    normalisation = Normalisation.fit(data.cameras, data.points)
    known = normalisation.apply(data.points).float()
    asked = []
    monkeypatch.setattr(module, "flow_cloud", lambda *given: asked.append(given))
    found = points_on_movers(300, 10_000, known, data, normalisation, 0)
    assert len(asked) == 1 and found.motion is None and bool(found.keep.all())


def test_a_small_number_of_points_is_no_lack_of_them(film):
    clouds, _ = clouds_of(film, 30)
    assert len(clouds) >= 0.8 * COUNT and all(len(cloud.points) == 30 for cloud in clouds)
