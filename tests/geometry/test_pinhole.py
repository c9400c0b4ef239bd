"""The pinhole model: both conventions of pixels agree, rays lead back to their points, and what lies in an image."""

from __future__ import annotations

import numpy as np
import torch

from scgs_warp.geometry.cameras import look_at
from scgs_warp.geometry.pinhole import in_image, pixels_of, projected, ray_of
from scgs_warp.types import Camera

K = torch.tensor([[110.0, 0.0, 42.0], [0.0, 90.0, 29.0], [0.0, 0.0, 1.0]])
CAMERA = Camera(look_at((1.0, -4.0, 0.5), (0.2, 0.1, 0.0), (0.0, 0.0, 1.0)), K, 80, 60)
POINTS = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)).double() * 2.0 - 1.0


def test_arrays_and_tensors_lie_half_a_pixel_apart():
    pixels, local = projected(POINTS, CAMERA)
    places, depths = pixels_of(CAMERA, POINTS.numpy())
    np.testing.assert_allclose(pixels.numpy() - 0.5, places, atol=1e-9)
    np.testing.assert_allclose(local[:, 2].numpy(), depths, atol=1e-12)
    single, _ = projected(POINTS.float(), CAMERA)
    assert single.dtype == torch.float32 and float((single - pixels).abs().max()) < 1e-3


def test_the_ray_of_a_pixel_goes_through_its_points():
    eye, directions = ray_of(CAMERA, pixels_of(CAMERA, POINTS.numpy())[0])
    np.testing.assert_allclose(eye, CAMERA.position.numpy(), atol=1e-6)
    aside = np.cross(directions, POINTS.numpy() - eye)
    assert np.abs(aside).max() < 1e-6


def test_a_point_in_the_image_is_ahead_and_within_its_borders():
    """The point on the axis, points in the corner pixels and beside them, and one behind the camera."""
    eye = CAMERA.position.double().numpy()
    pixels = np.array([[41.5, 28.5], [-0.4, -0.4], [79.4, 59.4], [-0.6, 10.0], [10.0, 59.6]])
    directions = ray_of(CAMERA, pixels)[1]
    points = torch.from_numpy(np.concatenate([eye + 2.0 * directions, eye - 2.0 * directions[:1]]))
    seen = projected(points, CAMERA)
    assert in_image(*seen, CAMERA).tolist() == [True, True, True, False, False, False]
    assert not in_image(*seen, CAMERA, nearest=2.5).any()
