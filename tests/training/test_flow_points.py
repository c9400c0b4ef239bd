"""Initial points of what moves: where they lie, which are known to move, and that runs begin on them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from helpers.scenes import look_at
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.data.dataset import Dataset
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.rendering.render import render
from scgs_warp.training.flow_points import flow_points
from scgs_warp.training.state import TrainState
from scgs_warp.types import Camera, Frame, Gaussians

SIZE, COUNT = 160, 30


def wall() -> Gaussians:
    """A textured wall at y = 2, of small Gaussians in many colours."""
    generator = torch.Generator().manual_seed(3)
    x, z = torch.meshgrid(torch.linspace(-4, 4, 56), torch.linspace(-3, 3, 42), indexing="ij")
    means = torch.stack([x.flatten(), torch.full((x.numel(),), 2.0), z.flatten()], 1)
    means = means + 0.03 * torch.randn(means.shape, generator=generator)
    return _made(means, _pattern(means), 0.09)


def mover(time: float) -> Gaussians:
    """A patterned ball of radius 0.5, which rises by 0.15, a little to the right, and comes back."""
    generator = torch.Generator().manual_seed(5)
    means = torch.randn(700, 3, generator=generator)
    means = 0.5 * means / means.norm(dim=1, keepdim=True)
    way = 1 - abs(2 * time - 1)
    colors = _pattern(1.7 * means + 1.0)
    return _made(means + way * torch.tensor([0.03, 0.0, 0.15]), colors, 0.05)


def _pattern(places: torch.Tensor) -> torch.Tensor:
    """Colours [N, 3] that change smoothly in space, never twice the same way."""
    directions = torch.randn(3, 6, 3, generator=torch.Generator().manual_seed(2)) * 3.0
    return (0.5 + 0.12 * torch.einsum("nd,ckd->nck", places, directions).sin().sum(2)).clamp(0.02, 0.98)


def _made(means: torch.Tensor, colors: torch.Tensor, scale: float) -> Gaussians:
    quats = torch.zeros(len(means), 4)
    quats[:, 0] = 1.0
    count = len(means)
    color = (colors - 0.5) / 0.28209479177387814
    return Gaussians(
        means, quats, torch.full((count, 3), scale), torch.full((count,), 0.95), color, torch.zeros(count, 0, 3)
    )


def film_camera(share: float) -> Camera:
    """A camera that walks by 1.6 units and looks at the ball."""
    eye = torch.tensor([-0.8 + 1.6 * share, -4.0, 0.3], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    K = torch.tensor([[1.2 * SIZE, 0, SIZE / 2], [0, 1.2 * SIZE, SIZE / 2], [0, 0, 1]])
    return Camera(look_at(eye, torch.zeros(3, dtype=torch.float64), up).float(), K, SIZE, SIZE)


@pytest.fixture(scope="module")
def film() -> Dataset:
    """Frames of wall and ball, with a tenth of the wall as sparse points."""
    frames = []
    for index in range(COUNT):
        time = index / (COUNT - 1)
        parts = [dataclasses.asdict(part) for part in (wall(), mover(time))]
        both = {name: torch.cat([part[name] for part in parts]) for name in parts[0] if name != "sharpness"}
        with torch.no_grad():
            image = render(Gaussians(**both), film_camera(time), torch.full((3,), 0.5))
        frames.append(Frame(film_camera(time), time, image.rgb.clamp(0, 1), None, None, f"{index:03d}"))
    sparse = wall()
    colors = (sparse.sh_dc * 0.28209479177387814 + 0.5).clamp(0, 1)
    return Dataset(frames, folder=Path("film"), split="train", points=sparse.means[::10], colors=colors[::10])


def found_in(film: Dataset, count: int = 1000):
    normalisation = Normalisation.fit(film.cameras, film.points)
    views = [normalisation.apply_camera(camera) for camera in film.cameras]
    found = flow_points(count, normalisation.apply(film.points).float(), film, views)
    assert found is not None
    places = found.points.double() / normalisation.scale + torch.as_tensor(normalisation.centre)
    return found, places


def test_points_lie_on_the_wall_and_on_the_ball_of_one_instant(film):
    found, places = found_in(film)
    time = film.entries[found.index].time
    centre = mover(time).means.double().mean(0)
    moving, still = places[found.moves], places[~found.moves]
    assert len(moving) > 200 and len(still) > 200
    # Those at the ball's outline may lie between ball and wall.
    assert float(((moving - centre).norm(dim=1) < 0.9).double().mean()) > 0.6
    assert float((moving[:, 1] > 1.9).double().mean()) < 0.05
    assert float((still[:, 1] - 2.0).abs().median()) < 0.3, "of a distance of six"


def test_points_have_the_colours_of_their_pixels(film):
    found, places = found_in(film)
    frame = film[found.index]
    local = places @ frame.camera.viewmat[:3, :3].double().T + frame.camera.viewmat[:3, 3].double()
    flat = local @ frame.camera.K.double().T
    columns, rows = (flat[:, :2] / flat[:, 2:]).long().T
    seen = frame.image[rows.clamp(0, SIZE - 1), columns.clamp(0, SIZE - 1)]
    assert float((seen - found.colors).abs().mean()) < 0.06


def test_the_number_is_bounded_and_the_choice_repeatable(film):
    found, again = found_in(film, 300)[0], found_in(film, 300)[0]
    assert len(found.points) <= 300 and found.index == again.index
    assert torch.equal(found.points, again.points) and torch.equal(found.moves, again.moves)


def test_cameras_that_rest_give_none(film):
    still = film.with_cameras([film.cameras[0]] * len(film))
    normalisation = Normalisation.fit(film.cameras, film.points)
    views = [normalisation.apply_camera(camera) for camera in still.cameras]
    assert flow_points(100, normalisation.apply(film.points).float(), still, views) is None


def test_a_mover_that_has_sparse_points_needs_no_others(film):
    ball = mover(0.5)
    points = torch.cat([film.points, ball.means[::3]])
    normalisation = Normalisation.fit(film.cameras, film.points)
    views = [normalisation.apply_camera(camera) for camera in film.cameras]
    assert flow_points(100, normalisation.apply(points).float(), film, views) is None


def test_a_film_of_what_stands_still_needs_none(film):
    frames = []
    for entry in film.entries:
        with torch.no_grad():
            image = render(wall(), entry.camera, torch.full((3,), 0.5))
        frames.append(Frame(entry.camera, entry.time, image.rgb.clamp(0, 1), None, None, entry.name))
    still = Dataset(frames, folder=Path("still"), split="train", points=film.points, colors=film.colors)
    normalisation = Normalisation.fit(still.cameras, still.points)
    views = [normalisation.apply_camera(camera) for camera in still.cameras]
    assert flow_points(100, normalisation.apply(still.points).float(), still, views) is None


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
