"""The hexplane model against its own layers in torch, and what its packed weights must notice."""

from __future__ import annotations

import dataclasses

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from helpers.tiny import tiny_config, trained_pose
from scgs_warp.config.presets import LossConfig, MotionConfig, TrainConfig
from scgs_warp.gaussians import GaussianParameters
from scgs_warp.motion import build_motion
from scgs_warp.motion.hexplane import BOUND, HexPlane
from scgs_warp.ops.planes import PAIRS, Smoothness, plane_variation
from scgs_warp.runtime import environment
from scgs_warp.training.initial_models import initial_motion


def model_and_gaussians(seed: int, count: int = 60) -> tuple[HexPlane, GaussianParameters]:
    random = torch.Generator().manual_seed(seed)
    model = HexPlane(seed)
    with torch.no_grad():
        for plane in model.planes:
            plane.mul_(0.5 + torch.rand(plane.shape, generator=random))
        for head in model.heads.values():
            head[-1].weight.copy_(0.1 * torch.randn(head[-1].weight.shape, generator=random))  # type: ignore[index]
    points = 1.5 * torch.randn(count, 3, generator=random)
    return model, GaussianParameters(points, 0.1 * points, points)


def in_torch(model: HexPlane, gaussians: GaussianParameters, time: float) -> list[Tensor]:
    """Means, quaternions, scales: grid_sample, then the layers one by one."""
    when = gaussians.means.new_full((len(gaussians), 1), 2.0 * time - 1.0)
    where = torch.cat([gaussians.means / BOUND, when], dim=1)
    features = []
    for level in (0, 6):
        product = torch.ones(32, len(gaussians))
        for place, pair in enumerate(PAIRS):
            image, grid = model.planes[level + place].permute(2, 0, 1)[None], where[:, pair].view(1, 1, -1, 2)
            product = product * F.grid_sample(image, grid, align_corners=True, padding_mode="border")[0, :, 0]
        features.append(product)
    hidden = model.trunk(torch.cat(features).T)
    change = {name: head(hidden) for name, head in model.heads.items()}
    log_scales = gaussians.log_scales + change["log_scales"]
    return [gaussians.means + change["means"], gaussians.quats + change["quats"], log_scales.exp()]


@pytest.mark.parametrize("time", [0.0, 0.43, 1.0])
@pytest.mark.parametrize("seed", range(2))
def test_agrees_with_its_layers_in_torch(seed, time):
    model, gaussians = model_and_gaussians(seed)
    posed = model.gaussians_at(gaussians, time)
    found, expected = [posed.means, posed.quats, posed.scales], in_torch(model, gaussians, time)
    parameters = [gaussians.means, gaussians.quats, gaussians.log_scales, *model.parameters()]
    random = torch.Generator().manual_seed(seed)
    v = [torch.randn(value.shape, generator=random) for value in found]
    gradients = [torch.autograd.grad(values, parameters, v) for values in (found, expected)]
    for got, want in [*zip(found, expected), *zip(*gradients)]:
        torch.testing.assert_close(got, want, rtol=1e-3, atol=1e-4)


def test_a_training_step_adds_the_smoothness():
    model, gaussians = model_and_gaussians(3)
    config = TrainConfig()
    pose = trained_pose(model, gaussians, 0.3, config.coarse, config)
    assert pose.regulariser is not None
    loss = config.loss
    smoothness = plane_variation(
        list(model.planes), Smoothness(loss.hexplane_tv, loss.hexplane_smooth, loss.hexplane_rest)
    )
    assert torch.equal(pose.regulariser, smoothness)
    assert torch.equal(pose.gaussians.means, model.gaussians_at(gaussians, 0.3).means)
    both = torch.autograd.grad(pose.gaussians.means.sum() + pose.regulariser, list(model.planes))
    moved = torch.autograd.grad(model.gaussians_at(gaussians, 0.3).means.sum(), list(model.planes))
    smooth = torch.autograd.grad(smoothness, list(model.planes))
    for whole, *parts in zip(both, moved, smooth):
        torch.testing.assert_close(whole, parts[0] + parts[1], rtol=1e-5, atol=1e-6)
    assert trained_pose(model, gaussians, 0.3, config.coarse - 1, config).regulariser is None
    none = dataclasses.replace(config, loss=LossConfig(hexplane_tv=0.0, hexplane_smooth=0.0, hexplane_rest=0.0))
    assert trained_pose(model, gaussians, 0.3, config.coarse, none).regulariser is None


