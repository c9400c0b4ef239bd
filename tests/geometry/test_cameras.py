"""Cameras for films: the overview of synthetic captures, look_at, paths."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scgs_warp.geometry import cameras
from scgs_warp.types import Camera

K = torch.tensor([[100.0, 0.0, 40.0], [0.0, 100.0, 30.0], [0.0, 0.0, 1.0]])


def capture(
    azimuths, elevations, *, centre=(0.3, -0.2, 0.1), radius=4.0, up=(0.0, 0.0, 1.0), frame=None
) -> list[Camera]:
    """Cameras around ``centre``; ``frame`` [3, 3] turns the whole capture."""
    found = []
    frame = np.eye(3) if frame is None else frame
    for azimuth, elevation in zip(np.radians(azimuths), np.radians(elevations)):
        aside = np.array([math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), 0.0])
        eye = np.array(centre) + radius * (aside + np.array([0, 0, math.sin(elevation)]))
        found.append(Camera(cameras.look_at(frame @ eye, frame @ np.array(centre), frame @ np.array(up)), K, 80, 60))
    return found


@given(
    st.lists(st.floats(-5, 5, allow_subnormal=False), min_size=3, max_size=3),
    st.lists(st.floats(-5, 5, allow_subnormal=False), min_size=3, max_size=3),
    st.lists(st.floats(-1, 1, allow_subnormal=False), min_size=3, max_size=3),
)
@settings(deadline=None, max_examples=60)
def test_look_at_is_a_rotation_with_the_target_in_the_middle(eye, target, up) -> None:
    if np.linalg.norm(np.subtract(eye, target)) < 1e-3:
        return
    viewmat = cameras.look_at(eye, target, up).double()
    rotation = viewmat[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double(), atol=1e-6, rtol=0)
    assert torch.linalg.det(rotation) > 0
    seen = rotation @ torch.tensor(target, dtype=torch.float64) + viewmat[:3, 3]
    assert seen[:2].abs().max() < 1e-5 and seen[2] > 0
    assert (rotation @ torch.tensor(up, dtype=torch.float64))[1] < 1e-6  # up is upwards: -y


def test_look_at_takes_tensors_that_need_a_gradient_and_names_what_is_no_vector() -> None:
    eye = torch.tensor([0.0, -4.0, 0.0])
    found = cameras.look_at(eye.clone().requires_grad_(), [0, 0, 0], (0, 0, 1))
    assert torch.equal(found, cameras.look_at(eye.numpy(), [0, 0, 0], (0, 0, 1))) and not found.requires_grad
    with pytest.raises(ValueError, match="target must be 3 finite numbers, got "):
        cameras.look_at(eye, [0, float("nan"), 0], (0, 0, 1))
    with pytest.raises(ValueError, match=r"up must be 3 finite numbers, got \(0, 1\)"):
        cameras.look_at(eye, [0, 0, 0], (0, 1))


def test_look_at_nowhere_raises() -> None:
    with pytest.raises(ValueError, match="coincide"):
        cameras.look_at([1, 2, 3], [1, 2, 3], [0, 0, 1])


@pytest.mark.parametrize("seed", range(4))
def test_full_orbit(seed: int) -> None:
    """A hemisphere of cameras in any world frame: centre, up, radius and field of view come back."""
    random = np.random.default_rng(seed)
    frame = np.linalg.qr(random.normal(size=(3, 3)))[0]
    frame *= np.sign(np.linalg.det(frame))
    azimuths, elevations = random.uniform(0, 360, 60), random.uniform(5, 60, 60)
    found = cameras.overview(capture(azimuths, elevations, frame=frame))
    np.testing.assert_allclose(found.centre, frame @ [0.3, -0.2, 0.1], atol=1e-4)
    np.testing.assert_allclose(found.up, frame @ [0, 0, 1], atol=1e-3)
    assert found.radius == pytest.approx(4.0, abs=1e-3)
    assert found.elevation == pytest.approx(np.median(elevations), abs=0.1)
    assert found.fov_x == pytest.approx(2 * math.degrees(math.atan(0.4)))
    assert found.sweep == 360.0 and found.aspect == pytest.approx(4 / 3)
    first = cameras.turntable(found, 12, 64)[0]
    eye = frame.T @ first.position.double().numpy() - [0.3, -0.2, 0.1]
    assert math.degrees(math.atan2(eye[1], eye[0])) % 360 == pytest.approx(azimuths[0] % 360, abs=0.1)


def test_tilted_level_cameras_still_agree_on_up() -> None:
    """All cameras look down steeply from one half: the mean of their -y axes is wrong, their x axes are not."""
    found = cameras.overview(capture(np.linspace(0, 150, 20), np.full(20, 60.0)))
    np.testing.assert_allclose(found.up, [0, 0, 1], atol=1e-3)


def test_forward_facing_arc_swings_inside() -> None:
    azimuths = np.linspace(160, 200, 21)
    found = cameras.overview(capture(azimuths, 10 + 3 * np.sin(azimuths)))
    assert found.sweep == pytest.approx(40, abs=0.5) and found.azimuth == pytest.approx(180, abs=0.5)
    np.testing.assert_allclose(found.centre, (0.3, -0.2, 0.1), atol=1e-3)
    angles = []
    for camera in cameras.turntable(found, 40, 64):
        x, y, _ = (camera.position.double().numpy() - found.centre).tolist()
        angles.append(math.degrees(math.atan2(y, x)) % 360)
    assert min(angles) == pytest.approx(180 - 16, abs=1.0) and max(angles) == pytest.approx(180 + 16, abs=1.0)
    assert np.abs(np.diff([*angles, angles[0]])).max() < 4  # it loops without a jump


def test_arc_across_zero_azimuth() -> None:
    found = cameras.overview(capture([340, 350, 0, 10, 20], [15] * 5))
    assert found.sweep == pytest.approx(40, abs=0.1)
    assert math.cos(math.radians(found.azimuth)) > 0.999


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_parallel_axes_look_in_front(spread: float) -> None:
    found = []
    for x in np.linspace(-spread, spread, 5):
        found.append(Camera(cameras.look_at([x, 0, 0], [x, 3, 0], [0, 0, 1]), K, 80, 60))
    view = cameras.overview(found)
    assert view.centre[1] > 0 and view.radius > 0 and math.isfinite(view.azimuth)
    assert view.up == pytest.approx((0, 0, 1), abs=1e-6)


def test_diverging_axes_look_in_front() -> None:
    """Axes that meet behind the cameras: looking outwards from a small arc."""
    found = []
    for angle in np.radians(np.linspace(60, 120, 9)):
        eye = np.array([math.cos(angle), math.sin(angle), 0])
        found.append(Camera(cameras.look_at(eye, 2 * eye, [0, 0, 1]), K, 80, 60))
    assert cameras.overview(found).centre[1] > 1


def test_one_camera_and_none() -> None:
    view = cameras.overview(capture([30], [20]))
    assert all(math.isfinite(value) for value in (*view.centre, *view.up, view.radius, view.azimuth, view.sweep))
    assert len(cameras.turntable(view, 3, 32)) == 3
    with pytest.raises(ValueError, match="empty"):
        cameras.overview([])


def test_overview_survives_json() -> None:
    view = cameras.overview(capture([0, 100, 200], [10, 20, 30]))
    assert cameras.Overview.from_dict(json.loads(json.dumps(view.to_dict()))) == view


def test_turntable_sizes_and_ranges() -> None:
    view = cameras.overview(capture(np.arange(0, 360, 30), [20] * 12))
    path = cameras.turntable(view, 4, 100, (0.0, 180.0))
    assert (path[0].width, path[0].height) == (100, 76)
    assert float(path[0].K[0, 0]) == pytest.approx(100 * 100 / 80)  # same field of view at another size
    directions = [np.subtract(camera.position.double().numpy(), view.centre) for camera in path]
    turns = [np.degrees(np.arctan2(d[1], d[0])) for d in directions]
    np.testing.assert_allclose(turns, [0, 45, 90, 135], atol=1e-2)
    with pytest.raises(ValueError, match="frames"):
        cameras.turntable(view, 0, 64)


@pytest.mark.parametrize(("elevation", "height"), [(0.0, 0.0), (30.0, 0.5), (-30.0, -0.5), (None, 0.5**0.5)])
def test_orbit_cameras_stand_on_the_sphere_at_their_elevation(elevation, height) -> None:
    overview = cameras.Overview((1.0, 2.0, 3.0), (0.0, 0.0, 1.0), 5.0, 40.0, 45.0, 10.0, 360.0, 1.5, 800.0)
    camera = cameras.orbit_camera(overview, 75.0, 300, elevation)
    offset = camera.position.double() - torch.tensor(overview.centre)
    assert float(offset.norm()) == pytest.approx(5.0, rel=1e-5)
    assert float(offset[2]) == pytest.approx(5.0 * height, abs=1e-5)
    assert math.degrees(math.atan2(offset[1], offset[0])) == pytest.approx(75.0, abs=1e-3)


def test_orbit_cameras_keep_off_the_poles() -> None:
    """Above them the picture would turn by any angle."""
    overview = cameras.Overview((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 5.0, 40.0, 45.0, 10.0, 360.0, 1.5, 800.0)
    for elevation in (90.0, 120.0, 1e9):
        for sign in (1.0, -1.0):
            eye = cameras.orbit_camera(overview, 75.0, 300, sign * elevation).position
            assert float(eye[2]) == pytest.approx(sign * 5.0 * math.sin(math.radians(cameras.STEEPEST)), rel=1e-6)
            assert math.degrees(math.atan2(eye[1], eye[0])) == pytest.approx(75.0, abs=0.01)
