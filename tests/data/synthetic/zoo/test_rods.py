"""The skeleton of rods: their widths in the pictures, and the file with the truth of their axes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from scgs_warp.data import load
from scgs_warp.data.synthetic.contact_sheet import project
from scgs_warp.data.synthetic.from_mesh import SynthesisRequest, plan_synthesis, synthesize
from scgs_warp.data.synthetic.orbit_cameras import FilmingSettings, camera_of, plan_pictures
from scgs_warp.data.synthetic.shading import Shading
from scgs_warp.data.synthetic.zoo.rod_skeleton import RODS
from scgs_warp.data.synthetic.zoo.rods import RodsSubject

FILMING = FilmingSettings(width=400, height=400, train=2, test=3, val=1)


@pytest.fixture(scope="module")
def skeleton() -> RodsSubject:
    return RodsSubject("cpu", Shading(), dark=False)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("rods") / "scene"
    return synthesize(plan_synthesis(folder, SynthesisRequest(subject="rods", filming=FILMING)))


def depths(camera, points: np.ndarray) -> np.ndarray:
    """Return the depths of points [..., 3]."""
    viewmat = camera.viewmat.double().numpy()
    return points @ viewmat[2, :3] + viewmat[2, 3]


def test_rods_are_one_to_three_pixels_wide(skeleton):
    filming = FilmingSettings(train=100)
    radii = np.array([rod.radius for rod in RODS])
    widths = []
    for picture in plan_pictures(filming, np.random.default_rng(0))["train"]:
        camera = camera_of(picture.camera_to_world, np.radians(filming.fov), 400, 400)
        depth = depths(camera, skeleton.ends([picture.time])[0])
        widths.append(2.0 * radii[:, None] * float(camera.K[0, 0]) / depth)
    assert 0.9 < np.min(widths) < 1.4 and 2.2 < np.max(widths) < 3.3


def test_pictures_show_rods_of_their_width(made, skeleton):
    """The sum of alpha on a line across a lonely rod is the width of its picture."""
    ratios = []
    names = [rod.name for rod in RODS]
    for frame in load(made, "test"):
        ends = skeleton.ends([frame.time])[0]
        assert frame.alpha is not None
        alpha = frame.alpha.numpy()
        for name in ("thigh_left", "thigh_right", "upper_arm_left", "upper_arm_right", "tail_6", "tail_10"):
            k = names.index(name)
            middle = ends[k].mean(0)
            (start, end), centre = project(frame.camera, ends[k]), project(frame.camera, middle[None])[0]
            along = (end - start) / np.linalg.norm(end - start)
            offsets = np.arange(-6.0, 6.01, 0.25)
            line = centre + offsets[:, None] * np.array([-along[1], along[0]]) - 0.5
            x, y = np.floor(line).astype(int).T
            fx, fy = (line - np.floor(line)).T
            values = (
                alpha[y, x] * (1 - fx) * (1 - fy) + alpha[y, x + 1] * fx * (1 - fy)
                + alpha[y + 1, x] * (1 - fx) * fy + alpha[y + 1, x + 1] * fx * fy
            )  # fmt: skip
            if values[np.abs(offsets) > 4.0].max() > 0:
                continue  # another rod is near
            width = 2.0 * RODS[k].radius * float(frame.camera.K[0, 0]) / depths(frame.camera, middle)
            ratios.append(values.sum() * 0.25 / width)
    assert len(ratios) >= 6 and np.median(ratios) == pytest.approx(1.0, abs=0.08)
    assert min(ratios) > 0.75 and max(ratios) < 1.3


def test_rods_file_holds_the_axes(made, skeleton):
    truth = np.load(made / "rods.npz")
    count = len(RODS)
    assert set(truth.files) == {"names", "radii", "times", "ends", "train_ends", "test_ends", "val_ends"}
    assert truth["names"].tolist() == [rod.name for rod in RODS] and len(set(truth["names"].tolist())) == count
    assert truth["radii"].shape == (count,) and truth["radii"].min() > 0
    assert truth["times"].shape == (51,) and truth["ends"].shape == (51, count, 2, 3)
    for split, pictures in (("train", 2), ("test", 3), ("val", 1)):
        ends = truth[f"{split}_ends"]
        assert ends.shape == (pictures, count, 2, 3)
        assert np.abs(ends - skeleton.ends(load(made, split).times.tolist())).max() < 1e-5


def test_axes_lie_in_the_pictures(made):
    truth = np.load(made / "rods.npz")
    for split in ("train", "test"):
        for frame, ends in zip(load(made, split), truth[f"{split}_ends"].astype(np.float64)):
            x, y = project(frame.camera, ends.mean(1)).astype(int).T
            assert frame.alpha is not None and (frame.alpha[y, x] > 0).float().mean() > 0.98


def test_axes_agree_with_the_tracks(made):
    """Every surface point stays within the radius of the axis of one rod."""
    truth, tracks = np.load(made / "rods.npz"), np.load(made / "ground_truth.npz")["points"].astype(np.float64)
    ends, radii = truth["ends"].astype(np.float64), truth["radii"].astype(np.float64)
    owners = []
    for index in (0, 20, 50):
        start, along = ends[index, :, 0], ends[index, :, 1] - ends[index, :, 0]
        offset = tracks[index, :, None] - start
        share = np.clip((offset * along).sum(-1) / (along * along).sum(-1), 0.0, 1.0)
        excess = np.linalg.norm(offset - share[..., None] * along, axis=-1) - 1.03 * radii
        assert excess.min(1).max() < 1e-5
        owners.append(excess < 1e-5)
    assert np.logical_and.reduce(owners).any(1).all()


def test_feet_are_fast_and_the_tail_whips(skeleton):
    ends = skeleton.ends(np.linspace(0, 1, 100).tolist())
    speed = np.linalg.norm(np.diff(ends, axis=0), axis=-1).max((0, 2))
    fastest = {
        group: max(speed[k] for k, rod in enumerate(RODS) if rod.group == group) for group in ("feet", "tail", "spine")
    }
    assert fastest["feet"] > 0.06 and fastest["tail"] > 0.03 > fastest["spine"]


def test_dark_rods_are_nearly_black():
    filming = FilmingSettings(train=2)
    planned = plan_pictures(filming, np.random.default_rng(1))["train"][0]
    camera = camera_of(planned.camera_to_world, np.radians(filming.fov), 200, 200)
    brightness = {}
    for dark in (False, True):
        subject = RodsSubject("cpu", Shading(), dark)
        image = subject.render(subject.pose(0.3), camera, 4)
        brightness[dark] = image[..., :3].sum((0, 1)) / image[..., 3].sum()
        assert not dark or image[..., :3].max() < 0.12
    assert brightness[True].max() < 0.06 and brightness[False].min() > 0.35
    assert torch.allclose(brightness[True] / brightness[False], torch.tensor(0.06), atol=0.03)
