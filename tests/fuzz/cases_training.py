"""Cases of training: losses, Adam, sums, quaternions, shading, densification, whole scenes."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from fuzz.cases_render import camera_of, leaf, on
from fuzz.fence import walled
from fuzz.poison import Draw, finite_rows
from helpers.edit_scenes import OVERVIEW, bar_points, dress
from helpers.quaternion_kernels import products
from scgs_warp.config.presets import DensifyConfig, from_dict
from scgs_warp.errors import UserError
from scgs_warp.gaussians import GaussianParameters
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.motion import Motion, build_motion
from scgs_warp.ops.adam import Update, adam_step, first_not_finite
from scgs_warp.ops.correctives import correct
from scgs_warp.ops.finishing import finish
from scgs_warp.ops.forms import GpuForm
from scgs_warp.ops.harmonics_rotation import SIZES, rotate_harmonics
from scgs_warp.ops.reduction import sum_rows
from scgs_warp.ops.shading import shade, tint
from scgs_warp.ops.ssim import photometric_loss
from scgs_warp.optim import Adam
from scgs_warp.runtime.launch import launch
from scgs_warp.scene.arguments import ROUNDING
from scgs_warp.scene.scene import Scene
from scgs_warp.seeding import generator
from scgs_warp.training.density_control import grow_and_prune
from scgs_warp.types import Camera, Stats

from . import laws

LARGEST_PIXEL = 1e9
"""Largest pixel whose fourth power fits into a float32; beyond it the loss is not finite."""


def case_loss(d: Draw, device: str, form: GpuForm | None = None) -> None:
    """Losses are finite for pixels up to 1e9, ignore masked pixels, and never hide a NaN."""
    (width, height), channels = d.size(), int(d.pick((1, 3, 4)))
    image, truth = d.uniform(channels, height, width), d.uniform(channels, height, width)
    clean, hit = image.clone(), d.rows(channels * height * width)
    d.poison(image.view(-1), hit)
    image[(image.abs() > LARGEST_PIXEL) & image.isfinite()] = 0.25
    form = form or ("plain" if d.chance(0.3) else "auto")
    weight = float(d.pick((0.0, 0.2, 1.0)))
    own = leaf(image.to(device))
    loss, l1, similarity = photometric_loss(own, truth.to(device), None, weight, form=form)
    whole = bool(image.isfinite().all())
    assert bool(l1.isfinite()) == whole, "a broken pixel is hidden, or a good one breaks the loss"
    if whole:
        laws.finite("loss, similarity", loss, similarity)
        laws.finite("gradient of the image", *torch.autograd.grad(loss, own))
    mask = ~hit.view(channels, height, width).any(0).to(device)
    values = []
    for start in (image, clean):
        own = leaf(start.to(device))
        loss, *_ = photometric_loss(own, truth.to(device), mask, weight, form=form)
        values.append((loss.detach(), torch.autograd.grad(loss, own)[0]))
    laws.finite("masked loss and gradient", *values[0])
    laws.equal("masked loss", values[0][0], values[1][0])
    laws.equal("masked gradient", values[0][1], values[1][1])


def case_adam(d: Draw, device: str) -> None:
    """Elements are independent; finite gradients of any size leave finite values that still change."""
    shapes = [d.count() * int(d.pick((1, 3))) + int(d.pick((0, 0, 4096))) for _ in range(int(d.rng.integers(1, 4)))]
    form = "plain" if device != "cpu" or d.chance(0.3) else "cpu"
    start, hits = [d.normal(n) for n in shapes], [d.rows(n) for n in shapes]
    values = [walled(x.to(device)) for x in start]
    clean = [x.clone().to(device) for x in start]
    state = [[walled(torch.zeros(n, device=device)) for n in shapes for _ in range(2)] for _ in range(2)]
    spoilt = [torch.zeros(n, dtype=torch.bool) for n in shapes]
    for step in range(1, 4):
        gradients = [d.normal(n) for n in shapes]
        poisoned = [g.clone() for g in gradients]
        for own, hit, bad in zip(poisoned, hits, spoilt):
            d.poison(own, hit)
            bad |= ~own.isfinite()
        first = first_not_finite([g.to(device) for g in poisoned])
        broken = [i for i, g in enumerate(poisoned) if not bool(g.isfinite().all())]
        assert first == (broken[0] if broken else None), "first_not_finite is wrong"
        for own, used, moments in ((values, poisoned, state[0]), (clean, gradients, state[1])):
            updates = [
                Update(v, walled(g.to(device)), moments[2 * i], moments[2 * i + 1], 0.01, step)
                for i, (v, g) in enumerate(zip(own, used))
            ]
            adam_step(updates, form=form)
    for i, (ours, other, hit, bad) in enumerate(zip(values, clean, hits, spoilt)):
        laws.equal("values with valid gradients", ours.cpu()[~hit], other.cpu()[~hit])
        for tensor in (ours, *state[0][2 * i : 2 * i + 2]):
            laws.finite("values and moments with finite gradients", tensor.cpu()[~bad])
        moved = (ours.cpu() - start[i]).abs()[~bad]
        assert bool((moved < 1.0).all()), "a step beyond the rate"


def case_sums(d: Draw, device: str) -> None:
    """Columns are independent."""
    count, width = d.count() * int(d.pick((1, 40))), int(d.pick((1, 3, 12, 17)))
    values, column = d.normal(count, width), int(d.rng.integers(width))
    clean = sum_rows(values.to(device))
    spoilt = values.clone()
    own = spoilt[:, column].clone()
    d.poison(own, d.rows(count))
    spoilt[:, column] = own
    sums, others = sum_rows(spoilt.to(device)), torch.arange(width, device=device) != column
    laws.equal("sums of the other columns", sums[others], clean[others])
    if not bool(own.isfinite().all()):
        assert not bool(sums[column].isfinite()), "a NaN is hidden"


def case_quaternions(d: Draw, device: str) -> None:
    """Any quaternion is normalised to a rotation."""
    count = d.count()
    a, b, v_quat = d.normal(count, 4), d.normal(count, 4), d.normal(count, 4)
    x, v_vec, hit = d.normal(count, 3), d.normal(count, 3), d.rows(count)
    clean = quaternion_products(a, b, x, v_quat, v_vec, device)
    for tensor in (a, b, x):
        if d.chance():
            d.poison(tensor, hit)
    found = quaternion_products(a, b, x, v_quat, v_vec, device)
    for ours, other in zip(found, clean):
        laws.equal("products of the valid", ours[~hit.to(device)], other[~hit.to(device)])
    laws.finite("unit quaternions", found[3])
    norms = found[3].norm(dim=1)
    assert bool(((norms > 0.49) & (norms < 2.01)).all()), "not unit"


def quaternion_products(a: Tensor, b: Tensor, x: Tensor, v_quat: Tensor, v_vec: Tensor, device: str) -> list[Tensor]:
    outputs = [torch.empty(len(a), n, device=device) for n in (4, 4, 4, 4, 4, 3, 3)]
    launch(products, len(a), *on(device, a, b, x, v_quat, v_vec), *outputs)
    return outputs


def case_shading(d: Draw, device: str) -> None:
    count = d.count()
    inputs = [d.normal(count, 3), 0.5 * d.normal(count, 10), d.normal(count, 4), d.normal(count, 4)]
    check_colors(d, device, shade, inputs)


def case_tint(d: Draw, device: str) -> None:
    count = d.count()
    check_colors(d, device, tint, [d.normal(count, 3), 2.0 * d.normal(count, 3)])


def check_colors(d: Draw, device: str, op: Callable[..., Tensor], inputs: list[Tensor]) -> None:
    """Valid rows are as if alone; gradients of the first two inputs are finite."""
    count = len(inputs[0])
    clean, hit = op(*on(device, *inputs)), d.rows(count)
    for tensor in inputs:
        if d.chance():
            d.poison(tensor, hit)
    leaves = [leaf(x) for x in on(device, *inputs)]
    colors = op(*leaves)
    laws.equal("coefficients of the valid", colors[~hit.to(device)], clean[~hit.to(device)])
    moderate = finite_rows(inputs[0]) & (inputs[0].abs().amax(1) < 1e37) if count else torch.zeros(0, dtype=torch.bool)
    laws.finite("coefficients of finite colours", colors[moderate.to(device)])
    laws.finite("gradients", *torch.autograd.grad(colors, leaves[:2], d.normal(count, 3).to(device)))


def case_correctives(d: Draw, device: str) -> None:
    """Valid rows are as if alone; gradients are finite."""
    count = d.count()
    inputs = [d.normal(count, 3), d.normal(count, 27), d.normal(count, 4), d.normal(count, 4), d.normal(count, 4)]
    clean, hit = correct(*on(device, *inputs)), d.rows(count)
    for tensor in inputs[1:]:
        if d.chance():
            d.poison(tensor, hit)
    leaves = [leaf(x) for x in on(device, *inputs)]
    moved = correct(*leaves)
    laws.equal("means of the valid", moved[~hit.to(device)], clean[~hit.to(device)])
    laws.finite("means", moved)
    laws.finite("gradients", *torch.autograd.grad(moved, leaves[:2], d.normal(count, 3).to(device)))


def case_finishing(d: Draw, device: str) -> None:
    """Valid rows are as if alone, those of gradients too."""
    count, corrected, shaded, tinted = d.count(), d.chance(), d.chance(), d.chance()
    widths = 3, 4, 3, 4, 3, 1, 3, 27 * corrected, 10 * shaded, 3
    inputs = [d.normal(count, width) for width in widths]
    inputs[5] = inputs[5][:, 0]
    v_outputs = on(device, d.normal(count, 3), d.normal(count, 3), d.normal(count, 3)[:, 0], d.normal(count, 3))

    def run() -> list[Tensor]:
        leaves = [leaf(x) for x in on(device, *inputs)]
        extras = (None, leaves[9]) if tinted else (leaves[9], None)
        outputs = finish(leaves[0], leaves[1], tuple(leaves[2:9]), *extras)
        gradients = torch.autograd.grad(outputs, [leaves[0], *leaves[4:]], v_outputs, allow_unused=True)
        return [*outputs, *(x for x in gradients if x is not None)]

    clean, hit = run(), d.rows(count)
    for tensor in inputs:
        if tensor.numel() and d.chance():
            d.poison(tensor, hit)
    for ours, other in zip(run(), clean, strict=True):
        laws.equal("outputs and gradients of the valid", ours[~hit.to(device)], other[~hit.to(device)])


def case_turned_harmonics(d: Draw, device: str) -> None:
    count, rest = d.count(), int(d.pick(SIZES))
    sh, quats, hit = d.normal(count, rest, 3), d.normal(count, 4), d.rows(count)
    clean = rotate_harmonics(*on(device, sh, quats))
    d.poison(sh, hit)
    if d.chance():
        d.poison(quats, hit)
    turned = rotate_harmonics(*on(device, sh, quats))
    laws.equal("coefficients of the valid", turned[~hit.to(device)], clean[~hit.to(device)])
    moderate = finite_rows(sh) & (sh.abs().flatten(1).amax(1) < 1e30) if sh.numel() else torch.zeros(count).bool()
    laws.finite("coefficients that were finite", turned[moderate.to(device)])


def case_densify(d: Draw, device: str) -> None:
    """Any parameters and statistics: invalid Gaussians go, one stays, counts agree, the budget holds."""
    count = max(d.count(), 1)
    made = dress(d.normal(count, 3), seed=d.seed % 1000, degree=1, hyper_columns=2, shaded=d.chance())
    made = made.to(device)
    optimizer = Adam(dict(made.named_parameters()), dict.fromkeys(GaussianParameters.NAMES, 1e-3))
    for parameter in made.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    hit = d.rows(count)
    for name in GaussianParameters.NAMES:
        if d.chance(0.4):
            spoilt = getattr(made, name).detach().cpu().clone()
            d.poison(spoilt, hit)
            getattr(made, name).data.copy_(spoilt)
    stats = Stats(d.uniform(count, high=2.0), torch.ones(count), d.uniform(count))
    for tensor in (stats.grad_norm, stats.count, stats.max_radii):
        if d.chance(0.3):
            d.poison(tensor, d.rows(count))
    stats = Stats(*on(device, stats.grad_norm, stats.count, stats.max_radii))
    config = DensifyConfig(max_gaussians=count + int(d.rng.integers(0, 50)))
    options = {"grad_threshold": 0.5, "extent": 1.0, "prune_large": d.chance(), "random": generator(0, 1)}
    grow_and_prune(made, optimizer, stats, config, **options)
    left = len(made)
    assert 1 <= left <= config.max_gaussians
    for name in GaussianParameters.NAMES:
        assert len(getattr(made, name)) == left and len(optimizer.groups[name].exp_avg) == left
    if left > 1:
        laws.finite("what is kept", *(getattr(made, name) for name in GaussianParameters.NAMES), made.scales())


@functools.lru_cache(maxsize=8)
def motion_of(name: str) -> Motion:
    config = from_dict({"motion": {"nodes": 20, "layers": 2, "width": 32, "skip": 1, "plane_times": 8}})
    motion = build_motion(name, config)
    if name == "control-points":
        with torch.no_grad():
            motion.get_parameter("positions").copy_(bar_points(20, 1))
    return motion.eval()


def case_scene(d: Draw, device: str) -> None:
    """A scene with arbitrary parameters renders to finite pixels at any finite time, and refuses a camera that is
    none."""
    name = d.pick(("control-points", "control-points", "static", "per-gaussian", "hexplane"))
    config = from_dict({"motion": {"model": name, "nodes": 20, "layers": 2, "width": 32, "skip": 1}})
    points, columns = bar_points(int(d.pick((1, 17, 60))), 0), config.motion.hyper_columns
    made, motion = dress(points, shaded=d.chance(), hyper_columns=columns), motion_of(name).to(device)
    hit = d.rows(len(made))
    with torch.no_grad():
        for parameter in (made.means, made.quats, made.log_scales, made.opacity_logits, made.sh_dc, made.shading):
            if d.chance(0.3):
                d.poison(parameter.data, hit)
    scene = Scene(made.to(device), motion, Normalisation(np.zeros(3), 2.0), config, OVERVIEW)
    camera = camera_of(d, *d.size())
    time = float(d.uniform(1)) if d.chance() else float(d.values(1))
    if not math.isfinite(time):
        for call in (scene.gaussians_at, scene.control_points_at, lambda t: scene.render(camera, t)):
            with pytest.raises(UserError, match="time is"):
                call(time)
        return
    if not _is_camera(camera):
        with pytest.raises(ValueError, match=r"viewmat|K"):
            scene.render(camera, time)
        return
    image = scene.render(camera, time)
    laws.finite("rgb, alpha, depth", image.rgb, image.alpha, image.depth)
    inside = min(max(time, 0.0), 1.0)
    laws.equal("means at the clamped time", scene.gaussians_at(time).means, scene.gaussians_at(inside).means)
    laws.finite("means of the valid", scene.gaussians_at(time).means[~hit.to(device)])


def _is_camera(camera: Camera) -> bool:
    finite = bool(camera.viewmat.isfinite().all() and camera.K.isfinite().all())
    last = torch.cat([camera.viewmat[3], camera.K[2]]) - torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    return finite and bool(last.abs().max() <= ROUNDING and camera.K[0, 0] and camera.K[1, 1])


CASES = {
    "loss": (case_loss, 2),
    "adam": (case_adam, 2),
    "sums": (case_sums, 1),
    "quaternions": (case_quaternions, 1),
    "shading": (case_shading, 1),
    "tints": (case_tint, 1),
    "correctives": (case_correctives, 1),
    "finishing": (case_finishing, 1),
    "turned harmonics": (case_turned_harmonics, 1),
    "densify": (case_densify, 1),
    "scene": (case_scene, 2),
}
