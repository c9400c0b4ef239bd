"""Where cameras of synthesised data stand: on a dome, as a rig, along a path."""

from __future__ import annotations

import math

import numpy as np
import pytest

from scgs_warp.data.synthetic.orbit_cameras import (
    FilmingSettings,
    along_path,
    camera_distance,
    plan_pictures,
    surrounding,
)


def test_cameras_of_every_arrangement():
    rng = np.random.default_rng(0)
    sphere = plan_pictures(FilmingSettings(train=40, elevation=(10, 50)), rng)
    assert {split: len(found) for split, found in sphere.items()} == {"train": 40, "test": 20, "val": 10}
    places = np.stack([picture.camera_to_world[:3, 3] for picture in sphere["train"]])
    elevations = np.degrees(np.arcsin(places[:, 2] / np.linalg.norm(places, axis=1)))
    assert elevations.min() > 10 - 1e-9 and elevations.max() < 50 + 1e-9 and np.ptp(elevations) > 25
    assert [picture.time for picture in sphere["test"]] == pytest.approx(np.linspace(0, 1, 20).tolist())
    rig = plan_pictures(FilmingSettings(train=5, views=3, val=0), rng)
    assert [picture.view for picture in rig["train"]] == [0, 1, 2] * 5 and "val" not in rig
    assert [picture.time for picture in rig["train"]] == [
        0,
        0,
        0,
        0.25,
        0.25,
        0.25,
        0.5,
        0.5,
        0.5,
        0.75,
        0.75,
        0.75,
        1,
        1,
        1,
    ]
    still = np.stack([picture.camera_to_world for picture in rig["train"]]).reshape(5, 3, 4, 4)
    assert (still == still[0]).all() and np.linalg.norm(still[0, 0] - still[0, 1]) > 1
    path = plan_pictures(FilmingSettings(train=100, cameras="path", turns=2.0), rng)["train"]
    places = np.stack([picture.camera_to_world[:3, 3] for picture in path])
    turned = np.unwrap(np.arctan2(places[:, 1], places[:, 0]))
    assert (
        turned[-1] - turned[0] == pytest.approx(4 * math.pi)
        and np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 1
    )
    followers = [along_path(FilmingSettings(cameras="path", views=2), 0.0, 0.0, view)[:3, 3] for view in (0, 1)]
    assert followers[0][0] > 0 > followers[1][0]
    for picture in [*sphere["train"], *path]:
        rotation = picture.camera_to_world[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) == pytest.approx(1)
        assert np.allclose(
            picture.camera_to_world[:3, 3] / camera_distance(FilmingSettings()), rotation[:, 2]
        )  # looks at the origin


@pytest.mark.parametrize("start", [0.0, 1.0, 4.0])
@pytest.mark.parametrize("count", [20, 100, 400])
def test_consecutive_cameras_surround_the_subject(count, start):
    cameras = np.stack(surrounding(count, (0.05, 0.85), 4.0, start))
    views = cameras[:, :3, 3] / 4.0
    assert np.allclose(np.linalg.norm(views, axis=1), 1) and np.allclose(cameras[:, :3, 2], views)
    assert views[:, 2].min() >= 0.05 and views[:, 2].max() <= 0.85 and np.ptp(views[:, 2]) > 0.7
    azimuths = np.radians(np.arange(0, 360, 2))
    fronts = np.stack([np.cos(azimuths), np.sin(azimuths), np.zeros_like(azimuths)])
    angles = np.degrees(np.arccos(np.clip(views @ fronts, -1, 1)))
    for index in range(count):
        assert angles[max(0, index - 4) : index + 5].min(0).max() < 60
