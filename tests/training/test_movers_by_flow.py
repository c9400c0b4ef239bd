"""Initial points of what moves: where they lie, which are known to move, and that runs begin on them."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from helpers.ball_and_wall import SIZE, ball, filmed, walking_camera
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.data.dataset import Dataset
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.training.movers_by_flow import flow_cloud
from scgs_warp.training.state import TrainState

COUNT = 30
TIMES = [index / (COUNT - 1) for index in range(COUNT)]


def place_at(time: float) -> torch.Tensor:
    """The ball rises by 0.15, a little to the right, and comes back."""
    return (1 - abs(2 * time - 1)) * torch.tensor([0.03, 0.0, 0.15])


@pytest.fixture(scope="module")
def film() -> Dataset:
    """Frames of wall and ball, with a tenth of the wall as sparse points."""
    return filmed([(walking_camera(time), time) for time in TIMES], place_at)


def found_in(film: Dataset, count: int = 1000):
    normalisation = Normalisation.fit(film.cameras, film.points)
    views = [normalisation.apply_camera(camera) for camera in film.cameras]
    found = flow_cloud(count, normalisation.apply(film.points).float(), film, views)
    assert found is not None
    places = found.points.double() / normalisation.scale + torch.as_tensor(normalisation.centre)
    return found, places


def test_points_lie_on_the_wall_and_on_the_ball_of_one_instant(film):
    found, places = found_in(film)
    centre = place_at(found.time).double()
    moving, still = places[found.moves], places[~found.moves]
    assert len(moving) > 200 and len(still) > 200
    # Those at the ball's outline may lie between ball and wall.
    assert float(((moving - centre).norm(dim=1) < 0.9).double().mean()) > 0.6
    assert float((moving[:, 1] > 1.9).double().mean()) < 0.05
    assert float((still[:, 1] - 2.0).abs().median()) < 0.3, "of a distance of six"


def test_points_have_the_colours_of_their_pixels(film):
    found, places = found_in(film)
    frame = film[TIMES.index(found.time)]
    local = places @ frame.camera.viewmat[:3, :3].double().T + frame.camera.viewmat[:3, 3].double()
    flat = local @ frame.camera.K.double().T
    columns, rows = (flat[:, :2] / flat[:, 2:]).long().T
    seen = frame.image[rows.clamp(0, SIZE - 1), columns.clamp(0, SIZE - 1)]
    assert float((seen - found.colors).abs().mean()) < 0.06


def test_the_number_is_bounded_and_the_choice_repeatable(film):
    found, again = found_in(film, 300)[0], found_in(film, 300)[0]
    assert len(found.points) <= 300 and found.time == again.time
    assert torch.equal(found.points, again.points) and torch.equal(found.moves, again.moves)


def test_cameras_that_rest_give_none(film):
    still = film.with_cameras([film.cameras[0]] * len(film))
    normalisation = Normalisation.fit(film.cameras, film.points)
    views = [normalisation.apply_camera(camera) for camera in still.cameras]
    assert flow_cloud(100, normalisation.apply(film.points).float(), still, views) is None


def test_a_mover_that_has_sparse_points_needs_no_others(film):
    points = torch.cat([film.points, ball(place_at(0.5)).means[::3]])
    normalisation = Normalisation.fit(film.cameras, film.points)
    views = [normalisation.apply_camera(camera) for camera in film.cameras]
    assert flow_cloud(100, normalisation.apply(points).float(), film, views) is None


def test_a_film_of_what_stands_still_needs_none():
    still = filmed([(walking_camera(time), time) for time in TIMES], None)
    normalisation = Normalisation.fit(still.cameras, still.points)
    views = [normalisation.apply_camera(camera) for camera in still.cameras]
    assert flow_cloud(100, normalisation.apply(still.points).float(), still, views) is None


def test_half_of_the_control_points_begin_on_the_mover(film):
    config = tiny_config(40, init_points=1200, flow_points=600, motion={"nodes": 64})
    state = TrainState.begin(config, film, "cpu")
    positions = state.motion.control_points_at(0.0)
    places = positions.double() / state.normalisation.scale + torch.as_tensor(state.normalisation.centre)
    assert int((places[:, 1] < 1.0).sum()) >= 16, "before the wall"
    radii = state.motion.log_radii.detach().exp()
    assert float(radii[:32].median()) < float(radii[32:].median())
    without = TrainState.begin(dataclasses.replace(config, flow_points=0), film, "cpu").motion.control_points_at(0.0)
    places = without.double() / state.normalisation.scale + torch.as_tensor(state.normalisation.centre)
    assert int((places[:, 1] < 1.0).sum()) == 0, "all are on the wall, as the sparse points are"


def test_data_whose_cameras_jump_begin_as_before():
    config = tiny_config(40)
    ours = TrainState.begin(config, tiny_dataset(8), "cpu")
    off = TrainState.begin(dataclasses.replace(config, flow_points=0), tiny_dataset(8), "cpu")
    assert torch.equal(ours.gaussians.means, off.gaussians.means)
