"""Framing of the subject: nothing of it leaves the picture, at any time and from any side."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene
from helpers.fake_scene import FakeScene
from scgs_warp.errors import UserError
from scgs_warp.geometry.cameras import Overview, orbit_camera, turntable
from scgs_warp.visualization import films
from scgs_warp.visualization.framing import aim, distance_to_fit, frame_subject, is_cut_out


class Near(FakeScene):
    """The two balls, seen by cameras that stand too near and look beside them."""

    overview = Overview((0.6, 0.5, 0.0), (0.0, 0.0, 1.0), 1.6, 40.0, 20.0)


def edge_alpha(scene: FakeScene, overview: Overview) -> float:
    """Return the largest alpha on the edge of the pictures of a turntable."""
    most = 0.0
    for index, camera in enumerate(turntable(overview, 12, 64)):
        alpha = scene.render(camera, index / 11).alpha
        most = max(most, *(float(edge.max()) for edge in (alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1])))
    return most


def test_the_subject_stays_in_the_picture():
    scene = Near()
    assert edge_alpha(scene, scene.overview) == 1.0
    framed = frame_subject(scene)  # type: ignore[arg-type]
    assert edge_alpha(scene, framed) == 0.0
    tight = Overview(framed.centre, framed.up, 0.6 * framed.radius, framed.fov_x, framed.elevation)
    assert edge_alpha(scene, tight) == 1.0, "and it does not become small"


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.0])
def test_the_distance_is_the_least_one(aspect):
    points = np.random.default_rng(0).normal(size=(500, 3)) * (0.3, 0.5, 1.0)
    overview = Overview((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0, 50.0, 15.0, aspect=aspect)
    distance = distance_to_fit(overview, points)

    def outside(radius: float) -> bool:
        for azimuth in np.arange(0.0, 360.0, 15.0):
            view = Overview(overview.centre, overview.up, radius, 50.0, 15.0, aspect=aspect)
            camera = orbit_camera(view, azimuth, 1000)
            local = points @ camera.viewmat[:3, :3].numpy().T + camera.viewmat[:3, 3].numpy()
            pixels = local @ camera.K.numpy().T
            pixels = pixels[:, :2] / pixels[:, 2:]
            if (pixels < 0).any() or (pixels > (camera.width, camera.height)).any():
                return True
        return False

    assert not outside(distance) and outside(0.85 * distance)


def test_a_scene_that_fills_its_pictures_is_not_cut_out():
    scene = FakeScene()
    assert is_cut_out(scene)  # type: ignore[arg-type]
    render = scene.render
    scene.render = lambda *a: dataclasses.replace(render(*a), alpha=torch.ones(96, 96))  # type: ignore[method-assign]
    assert not is_cut_out(scene)  # type: ignore[arg-type]


def test_target_and_zoom():
    overview = aim(FakeScene.overview, (1.0, 2.0, 3.0), 2.0)
    assert overview.centre == (1.0, 2.0, 3.0) and overview.radius == FakeScene.overview.radius
    before, after = (orbit_camera(view, 0.0, 100).K[0, 0] for view in (FakeScene.overview, overview))
    assert float(after) == pytest.approx(2 * float(before), rel=1e-6)
    for target, zoom in ((None, 0.0), (None, math.inf), ((math.nan, 0.0, 0.0), 1.0)):
        with pytest.raises(UserError, match=r"--zoom|--target"):
            aim(FakeScene.overview, target, zoom)


def test_a_film_of_something_unknown_is_refused(tmp_path):
    with pytest.raises(UserError, match="show 'x': choose one of rgb, depth"):
        films.turntable(bar_scene(), tmp_path / "film.gif", frames=2, size=16, show="x")  # pyright: ignore[reportArgumentType]
    assert not list(tmp_path.iterdir())
