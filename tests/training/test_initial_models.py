"""Models with which a stage begins: spheres, control points made of them, and the first Gaussians."""

from __future__ import annotations

import pytest
import torch

from helpers.tiny import tiny_config
from scgs_warp.training.initial_models import control_points_from_spheres, initial_gaussians, initial_spheres


def official(**pretrain):
    """Settings of the official form of stage 1, with 16 control points."""
    return tiny_config(pretrain={"densify_by": "gradient", "start_ratio": 1.0, "max_ratio": 4.0, **pretrain})


def test_few_control_points_begin_among_as_many_spheres_as_more_would(device):
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(3)).to(device)
    counts = []
    for nodes in (16, 256, 400):
        config = tiny_config(motion={"nodes": nodes})
        counts.append(len(initial_spheres(config, points, points, device)[0]))
    assert counts == [2048, 2048, 3200]


def test_the_official_start_is_grey_and_has_as_many_spheres_as_control_points(device):
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(1)).to(device)
    gaussians, _ = initial_spheres(official(grey=True), points, points, device)
    assert len(gaussians) == 16 and not gaussians.sh_dc.any()
    assert initial_spheres(official(), points, points, device)[0].sh_dc.any()


def test_control_points_have_the_radius_of_spheres_but_at_least_a_share_of_their_spacing():
    points = torch.linspace(0.0, 1.5, 16)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    for share, radius in ((1.0, 0.1414), (0.5, 0.0707), (0.0, 0.01)):
        config = official(least_radius=share)
        gaussians, spheres = initial_spheres(config, points, points, "cpu")
        with torch.no_grad():
            spheres.log_radius.fill_(0.01).log_()
        radii = control_points_from_spheres(gaussians, spheres, config).log_radii.detach().exp()
        assert radii.tolist() == pytest.approx([radius] * 16, rel=1e-3)


def test_progressive_by_fifths_begins_like_all_frames():
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(1))
    whole, frame, fifth = (
        initial_spheres(official(progressive=on, progressive_by=how), points, points, "cpu")
        for on, how in ((False, "frame"), (True, "frame"), (True, "fifth"))
    )
    assert torch.equal(whole[0].means, fifth[0].means) and torch.equal(whole[1].log_radius, fifth[1].log_radius)
    assert not torch.equal(whole[0].means, frame[0].means)


@pytest.mark.parametrize(("opacity", "solid"), [(0.09, False), (0.11, True)])
def test_gaussians_of_the_main_stage_begin_around_solid_spheres(opacity, solid):
    """The first half of the spheres shows nothing, far away; without any solid one they begin around all."""
    config = tiny_config(init_from="spheres", pretrain={"solid_opacity": 0.1})
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(5))
    spheres = initial_spheres(config, points, points, "cpu")
    with torch.no_grad():
        spheres[0].means[:20] += 90.0
        spheres[0].opacity_logits.copy_(torch.tensor([0.08] * 20 + [opacity] * 20).logit())
    made = initial_gaussians(config, points, points, spheres)
    assert len(made) == config.init_points
    assert bool((made.means[:, 0] < 45.0).all()) == solid