@pytest.mark.parametrize("times, expected", [(0, 7), (30, 30)])
def test_planes_follow_the_number_of_training_times(times, expected):
    config = TrainConfig(motion=MotionConfig("hexplane", plane_times=times))
    model = initial_motion(config, torch.zeros(1, 3), times=15)
    assert isinstance(model, HexPlane)
    assert [plane.shape[0] for plane in model.planes] == [*(3 * [64] + 3 * [expected]), *(3 * [128] + 3 * [expected])]
    again = build_motion("hexplane", config, model.state_dict())
    again.load_state_dict(model.state_dict())


@torch.no_grad()
def test_packed_weights_are_not_kept_when_they_change():
    model, gaussians = model_and_gaussians(4, 9)
    model.eval()
    first = model.gaussians_at(gaussians, 0.3).means
    assert torch.equal(model.gaussians_at(gaussians, 0.3).means, first)
    bias = model.heads["means"][-1].bias  # type: ignore[index]
    bias.add_(1.0)  # counted by torch
    torch.testing.assert_close(model.gaussians_at(gaussians, 0.3).means, first + 1.0)
    model.train()
    bias.numpy()[:] += 1.0  # not counted, as an optimiser's kernel writes
    model.eval()
    torch.testing.assert_close(model.gaussians_at(gaussians, 0.3).means, first + 2.0)


def test_same_bits_with_and_without_gradients():
    model, gaussians = model_and_gaussians(5)
    trained = model.gaussians_at(gaussians, 0.6)
    with torch.no_grad():
        assert torch.equal(model.eval().gaussians_at(gaussians, 0.6).means, trained.means)


def test_same_bits_on_any_number_of_threads(all_threads):
    model, gaussians = model_and_gaussians(6, 5001)  # more rows than the adjoint takes at once
    config = TrainConfig()
    results = []
    for threads in (1, 2, 3):
        environment.configure(threads)
        pose = trained_pose(model, gaussians, 0.4, config.coarse, config)
        posed = [pose.gaussians.means, pose.gaussians.quats, pose.gaussians.scales, pose.regulariser]
        v = [torch.linspace(-1.0, 1.0, p.numel()).view_as(p) for p in posed if p is not None]
        parameters = [gaussians.means, gaussians.quats, gaussians.log_scales, *model.parameters()]
        results.append([*posed, *torch.autograd.grad(posed, parameters, v)])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


@torch.no_grad()
def test_planes_reach_as_far_as_in_4d_gs():
    """Features change up to 1.6 on every axis, and are those of the border beyond."""
    model, _ = model_and_gaussians(7, 9)
    for axis in range(3):
        points = torch.zeros(4, 3)
        points[:, axis] = torch.tensor([1.5, 1.59, 1.6, 9.0])
        features = model.features(points, 0.4)
        torch.testing.assert_close(features[2], features[3], rtol=1e-4, atol=1e-6)
        assert not torch.allclose(features[0], features[2], rtol=1e-2)
        assert not torch.allclose(features[1], features[2], rtol=1e-3)


@torch.no_grad()
def test_a_new_scene_is_at_rest_and_differs_from_place_to_place():
    model = HexPlane(8)
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(8)) * 2.0 - 1.0
    first, second = model.features(points, 0.1), model.features(points, 0.83)
    torch.testing.assert_close(first, second, rtol=1e-5, atol=0.0)
    assert float(first.std(0).min()) > 1e-3


def test_rates_fall_to_a_hundredth_once_the_scene_moves():
    config = tiny_config(30, motion={"model": "hexplane"}, coarse=6, optim={"network_until": 10})
    model, optim = HexPlane(9), config.optim
    factors = []
    for step in (0, 6, 11, 16, 25):
        rates = model.rates(step, config)
        assert rates.keys() == dict(model.named_parameters()).keys()
        factors.append(rates["planes.0"] / optim.planes)
        assert rates["trunk.weight"] / optim.network == pytest.approx(factors[-1])
    assert factors == pytest.approx([1.0, 1.0, 0.1, 0.01, 0.01])
