"""Fusion of depth images, against float64, and of exact images of a ball."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.scenes import look_at, random_camera
from reference.fusion import observe
from scgs_warp.ops.fusion import Volume, grid_shape
from scgs_warp.types import Camera

RADIUS = 0.5


def ball_depth(camera: Camera, centre: np.ndarray | None = None, radius: float = RADIUS) -> torch.Tensor:
    """[H, W] exact depth of a ball."""
    K, view = camera.K.double().numpy(), camera.viewmat.double().numpy()
    y, x = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], np.ones(x.shape)], axis=-1)
    middle = view[:3, :3] @ (np.zeros(3) if centre is None else centre) + view[:3, 3]
    a, b, c = (rays**2).sum(-1), rays @ middle, middle @ middle - radius**2
    inside = b * b - a * c
    return torch.from_numpy(np.where(inside > 0, (b - np.sqrt(np.maximum(inside, 0))) / a, 0.0)).float()


def test_one_view_matches_float64(device):
    camera = random_camera(5, 20, 18, distance=2.5)
    depth = ball_depth(camera)
    depth[4:6, :] = 0.0  # a gap
    volume = Volume.empty(np.full(3, -0.7), np.full(3, 0.7), 0.13, 0.4, device)
    volume.add(depth.to(device), camera)
    sums, weights = volume.sums.cpu().double().numpy(), volume.weights.cpu().double().numpy()
    off = 0
    for index in np.ndindex(*sums.shape):
        place = volume.lower + volume.voxel * np.array(index)
        distance, weight = observe(depth.double().numpy(), camera, place, volume.truncation)
        off += abs(sums[index] - weight * distance) > 1e-4 or abs(weights[index] - weight) > 1e-4
    assert off <= 0.005 * sums.size  # places that project to the edge of a pixel
    assert (weights == 0).any() and (sums < 0).any() and (sums == 1.0).any()


def test_views_from_all_around_give_the_distances_of_a_ball(device):
    volume = Volume.empty(np.full(3, -0.8), np.full(3, 0.8), 0.05, 0.2, device)
    for direction in np.concatenate([np.eye(3), -np.eye(3), np.ones((1, 3)) / 3**0.5, -np.ones((1, 3)) / 3**0.5]):
        eye = torch.tensor(3.0 * direction)
        viewmat = look_at(eye, torch.zeros(3).double(), torch.tensor([0.3, 0.4, 0.5]).double()).float()
        camera = Camera(viewmat, torch.tensor([[200.0, 0, 64], [0, 200.0, 64], [0, 0, 1]]), 128, 128)
        volume.add(ball_depth(camera).to(device), camera)
    distances = volume.distances().cpu().double().numpy() * volume.truncation
    index = np.indices(distances.shape).transpose(1, 2, 3, 0)
    true = np.linalg.norm(volume.lower + volume.voxel * index, axis=-1) - RADIUS
    near = np.abs(true) < 0.05
    assert np.abs(distances - true)[near].mean() < 0.025
    assert (distances[true < -0.25] == -volume.truncation).all() and (distances[true > 0.3] > 0.1).all()


def test_sizes_that_do_not_fit_are_refused():
    volume = Volume.empty(np.zeros(3), np.ones(3), 0.5, 1.0)
    with pytest.raises(ValueError, match="depth must be"):
        volume.add(torch.zeros(4, 5), random_camera(1, 4, 5))
    assert grid_shape(np.zeros(3), np.array([1.0, 0.2, 0.0]), 0.5) == (3, 2, 2)
