"""Scene normalisation: fitted to cameras and points, applied and undone."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from scgs_warp.geometry.normalisation import COMMON_RADIUS, Normalisation
from scgs_warp.types import Camera


def ring(count: int, centre: np.ndarray, radius: float) -> list[Camera]:
    cameras = []
    for index in range(count):
        angle, height = 2 * math.pi * index / count, 0.3 + 0.1 * (index % 3)
        backward = np.array([math.cos(angle), math.sin(angle), height])
        backward /= np.linalg.norm(backward)
        right = np.cross([0.0, 0.0, 1.0], backward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, -np.cross(backward, right), -backward])
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ (centre + radius * backward)
        K = torch.tensor([[500.0, 0, 200], [0, 500.0, 200], [0, 0, 1]])
        cameras.append(Camera(torch.from_numpy(viewmat).float(), K, 400, 400))
    return cameras


def test_cameras_on_a_ring():
    centre, radius = np.array([10.0, -20.0, 5.0]), 40.0
    transform = Normalisation.fit(ring(7, centre, radius))
    assert np.abs(transform.centre - centre).max() < 1e-3
    assert transform.scale * radius * math.sin(math.atan(200 / 500)) == pytest.approx(COMMON_RADIUS, rel=1e-4)
    assert transform.centre.dtype == np.float64


def test_points_and_round_trip():
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(1)) * 30 + torch.tensor([5.0, 6.0, 7.0])
    cameras = ring(5, np.array([5.0, 6.0, 7.0]), 200.0)
    transform = Normalisation.fit(cameras, points)
    normal = transform.apply(points)
    assert normal.norm(dim=1).quantile(0.95) == pytest.approx(COMMON_RADIUS, rel=1e-2)
    assert torch.allclose(transform.undo(normal), points, atol=1e-4)
    assert transform.undo_scale(normal.new_tensor(transform.scale)) == pytest.approx(1.0)
    # A point is seen at the same pixel in either frame; its depth scales.
    camera = transform.apply_camera(cameras[0])
    before = points @ cameras[0].viewmat[:3, :3].T + cameras[0].viewmat[:3, 3]
    after = normal @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    assert torch.allclose(after, before * transform.scale, atol=1e-4)
    assert torch.allclose(transform.undo_camera(camera).viewmat, cameras[0].viewmat, atol=1e-4)


def test_parallel_cameras_are_finite():
    cameras = []
    for x in (-1.0, 0.0, 1.0):
        viewmat = torch.eye(4)
        viewmat[0, 3] = -x
        cameras.append(Camera(viewmat, torch.tensor([[300.0, 0, 100], [0, 300.0, 100], [0, 0, 1]]), 200, 200))
    transform = Normalisation.fit(cameras)
    assert np.isfinite(transform.centre).all() and 0 < transform.scale < math.inf
    assert transform.centre[2] > 0  # in front of the cameras
    single = Normalisation.fit(cameras[:1])
    assert np.isfinite(single.centre).all() and 0 < single.scale < math.inf
