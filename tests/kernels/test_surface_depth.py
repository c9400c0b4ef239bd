"""Depth of the surface of Gaussians, against float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.scenes import random_camera, random_gaussians
from reference.projection import project as reference_project
from reference.surface_depth import Ray
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.projection import project
from scgs_warp.ops.surface_depth import surface_depth
from scgs_warp.types import Camera, Gaussians

SIZE = 24


def depth_of(gaussians: Gaussians, camera: Camera, device: str, level: float = 0.5) -> np.ndarray:
    on_device = replace(gaussians, **{name: value.to(device) for name, value in gaussians.tensors().items()})
    seen = camera.to(device)
    g = on_device
    splats = project(
        g.means, g.quats, g.scales, g.opacities, seen.viewmat, seen.K, seen.width, seen.height, sharpness=g.sharpness
    )
    return surface_depth(on_device, splats, bin_splats(splats), seen, level).cpu().double().numpy()


@pytest.mark.parametrize(("sharpness", "level"), [(0.0, 0.5), (0.5, 0.3), (0.0, 0.9)])
def test_depth_matches_float64(device, sharpness, level):
    gaussians = replace(random_gaussians(3, 60, degree=0, spread=0.5, scale=(0.03, 0.4)), sharpness=sharpness)
    camera = random_camera(4, SIZE, SIZE)
    found = depth_of(gaussians, camera, device, level)
    shapes = (x.double() for x in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities))
    view = camera.viewmat.double(), camera.K.double()
    splats = reference_project(*shapes, *view, SIZE, SIZE, sharpness=sharpness)
    true = np.array([
        [Ray(gaussians, splats, camera, x, y).depth(level) for x in range(SIZE)] for y in range(SIZE)
    ])  # fmt: skip
    assert 0.15 < (true > 0).mean() < 0.99
    close = np.abs(found - true) < 3e-3
    assert close.mean() > 0.99  # a pixel at the very level may fall on either side


def test_the_surface_of_a_flat_gaussian_is_its_plane_and_not_its_centre(device):
    turn = torch.tensor([[np.cos(np.pi / 6), 0.0, np.sin(np.pi / 6), 0.0]])  # 60 degrees about y
    disc = Gaussians(
        torch.tensor([[0.0, 0.0, 4.0]]), turn.float(), torch.tensor([[0.5, 0.5, 1e-4]]), torch.tensor([0.99]),
        torch.zeros(1, 3), torch.zeros(1, 0, 3),
    )  # fmt: skip
    camera = Camera(torch.eye(4), torch.tensor([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]]), 32, 32)
    depth = depth_of(disc, camera, device)
    y, x = np.nonzero(depth)
    across = (x + 0.5 - 16.0) / 40.0
    np.testing.assert_allclose(depth[y, x], 4.0 / (1.0 + np.tan(np.pi / 3) * across), atol=2e-3)
    assert np.ptp(depth[y, x]) > 0.5


def test_fog_that_never_reaches_the_level_has_no_surface_and_many_thin_layers_have_one(device):
    count = 60  # more than a pixel keeps
    layers = Gaussians(
        torch.column_stack([torch.zeros(count, 2), torch.linspace(3.0, 5.0, count)]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.tensor([[1.0, 1.0, 1e-4]]).repeat(count, 1),
        torch.full((count,), 0.02), torch.zeros(count, 3), torch.zeros(count, 0, 3),
    )  # fmt: skip
    camera = Camera(torch.eye(4), torch.tensor([[40.0, 0, 4], [0, 40.0, 4], [0, 0, 1]]), 8, 8)
    np.testing.assert_array_equal(depth_of(layers, camera, device, 0.9), 0.0)
    needed = int(np.ceil(np.log(0.5) / np.log(1 - 0.02)))
    expected = float(layers.means[needed - 1, 2])
    np.testing.assert_allclose(depth_of(layers, camera, device, 0.5)[3:5, 3:5], expected, atol=0.08)


def test_wrong_sizes_are_refused():
    gaussians, camera = random_gaussians(1, 5, degree=0), random_camera(1, 16, 16)
    shapes = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    splats = project(*shapes, camera.viewmat, camera.K, 16, 16)
    tiles = bin_splats(splats)
    with pytest.raises(ValueError, match="level"):
        surface_depth(gaussians, splats, tiles, camera, 1.0)
    with pytest.raises(ValueError, match="one size"):
        surface_depth(gaussians, splats, tiles, replace(camera, width=17))
    with pytest.raises(ValueError, match="project the same"):
        surface_depth(random_gaussians(1, 6, degree=0), splats, tiles, camera)
