"""Films with truth: what they record fits the poses, moments, exposures and flow that they state."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from scgs_warp.data import load
from scgs_warp.data.synthetic.films import FilmRequest, make_film, plan_film
from scgs_warp.data.synthetic.films.cameras import HandHeldPath, rig_viewmats
from scgs_warp.data.synthetic.films.encoding import decoded, write_film
from scgs_warp.data.synthetic.films.photography import (
    Shutter,
    View,
    develop,
    drifting_gains,
    photograph,
    to_linear,
    to_stored,
)
from scgs_warp.data.synthetic.films.sound import SAMPLE_RATE, SPEED_OF_SOUND, heard
from scgs_warp.data.synthetic.films.stage import stage_of
from scgs_warp.errors import UserError
from scgs_warp.evaluation.motion_metrics import load_ground_truth

SMALL = FilmRequest("phone", width=96, height=64, seconds=1.0, fps=8.0, samples=2, crf=12, test=2, maps=True)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("films") / "phone"
    plan = plan_film(folder, SMALL)
    make_film(plan)
    return plan, folder


@pytest.fixture(scope="module")
def stage():
    return stage_of("robot", "cpu")


def test_the_folder_trains_with_true_cameras(filmed):
    plan, folder = filmed
    train, test = load(folder), load(folder, "test")
    truth = np.load(folder / "truth.npz")
    assert len(train) == 8 and len(test) == 2 and train.points is not None and len(train.points) > 300
    for index, frame in enumerate(train.entries):
        np.testing.assert_allclose(frame.camera.viewmat.numpy(), truth["viewmats"][0, index], atol=1e-5)
        assert frame.time == pytest.approx(truth["times"][0, index])
    motion = load_ground_truth(folder)
    assert motion is not None and motion.visible.shape == (8, 2000) and 100 < motion.visible.any(0).sum() < 2000
    assert plan_film(folder, SMALL).made and not plan.made
    with pytest.raises(UserError, match="holds something else"):
        plan_film(folder, replace(SMALL, seed=1))


def test_the_data_set_names_its_depth_maps(filmed):
    """Those of the frames of the film; they place the sparse points of the room where these are."""
    _, folder = filmed
    train = load(folder)
    assert train.with_depth == list(range(8)) and not load(folder, "test").with_depth
    depth, camera = train.depth(3), train.entries[3].camera
    assert depth is not None and train.points is not None
    np.testing.assert_array_equal(depth.numpy(), np.load(folder / "maps/film/00003.npz")["depth"])
    local = train.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = (local @ camera.K.T)[:, :2] / local[:, 2:]
    inside = (local[:, 2] > 0) & ((pixels >= 0) & (pixels < torch.tensor([96.0, 64.0]))).all(1)
    columns, rows = pixels[inside].long().T
    assert float(((depth[rows, columns] - local[inside, 2]).abs() < 0.1).float().mean()) > 0.5


def test_depth_maps_that_are_wrong_are_wrong_by_as_much_as_asked(tmp_path):
    plan = plan_film(tmp_path / "film", replace(SMALL, depth_error=0.05, test=1))
    make_film(plan)
    train, errors = load(tmp_path / "film"), []
    for index in train.with_depth:
        true = np.load(tmp_path / f"film/maps/film/{index:05d}.npz")["depth"]
        found = train.depth(index)
        assert found is not None
        errors.append(np.log(found.numpy() / cv2.GaussianBlur(true, (0, 0), 2.0)))
    spread = float(np.std(errors))
    assert 0.025 < spread < 0.07 and float(np.abs(np.diff(errors, axis=2)).max()) < 0.04, "smooth in the image"
    for wrong in (replace(SMALL, depth_error=0.05, maps=False), replace(SMALL, depth_error=-1.0)):
        with pytest.raises(UserError, match="--depth-error"):
            plan_film(tmp_path / "other", wrong)
    with pytest.raises(UserError, match="--depth-error"):
        plan_film(tmp_path / "other", replace(SMALL, kind="rig", depth_error=0.05))


def test_points_lie_on_the_room(filmed):
    """No point is in front of the surface that a frame shows; colours fit, though textures are finer than pixels."""
    _, folder = filmed
    train = load(folder)
    assert train.points is not None and train.colors is not None
    camera, image = train.entries[3].camera, train[3].image
    local = train.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = local @ camera.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    inside = (local[:, 2] > 0) & ((pixels >= 0) & (pixels < torch.tensor([96.0, 64.0]))).all(1)
    columns, rows = pixels[inside].long().T
    depth = torch.from_numpy(np.load(folder / "maps/film/00003.npz")["depth"])[rows, columns]
    behind = local[inside][:, 2] - depth
    assert inside.sum() > 100 and (behind > -0.2).float().mean() > 0.97
    assert (behind.abs() < 0.1).float().mean() > 0.5
    pair = torch.stack([image[rows, columns].mean(1), train.colors[inside].mean(1)])[:, behind.abs() < 0.1]
    assert float(torch.corrcoef(pair)[0, 1]) > 0.5


def test_flow_carries_pixels_to_the_next_frame(filmed):
    """Brightness is constant along the true flow where the point stays visible, and not along zero flow."""
    _, folder = filmed
    frames = [torch.from_numpy(frame).float() / 255 for frame in decoded(folder / "film.mp4")]
    carried, still = [], []
    for index in range(3):
        maps = np.load(folder / f"maps/film/{index:05d}.npz")
        flow, seen = torch.from_numpy(maps["flow"]).float(), torch.from_numpy(maps["seen"])
        rows, columns = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(96) + 0.5, indexing="ij")
        there = torch.stack([columns, rows], -1) + flow
        grid = there / torch.tensor([96.0, 64.0]) * 2 - 1
        next_frame = frames[index + 1].permute(2, 0, 1)[None]
        warped = torch.nn.functional.grid_sample(next_frame, grid[None], align_corners=False)[0].permute(1, 2, 0)
        assert seen.float().mean() > 0.5 and 0.03 < maps["moves"].mean() < 0.5
        carried.append((warped - frames[index]).abs().mean(-1)[seen].mean())
        still.append((frames[index + 1] - frames[index]).abs().mean(-1)[seen].mean())
    assert sum(carried) < 0.5 * sum(still)
    assert "flow" not in np.load(folder / "maps/film/00007.npz")


def test_depth_and_mask_are_those_of_the_surface(filmed):
    """Points of the subject, projected, lie on moving pixels at the stated depth wherever they are visible."""
    plan, folder = filmed
    stage, take = plan.stage, plan.shooting.takes[0]
    points = stage.sample(400, np.random.default_rng(1))
    second = float(take.seconds[5])
    places = torch.from_numpy(stage.track(points, [plan.shooting.time_of(second)])[0]).float()
    camera = take.view.camera(second)
    seen = stage.caster.visible(stage.pose(plan.shooting.time_of(second)), camera, places)
    local = places[seen] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = (local @ camera.K.T)[:, :2] / local[:, 2:]
    columns, rows = pixels.long().T
    maps = np.load(folder / "maps/film/00005.npz")
    assert seen.sum() > 40 and maps["moves"][rows, columns].mean() > 0.9
    assert np.median(np.abs(maps["depth"][rows, columns] - local[:, 2].numpy())) < 0.03


def test_the_same_request_gives_the_same_pictures(filmed, tmp_path):
    _, folder = filmed
    again = make_film(plan_film(tmp_path / "again", SMALL))
    for name in ("film.mp4", "truth.npz", "transforms.json", "points.ply", "images/held_out_001.png"):
        assert (again / name).read_bytes() == (folder / name).read_bytes(), name


def test_gains_multiply_linear_light():
    light = torch.linspace(0.0, 0.5, 50)[:, None, None].expand(50, 4, 3)
    plain, brighter = develop(light, np.ones(3)), develop(light, np.array([2.0, 1.0, 1.0]))
    assert (brighter[..., 1:] == plain[..., 1:]).all()
    doubled = to_linear(torch.from_numpy(plain[..., 0] / 255.0)) * 2
    assert np.abs(to_stored(doubled).numpy() * 255 - brighter[..., 0]).max() < 2.5
    torch.testing.assert_close(to_linear(to_stored(light)), light, atol=1e-5, rtol=0)
    drift = drifting_gains(np.arange(300) / 30, 0.3, 0.0, np.random.default_rng(0))
    assert (
        max(drift.max(), 1 / drift.min()) == pytest.approx(1.3)
        and drift.max() > 1.05 > 0.95 > drift.min()
        and (drift[:, 0] == drift[:, 2]).all()
    )
    assert (drifting_gains(np.arange(9) / 3, 0.0, 0.0, np.random.default_rng(0)) == 1).all()


def test_blur_and_rolling_shutter_average_moments(stage):
    """A picture without exposure time shows one moment; a rolling shutter shows the moment of each row."""

    def swinging(seconds: float) -> np.ndarray:
        matrix = rig_viewmats(1, stage.floor, 100.0)[0]
        turn = np.eye(4)
        angle = 2.0 * seconds
        turn[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        return turn @ matrix

    view = View(swinging, np.array([[60.0, 0, 40], [0, 60.0, 24], [0, 0, 1.0]]), 80, 48)
    still = lambda seconds: 0.5  # noqa: E731
    sharp = photograph(stage, view, 0.0, still, Shutter(), 2)
    torch.testing.assert_close(photograph(stage, view, 0.0, still, Shutter(1e-9, 0.0), 2), sharp, atol=2e-3, rtol=0)
    blurred = photograph(stage, view, 0.0, still, Shutter(0.05, 0.0), 2)
    edges = [image.diff(dim=1).abs().mean() for image in (sharp, blurred)]
    assert edges[1] < 0.7 * edges[0]
    rolling = photograph(stage, view, 0.0, still, Shutter(0.0, 0.1), 2)
    first_row = photograph(stage, view, -0.05 * (1 - 1 / 34), still, Shutter(), 2)[0]
    assert (rolling[0] - first_row).abs().mean() < 0.2 * (sharp[0] - first_row).abs().mean()


def test_a_hand_sways_within_bounds():
    path = HandHeldPath(4.0, -1.2, 1.0, 100.0, np.random.default_rng(3))
    steady = HandHeldPath(4.0, -1.2, 0.0, 100.0, np.random.default_rng(3))
    moments = np.linspace(0.0, 4.0, 81)
    views = np.stack([path.viewmat(moment) for moment in moments])
    np.testing.assert_allclose(
        views[:, :3, :3] @ views[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (81, 1, 1)), atol=1e-9
    )
    apart = views @ np.linalg.inv(np.stack([steady.viewmat(moment) for moment in moments]))
    angles = np.degrees(np.arccos(((np.trace(apart[:, :3, :3], axis1=1, axis2=2) - 1) / 2).clip(-1, 1)))
    assert 0.5 < angles.max() < 5.0
    centres = -np.einsum("vji,vj->vi", views[:, :3, :3], views[:, :3, 3])
    assert np.linalg.norm(np.diff(centres, axis=0), axis=1).max() < 0.2


@pytest.mark.parametrize("arc", [30.0, 100.0])
def test_cameras_stand_across_the_arc(arc):
    path = HandHeldPath(4.0, -1.2, 0.0, arc, np.random.default_rng(3))
    walk = np.stack([path.viewmat(moment) for moment in (0.0, 4.0)])
    for views in (walk, rig_viewmats(6, -1.2, arc)):
        eyes = -np.einsum("vji,vj->vi", views[:, :3, :3], views[:, :3, 3])
        azimuths = np.degrees(np.arctan2(eyes[:, 1], eyes[:, 0]))
        assert np.ptp(azimuths) == pytest.approx(arc) and azimuths.mean() == pytest.approx(-90.0)


def test_sound_arrives_late(tmp_path):
    """A clap is heard at its moment, later by the distance, on the clock of the recording; also after AAC."""
    rng = np.random.default_rng(0)
    clap = np.zeros((1, 480))
    clap[0, 0] = 1.0
    sound = heard(np.array([1.0]), clap, 0.25, 2.0, 3.43, rng)
    assert len(sound) == 2 * SAMPLE_RATE
    assert int(np.abs(sound).argmax()) == round((0.75 + 3.43 / SPEED_OF_SOUND) * SAMPLE_RATE)
    import av

    write_film(tmp_path / "clap.mp4", [np.zeros((64, 64, 3), np.uint8)] * 20, 10.0, 30, sound)
    with av.open(str(tmp_path / "clap.mp4")) as container:
        pieces = [(float(frame.pts * frame.time_base), frame.to_ndarray()[0]) for frame in container.decode(audio=0)]
    begin, piece = max(pieces, key=lambda pair: np.abs(pair[1]).max())
    assert begin + np.abs(piece).argmax() / SAMPLE_RATE == pytest.approx(0.76, abs=0.002)


def test_a_rig_begins_at_different_moments():
    request = FilmRequest("rig", width=64, height=64, seconds=2.0, offsets=0.5, views=6, exposure=0.2)
    takes = plan_film("unused", request).shooting.takes
    starts = [take.start for take in takes]
    assert len(takes) == 6 and min(starts) == 0 and max(starts) == 0.5 and len(set(starts)) == 6
    assert len({take.file for take in takes}) == 6
    for take in takes:
        assert (take.viewmats == take.viewmats[0]).all() and take.seconds[0] == take.start


@pytest.mark.parametrize(
    "changed, words",
    [
        ({"width": 95}, "even numbers"),
        ({"seconds": 0.1}, "--seconds 0.1"),
        ({"fps": float("nan")}, "--fps nan"),
        ({"fov": 5.0}, "--fov 5"),
        ({"arc": 0.0}, "--arc 0"),
        ({"blur": 1.5}, "--blur 1.5"),
        ({"crf": 60}, "--crf 60"),
        ({"kind": "rig", "views": 1}, "--views 1"),
        ({"offsets": -1.0}, "--offsets -1"),
        ({"subject": "ghost"}, "--subject ghost"),
    ],
)
def test_mistakes_name_the_option(changed, words, tmp_path):
    with pytest.raises(UserError, match=words):
        plan_film(tmp_path / "film", replace(SMALL, **changed))


def test_the_marker_holds_the_request_alone(filmed):
    content = json.loads((filmed[1] / "film.json").read_text())
    assert content["kind"] == "phone" and content["seconds"] == 1.0 and "/" not in json.dumps(content)
