"""The surface of Gaussians: accuracy, closedness, strays."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from helpers.mesh_scenes import ball_gaussians, still_scene
from scgs_warp.errors import UserError
from scgs_warp.export.mesh.surface import Region, Surface, locate, reconstruct, zero_level
from scgs_warp.export.mesh.views import surroundings_of
from scgs_warp.ops.fusion import Volume
from scgs_warp.runtime import memory

TWO = (((-0.4, 0.0, 0.0), 0.3), ((0.5, 0.1, 0.2), 0.15))


@torch.no_grad()
def made(gaussians, resolution: int = 48) -> tuple[Surface, Region, float]:
    scene = still_scene(gaussians)
    posed = scene.motion.gaussians_at(scene.gaussians, 0.0)
    surroundings = surroundings_of(scene, posed)
    assert surroundings.closed
    region = locate(surroundings, posed)
    unit = scene.normalisation
    found = reconstruct(surroundings, posed, region, resolution)
    return Surface(found.vertices + unit.centre, found.faces), region, region.side / resolution


def test_balls_become_closed_surfaces_where_they_are():
    surface, _, voxel = made(ball_gaussians(TWO))
    mesh = trimesh.Trimesh(*surface, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.body_count == 2
    errors = []
    for centre, radius in TWO:
        distance = np.linalg.norm(surface.vertices - centre, axis=1) - radius
        errors.append(distance[np.abs(distance) < 3 * voxel])
    assert sum(map(len, errors)) == len(surface.vertices)  # nothing else
    error = np.abs(np.concatenate(errors))
    assert error.mean() < 0.6 * voxel and error.max() < voxel
    volume = 4 / 3 * np.pi * sum(radius**3 for _, radius in TWO)
    assert mesh.volume == pytest.approx(volume, rel=0.25)


def test_strays_far_away_do_not_stretch_the_region():
    stray = (((-0.4, 0.0, 0.0), 0.3), ((0.5, 0.1, 0.2), 0.15), ((2.5, 0.0, 0.0), 0.002))
    _, region, _ = made(ball_gaussians(stray[:2]))
    gaussians = ball_gaussians(stray)
    keep = torch.ones(len(gaussians.means), dtype=torch.bool)
    keep[2401:] = False  # one Gaussian of the third ball is left
    for name in type(gaussians).NAMES:
        setattr(gaussians, name, torch.nn.Parameter(getattr(gaussians, name).detach()[keep]))
    _, wider, _ = made(gaussians)
    np.testing.assert_allclose(wider.upper, region.upper, atol=0.03)


def test_nothing_opaque_is_refused():
    gaussians = ball_gaussians(count=60)
    with torch.no_grad():
        gaussians.opacity_logits.fill_(-3.0)
    with pytest.raises(UserError, match=r"no Gaussian is opaque to more than 0\.5"):
        made(gaussians)


def test_a_volume_that_does_not_fit_is_refused_before_it_is_made(monkeypatch):
    monkeypatch.setattr(memory, "fits", lambda need, device: need < 2_000_000)
    with pytest.raises(UserError, match="--resolution"):
        made(ball_gaussians(count=60))


def test_more_voxels_than_kernels_can_count_are_refused(monkeypatch):
    monkeypatch.setattr(memory, "fits", lambda need, device: True)
    with pytest.raises(UserError, match=r"voxels is more than .* smaller --resolution"):
        made(ball_gaussians(count=60), 2000)


def slab(closed: bool) -> Surface:
    """A wall across a volume, of which one half was seen."""
    volume = Volume.empty(np.zeros(3), np.full(3, 1.0), 0.1, 0.3)
    x = torch.arange(11.0)[:, None, None].expand(volume.sums.shape)
    seen = torch.arange(11)[None, :, None].expand(volume.sums.shape) < 6
    volume.sums.copy_(((0.55 - 0.1 * x) / 0.3).clamp(-1, 1) * seen)
    volume.weights.copy_(seen.float())
    return zero_level(volume, closed)


def test_of_an_open_scene_only_what_was_seen_is_kept():
    surface = slab(closed=False)
    used = surface.vertices[np.unique(surface.faces)]
    np.testing.assert_allclose(used[:, 0], 0.55, atol=1e-6)
    assert used[:, 1].max() == pytest.approx(0.5) and used[:, 1].min() == 0.0


@pytest.mark.parametrize("side", [20, 64, 107])
def test_an_open_surface_may_reach_the_border_of_its_volume(side):
    volume = Volume.empty(np.zeros(3), np.array([11.0, side, 6.0]), 1.0, 1.0)
    x, y = (torch.linspace(-1, 1, count) for count in volume.sums.shape[:2])
    volume.sums.copy_((x[:, None] + 0.3 * y)[..., None].expand(volume.sums.shape))
    volume.weights.fill_(1.0)
    surface = zero_level(volume, closed=False)
    assert len(surface.faces) > side and surface.vertices[surface.faces.ravel()].max() == pytest.approx(side)


def test_what_no_view_saw_is_inside_of_a_closed_subject():
    mesh = trimesh.Trimesh(*slab(closed=True), process=False)
    assert mesh.is_watertight and mesh.volume > 0.5
    assert (mesh.vertices > 0.0).all() and (mesh.vertices < 1.0).all()


def test_an_empty_volume_has_no_surface():
    volume = Volume.empty(np.zeros(3), np.ones(3), 0.25, 0.5)
    volume.weights.fill_(1.0)
    volume.sums.fill_(1.0)
    assert zero_level(volume, True).faces.shape == (0, 3)
