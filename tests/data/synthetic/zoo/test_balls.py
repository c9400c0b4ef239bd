"""Balls over a table: they stay apart, cast shadows and carry highlights that follow the camera."""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch

from scgs_warp.data.synthetic.contact_sheet import project
from scgs_warp.data.synthetic.orbit_cameras import camera_at, camera_of
from scgs_warp.data.synthetic.shading import Shading
from scgs_warp.data.synthetic.zoo.balls import (
    BALLS,
    TABLE_RADIUS,
    TABLE_TOP,
    ball_centre,
    ball_transforms,
    make_balls,
)
from scgs_warp.types import Camera

KEY = np.array(Shading().light) / np.linalg.norm(Shading().light)


def view(azimuth: float, sine: float = 0.8, size: int = 200) -> Camera:
    return camera_of(camera_at(azimuth, sine, 4.03), 0.69, size, size)


def test_balls_are_separate_and_over_the_table():
    for time in np.linspace(0.0, 1.0, 201):
        centres = [ball_centre(ball, float(time)) for ball in BALLS]
        for (a, p), (b, q) in itertools.combinations(zip(BALLS, centres), 2):
            assert np.linalg.norm(p - q) > a.radius + b.radius + 0.05
        for ball, centre in zip(BALLS, centres):
            assert np.linalg.norm(centre[:2]) < TABLE_RADIUS - 0.05 and centre[2] >= TABLE_TOP + ball.radius - 1e-9
    for ball in BALLS:
        heights = [ball_centre(ball, float(time))[2] for time in np.linspace(0, 1, 201)]
        assert min(heights) < TABLE_TOP + ball.radius + 0.03 and max(heights) > min(heights) + 0.4 * ball.jump


def test_steady_balls_take_the_same_way_without_turning():
    for time in (0.0, 0.3, 1.0):
        turning, steady = ball_transforms(time), make_balls("cpu", Shading(), spins=False).surface.bone_transforms(time)
        for ball in BALLS:
            np.testing.assert_array_equal(steady[ball.name][:3, 3], turning[ball.name][:3, 3])
            np.testing.assert_allclose(steady[ball.name][:3, :3], np.eye(3), atol=1e-12)
            assert time == 0.0 or np.abs(turning[ball.name][:3, :3] - np.eye(3)).max() > 0.1


def test_shadows_on_the_table():
    """The table is darker where a ball hides the light than with all balls far away."""
    subject = make_balls("cpu", Shading())

    def far_away(time: float) -> dict[str, np.ndarray]:
        transforms = ball_transforms(time)
        for ball in BALLS:
            transforms[ball.name][:3, 3] += [0.0, 0.0, 50.0]
        return transforms

    for time in (0.1, 0.5):
        posed = subject.pose(time)
        subject.surface.bone_transforms = far_away
        alone = subject.pose(time)
        subject.surface.bone_transforms = ball_transforms
        compared = 0
        for ball, azimuth in itertools.product(BALLS, np.radians([-90.0, 0.0, 90.0, 180.0])):
            centre = ball_centre(ball, time)
            shadow = centre - KEY * (centre[2] - TABLE_TOP) / KEY[2]
            if np.linalg.norm(shadow[:2]) > TABLE_RADIUS - 0.05:
                continue
            camera = view(float(azimuth))
            if not subject.visible(posed, camera, torch.tensor(shadow[None], dtype=torch.float32))[0]:
                continue
            x, y = project(camera, shadow[None])[0].astype(int)
            lit, dark = (subject.render(state, camera, 2)[y, x, :3].sum() for state in (alone, posed))
            assert dark < 0.85 * lit, (ball.name, azimuth)
            compared += 1
        assert compared >= 4


def test_balls_cast_shadows_on_each_other():
    """Of a ball right behind another one, as seen from the light, the lit side is dark."""
    subject = make_balls("cpu", Shading())
    first, second = BALLS[0], BALLS[1]
    shares = []
    for distance in (0.7, 50.0):

        def aligned(time: float, distance: float = distance) -> dict[str, np.ndarray]:
            transforms = ball_transforms(time)
            transforms[first.name][:3, 3] = [0.0, 0.0, 0.1]
            transforms[second.name][:3, 3] = [0.0, 0.0, 0.1] + distance * KEY
            return transforms

        subject.surface.bone_transforms = aligned
        posed = subject.pose(0.0)
        part = subject.surface.mesh.bones.index(first.name)
        own = torch.from_numpy(subject.surface.mesh.vertex_part == part)
        facing = own & (posed.normals @ torch.from_numpy(KEY).float() > 0.95)
        shares.append(float(posed.key[facing].mean()))
    assert shares[0] < 0.2 and shares[1] > 0.99


def test_highlights_follow_the_camera():
    """The brightest point of what a highlight adds lies where the normal halves light and eye."""
    subject = make_balls("cpu", Shading())
    shine = subject.raycaster.shine.clone()
    time, ball = 0.3, BALLS[0]
    posed, centre = subject.pose(time), ball_centre(BALLS[0], 0.3)
    found = []
    for azimuth in np.radians([-150.0, -110.0, -70.0]):
        camera = view(float(azimuth), 0.4, 400)
        subject.raycaster.shine = torch.zeros_like(shine)
        plain = subject.render(posed, camera, 1)
        subject.raycaster.shine = shine
        added = (subject.render(posed, camera, 1) - plain)[..., :3].sum(-1).numpy()
        eye = camera.position.double().numpy()
        half = KEY + (eye - centre) / np.linalg.norm(eye - centre)
        half /= np.linalg.norm(half)
        x, y = project(camera, (centre + ball.radius * half)[None])[0]
        rows, columns = np.mgrid[0:400, 0:400]
        near = np.hypot(columns + 0.5 - x, rows + 0.5 - y) < 25.0
        weights = np.where(near, added, 0.0) ** 2
        peak = np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum() + 0.5
        assert added[near].max() > 0.3 and math.hypot(*(peak - [x, y])) < 4.0
        found.append(half)
    assert min(float(a @ b) for a, b in itertools.pairwise(found)) < math.cos(math.radians(10.0))
