"""Gaussians made from points."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from scgs_warp.benchmark.scenes import figure
from scgs_warp.gaussians import SH_C0, GaussianParameters, gaussians_from_points, neighbor_distance
from scgs_warp.geometry.cameras import Overview, orbit_camera
from scgs_warp.rendering.render import render
from scgs_warp.types import plain_scale


def test_neighbor_distance_of_few():
    assert neighbor_distance(torch.zeros(0, 3)).shape == (0,)
    assert neighbor_distance(torch.zeros(1, 3)).shape == (1,)
    assert float(neighbor_distance(torch.tensor([[0.0, 0, 0], [2.0, 0, 0]]))[0]) == pytest.approx(2.0)


def test_neighbor_distance_is_that_of_three():
    """The root of the mean square of the three least distances, not of more or fewer."""
    points = torch.tensor([0.0, 1.0, 3.0, 7.0, 20.0])[:, None] * torch.tensor([0.6, 0.0, 0.8])
    expected = [((1 + 9 + 49) / 3) ** 0.5, ((1 + 4 + 36) / 3) ** 0.5, ((9 + 4 + 16) / 3) ** 0.5]
    expected += [((16 + 36 + 49) / 3) ** 0.5, ((169 + 289 + 361) / 3) ** 0.5]
    torch.testing.assert_close(neighbor_distance(points), torch.tensor(expected))


def test_gaussians_from_points_activate_to_what_was_given():
    points = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    colors = torch.tensor([[0.2, 0.5, 0.9], [0.0, 1.0, 0.5]])
    made = gaussians_from_points(points, colors, sh_degree=2, hyper_columns=4, scale=0.5).activate()
    assert torch.equal(made.means, points) and made.sh_rest.shape == (2, 8, 3) and not made.sh_rest.any()
    torch.testing.assert_close(made.scales, torch.ones(2, 3))
    assert made.quats.tolist() == [[1.0, 0.0, 0.0, 0.0]] * 2
    torch.testing.assert_close(made.opacities, torch.full((2,), 0.1))
    torch.testing.assert_close(0.5 + SH_C0 * made.sh_dc, colors)


def test_plain_gaussians_look_most_alike():
    """Scales that are a little larger or smaller than those of ``plain`` are further from the sharp figure."""
    sharp = dataclasses.replace(figure(4000).activate(), sharpness=0.5)
    camera = orbit_camera(Overview((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 4.0, 40.0, 10.0), 30.0, 96)
    with torch.no_grad():
        truth = render(sharp, camera).rgb
        plain = sharp.plain()
        assert plain.sharpness == 0.0 and plain.plain() is plain
        assert set(plain.tensors()) == {field.name for field in dataclasses.fields(plain)} - {"sharpness"}
        errors = [
            float(
                (render(dataclasses.replace(plain, scales=factor * plain.scales), camera).rgb - truth).square().mean()
            )
            for factor in (0.8, 1.0, 1.25, 1.0 / plain_scale(0.5))
        ]
    assert errors[1] == min(errors) and errors[1] < 0.3 * errors[3]


def test_sharpness_reaches_every_kind_of_gaussians():
    made = gaussians_from_points(torch.rand(5, 3), None, sh_degree=0, hyper_columns=0, sharpness=0.5)
    assert made.sharpness == made.activate().sharpness == 0.5
    assert GaussianParameters.empty(2, 0, 0, False, False, "cpu").sharpness == 0.0
