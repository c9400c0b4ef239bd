"""Initial points of what moves before standing cameras: which cameras stand, what moves, where points lie."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from helpers.ball_and_wall import SIZE, ball, filmed, standing_camera, walking_camera, wall
from helpers.ball_rig import ANGLES, MOMENTS, changed_film, place_at, rig_views, standing_in, stereo_of
from helpers.tiny import tiny_config
from scgs_warp.data.dataset import Dataset
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.geometry.stereo import StereoPair
from scgs_warp.training import movers_by_stereo as module
from scgs_warp.training import stereo_depth
from scgs_warp.training.flow import Flows
from scgs_warp.training.movers_by_stereo import moving_points, stereo_clouds
from scgs_warp.training.points_on_movers import points_on_movers
from scgs_warp.training.standing_cameras import levels
from scgs_warp.training.start_motion import start_cloud
from scgs_warp.training.state import TrainState
from scgs_warp.types import Camera


@pytest.fixture(scope="module")
def film() -> Dataset:
    return filmed(rig_views(), place_at)


def clouds_in(film: Dataset, count: int = 300):
    normalisation, stereo = stereo_of(film)
    views = [normalisation.apply_camera(camera) for camera in film.cameras]
    return normalisation, stereo_clouds(stereo, Flows(film, views), count, 0)


def found_in(film: Dataset, count: int = 800, time: float = 0.5):
    normalisation, clouds = clouds_in(film, count)
    found = next(cloud for cloud in clouds if cloud.time == time)
    return found, found.points.double() / normalisation.scale + torch.as_tensor(normalisation.centre)


def test_standing_cameras_have_their_frames_in_order_of_time(film):
    shuffled = torch.randperm(len(film), generator=torch.Generator().manual_seed(1)).tolist()
    mixed = film.subset(shuffled)
    _, standing = standing_in(mixed)
    assert len(standing) == len(ANGLES)
    assert sorted(index for one in standing for index in one.frames) == list(range(len(film)))
    for one in standing:
        times = [mixed.entries[index].time for index in one.frames]
        assert times == sorted(times) and len(times) == MOMENTS
        assert len({mixed.cameras[index].viewmat.sum().item() for index in one.frames}) == 1
        assert mixed.entries[one.frame_at(0.49, mixed)].time == 0.5


@pytest.mark.parametrize("lack", ["moves", "alone", "few"])
def test_other_cameras_do_not_stand(lack):
    views = {
        "moves": [(walking_camera(moment / 6), moment / 6) for moment in range(7)],
        "alone": rig_views((0.0,), (0.3,)),
        "few": rig_views(moments=3),
    }[lack]
    assert standing_in(filmed(views, place_at))[1] == []


def test_regions_that_move_are_the_path_of_the_ball(film):
    normalisation, standing = standing_in(film)
    for one in standing:
        for time in (0.0, 0.5, 1.0):
            centre = normalisation.apply(place_at(time)[None]).double().numpy()
            inside, moving = one.sees(centre, one.moves)
            assert inside[0] and moving[0], "the ball's place at the time"
        assert 0.05 < one.moves.mean() < 0.5
        behind = normalisation.apply(torch.tensor([[0.0, -50.0, 0.0]])).double().numpy()
        assert not one.sees(behind, one.moves)[0][0], "a point behind the camera is not in view"


@pytest.mark.parametrize("shown", [True, False])
def test_pixels_outside_masks_do_not_move(film, shown):
    masks = [torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(k)) > 0.3 for k in range(len(film))]
    still = filmed(rig_views(), None)
    frames = [
        dataclasses.replace(frame, image=frame.image * (1.0 if shown else mask[..., None].float()), mask=mask)
        for frame, mask in zip(still, masks)
    ]
    data = Dataset(frames, folder=still.folder, split="train", points=still.points, colors=still.colors)
    assert max(one.moves.mean() for one in standing_in(data)[1]) < 0.01


def test_what_moves_under_a_mask_is_not_sought(film):
    none = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    data = changed_film(film, lambda frame, _: dataclasses.replace(frame, mask=none))
    assert not any(one.moves.any() for one in standing_in(data)[1])


def test_a_bright_box_on_a_dark_stage_does_not_move():
    """The level of the dark flickers, which is no exposure."""
    still = filmed(rig_views(), None)
    frames = []
    for number, frame in enumerate(still):
        image = torch.full_like(frame.image, (1 + number % 2) / 255.0)
        image[60:90, 60:90] = 0.8
        frames.append(dataclasses.replace(frame, image=image))
    data = Dataset(frames, folder=still.folder, split="train", points=still.points, colors=still.colors)
    assert not any(one.moves.any() for one in standing_in(data)[1])


def test_what_crosses_once_moves():
    quick = filmed(rig_views(moments=4), lambda time: torch.tensor([2.4 * time - 1.2, 0.0, 0.0]))
    assert all(one.moves.mean() > 0.1 for one in standing_in(quick)[1])


def test_cameras_without_a_frame_then_are_left_out(film):
    """Two of the five cameras stop at half time."""
    kept = [k for k, frame in enumerate(film) if k >= 2 * MOMENTS or frame.time <= 0.5]
    short = film.subset(kept)
    _, standing = standing_in(short)
    assert [one.frame_at(1.0, short) is None for one in standing] == [True, True, False, False, False]
    found, places = found_in(short, time=1.0)
    distance = (places - place_at(1.0).double()).norm(dim=1)
    assert len(found.points) > 100 and float(((distance - 0.5).abs() < 0.15).double().mean()) > 0.6


@pytest.mark.parametrize("turns", [False, True])
def test_points_of_a_large_rig_are_followed_in_some_films_only(film, monkeypatch, turns):
    """Points of all cameras are taken, and those of others go along. Cameras are followed where they are matched."""
    if turns:  # of the pairs
        monkeypatch.setattr(stereo_depth, "MOST_MATCHES", 28)
    measured = []
    path = Flows.between_frames
    monkeypatch.setattr(Flows, "between_frames", lambda self, *ends: measured.append(ends) or path(self, *ends))
    monkeypatch.setattr(module, "MOST_FOLLOWED", 3 * MOMENTS)
    _, clouds = clouds_in(film)
    followed = [{one // MOMENTS for one, _ in measured if one % MOMENTS == moment} for moment in range(MOMENTS - 1)]
    assert all(len(cameras) <= 3 for cameras in followed) and max(map(len, followed)) == 3
    if not turns:
        assert all(cameras == {0, 2, 4} for cameras in followed)
    for cloud in clouds[:-1]:
        assert 0.1 < cloud.later.isfinite().all(1).float().mean() < 0.9


def test_a_camera_behind_another_is_not_matched_with_it():
    near = Camera(standing_camera(3.0).viewmat.clone(), standing_camera(3.0).K, SIZE, SIZE)
    near.viewmat[2, 3] -= 1.5
    far, beside = standing_camera(0.0), standing_camera(12.0)
    points = wall().means.double().numpy()
    assert StereoPair.of(far, near, points) is None and StereoPair.of(far, beside, points) is not None


def test_points_beside_the_cameras_do_not_coarsen_the_pictures():
    one, two = standing_camera(0.0), standing_camera(20.0)
    points = wall().means.double().numpy()
    floor = np.stack([np.linspace(-3, 3, 400), np.full(400, -3.9), np.full(400, -1.0)], 1)
    plain, cluttered = (StereoPair.of(one, two, each) for each in (points, np.concatenate([points, floor])))
    assert plain is not None and cluttered is not None and cluttered.size == plain.size
    assert plain.focal > 0.5 * float(one.K[0, 0])


@pytest.mark.parametrize("corner", [(0, 0), (SIZE - 2, SIZE - 2), (SIZE - 2, 0)])
def test_small_regions_at_the_edges_are_harmless(film, corner):
    one, two = standing_camera(0.0), standing_camera(10.0)
    pair = StereoPair.of(one, two, wall().means.double().numpy())
    assert pair is not None
    region = np.zeros((SIZE, SIZE), bool)
    region[corner[0] : corner[0] + 2, corner[1] : corner[1] + 2] = True
    places, colors = pair.match((levels(film[0].image), levels(film[1].image)), region)
    assert len(places) == len(colors) and np.isfinite(places).all()


def test_a_change_of_exposure_is_no_motion():
    still = filmed(rig_views(), None)
    data = changed_film(still, lambda frame, k: dataclasses.replace(frame, image=frame.image * (0.8 + 0.05 * (k % 7))))
    _, standing = standing_in(data)
    assert len(standing) == len(ANGLES) and max(one.moves.mean() for one in standing) < 0.01


def test_points_lie_on_the_ball_at_one_moment(film):
    found, places = found_in(film)
    assert len(found.points) > 300 and bool(found.moves.all())
    centre = place_at(found.time).double()
    distance = (places - centre).norm(dim=1)
    assert float(((distance - 0.5).abs() < 0.12).double().mean()) > 0.85, "on the sphere of radius 0.5"
    assert float((places[:, 1] > 1.5).double().mean()) < 0.02, "not on the wall"


def test_points_have_the_colours_of_their_pixels(film):
    """Each has that of its pixel in one of the frames of its moment."""
    found, places = found_in(film)
    errors = []
    for frame in (frame for frame in film if frame.time == found.time):
        camera, image = frame.camera, frame.image
        local = places @ camera.viewmat[:3, :3].double().T + camera.viewmat[:3, 3].double()
        flat = local @ camera.K.double().T
        columns, rows = (flat[:, :2] / flat[:, 2:]).long().T
        seen = image[rows.clamp(0, SIZE - 1), columns.clamp(0, SIZE - 1)]
        errors.append((seen - found.colors).abs().mean(1))
    assert float(torch.stack(errors).amin(0).mean()) < 0.005


def test_the_number_is_bounded_and_the_choice_repeatable(film):
    (found, _), (again, _) = found_in(film, 200), found_in(film, 200)
    assert len(found.points) == 200 and torch.equal(found.points, again.points)
    assert torch.equal(found.colors, again.colors) and found.time == again.time


def test_cameras_above_one_another_are_matched_too():
    views = rig_views((0.0, 0.0, 0.0), (-0.5, 0.3, 1.1))
    film = filmed(views, place_at)
    found, places = found_in(film)
    centre = place_at(found.time).double()
    assert len(found.points) > 150
    assert float((((places - centre).norm(dim=1) - 0.5).abs() < 0.15).double().mean()) > 0.8


def test_threads_of_opencv_do_not_change_the_points(film):
    before = cv2.getNumThreads()
    try:
        seen = []
        for threads in (1, 3):
            cv2.setNumThreads(threads)
            seen.append(found_in(film)[0])
    finally:
        cv2.setNumThreads(before)
    assert torch.equal(seen[0].points, seen[1].points) and torch.equal(seen[0].colors, seen[1].colors)


def test_clouds_follow_the_ball(film):
    normalisation, clouds = clouds_in(film)
    assert [cloud.time for cloud in clouds] == [moment / (MOMENTS - 1) for moment in range(MOMENTS)]
    for cloud in clouds:
        places = cloud.points.double() / normalisation.scale + torch.as_tensor(normalisation.centre)
        distance = (places - place_at(cloud.time).double()).norm(dim=1)
        assert float(((distance - 0.5).abs() < 0.15).double().mean()) > 0.8, cloud.time
    assert start_cloud(clouds).time == 0.5


def test_moments_without_enough_points_are_left_out():
    away = torch.tensor([0.0, 0.0, 50.0])
    late = filmed(rig_views(moments=9), lambda time: place_at(time) if time > 0.6 else away)
    assert [cloud.time for cloud in clouds_in(late)[1]] == [0.625, 0.75, 0.875, 1.0]


def test_where_nothing_moves_there_are_none():
    still = filmed(rig_views(), None)
    assert clouds_in(still)[1] == []


def test_cameras_too_far_apart_are_not_paired():
    film = filmed(rig_views((-60.0, 0.0, 60.0), (0.3, 0.3, 0.3)), place_at)
    stereo = stereo_of(film)[1]
    assert len(stereo.standing) == 3 and stereo.pairs == {} and not stereo.available
    assert stereo.of(0) is None and clouds_in(film)[1] == []


def test_a_point_on_the_wall_behind_the_ball_does_not_move(film):
    normalisation, standing = standing_in(film)
    points = torch.cat([wall().means[::7], ball(place_at(0.5)).means])
    moves = moving_points(normalisation.apply(points).double().numpy(), standing)
    walls = len(wall().means[::7])
    assert moves[:walls].mean() < 0.2 and moves[walls:].mean() > 0.98


def test_half_of_the_control_points_begin_on_the_ball(film):
    config = tiny_config(40, init_points=1500, flow_points=600, motion={"nodes": 64})
    state = TrainState.begin(config, film, "cpu")

    def before_the_wall(state: TrainState) -> int:
        places = state.motion.control_points_at(0.0).double() / state.normalisation.scale
        return int(((places + torch.as_tensor(state.normalisation.centre))[:, 1] < 1.0).sum())

    assert before_the_wall(state) >= 30
    without = TrainState.begin(dataclasses.replace(config, flow_points=0), film, "cpu")
    assert before_the_wall(without) == 0, "all are on the wall, as the sparse points are"


def test_sparse_points_on_the_ball_are_replaced(film):
    stale = ball(place_at(0.0)).means[::4]
    points = torch.cat([film.points, stale])
    data = Dataset(tuple(film), folder=film.folder, split="train", points=points, colors=torch.full_like(points, 0.5))
    normalisation = Normalisation.fit(data.cameras, data.points)
    known = normalisation.apply(points).float()
    seen, keep, motion, _ = points_on_movers(300, 1000, known, data, normalisation, 0)
    assert 250 <= len(seen.points) <= 300 and bool(seen.moves.all())
    assert motion is not None and motion.tracks is not None and len(motion.clouds) == MOMENTS
    assert keep[len(film.points) :].float().mean() < 0.2 and keep[: len(film.points)].float().mean() > 0.85


def test_a_start_without_room_keeps_half_for_the_ball(film):
    config = tiny_config(40, init_points=len(film.points), flow_points=600, motion={"nodes": 64})
    state = TrainState.begin(config, film, "cpu")
    places = state.gaussians.means.detach().double() / state.normalisation.scale
    before = (places + torch.as_tensor(state.normalisation.centre))[:, 1] < 1.0
    assert len(places) >= len(film.points) and int(before.sum()) >= 0.3 * len(film.points)


def test_sparse_points_stay_if_all_lie_where_something_moves(film):
    points = ball(place_at(0.5)).means[::40]
    normalisation = Normalisation.fit(film.cameras, points)
    seen, keep, _, _ = points_on_movers(300, 1000, normalisation.apply(points).float(), film, normalisation, 0)
    assert bool(keep.all()) and len(seen.points) > 0


def test_without_depth_all_sparse_points_are_kept():
    still = filmed(rig_views(), None)
    normalisation = Normalisation.fit(still.cameras, still.points)
    movers = points_on_movers(300, 1000, normalisation.apply(still.points).float(), still, normalisation, 0)
    assert len(movers.seen.points) == len(movers.seen.colors) == len(movers.seen.moves) == 0
    assert bool(movers.keep.all()) and movers.motion is None
