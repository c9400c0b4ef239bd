"""``render`` and gsplat's entry point against the float64 rasteriser, and their promises."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
import torch

import scgs_warp
from helpers.scenes import random_camera, random_gaussians
from helpers.torch_settings import SETTINGS
from reference.harmonics import spherical_harmonics as harmonics_reference
from reference.projection import rows_error
from reference.render import rasterize
from scgs_warp.rendering.render import render
from scgs_warp.runtime import environment
from scgs_warp.types import Gaussians, Stats

WIDTH, HEIGHT = 45, 37


def scene_of(seed, n, device, cameras=1, channels=3):
    g = random_gaussians(seed, n, device)
    cams = [random_camera(10 * seed + k, WIDTH, HEIGHT, device) for k in range(cameras)]
    generator = torch.Generator().manual_seed(seed)
    colors = torch.rand(n, channels, generator=generator).to(device)
    backgrounds = torch.rand(cameras, channels, generator=generator).to(device)
    shape = [g.means, g.quats, g.scales, g.opacities]
    return shape, colors, torch.stack([c.viewmat for c in cams]), torch.stack([c.K for c in cams]), backgrounds


def leaves_of(*tensors, double=False):
    return [(x.detach().cpu().double() if double else x.detach().clone()).requires_grad_() for x in tensors]


def agree(ours, twin, tolerance=1e-4):
    difference = (ours.detach().cpu().double() - twin.detach()).abs()
    assert (difference <= tolerance).double().mean() >= 0.999 and difference.max() <= 8e-3


def gradients_agree(ours, twin, names, floor=1e-6):
    for name, a, b in zip(names, ours, twin):
        assert a.shape == b.shape, name
        a, b = a.cpu().double(), b.double()
        error = rows_error(a, b, floor)
        assert (error < 1e-3).double().mean() >= 0.99, f"{name}: {error.max():.2e}"
        assert (a - b).norm() <= 1e-3 * b.norm() + 1e-12, name


def expected(mode, image, alpha):
    """[D, H, W] of the twin's colours and accumulated depth in the given mode."""
    depth = image[-1:]
    if mode.endswith("ED"):
        depth = torch.where(alpha > 0, depth / torch.where(alpha > 0, alpha, 1.0), 0.0)
    return {"RGB": image[:-1], "D": depth, "ED": depth}.get(mode, torch.cat([image[:-1], depth]))


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_modes_values_and_gradients(mode, antialiased, device):
    shape, colors, viewmats, Ks, backgrounds = scene_of(1, 150, device, channels=3)
    inputs = leaves_of(*shape, colors, viewmats, backgrounds)
    renders, alphas, _ = scgs_warp.rasterization(
        *inputs[:6], Ks, WIDTH, HEIGHT, backgrounds=inputs[6], render_mode=mode,
        rasterize_mode="antialiased" if antialiased else "classic",
    )  # fmt: skip
    twins = leaves_of(*shape, colors, viewmats, backgrounds, double=True)
    image, alpha, _ = rasterize(
        *twins[:5], twins[5][0], Ks[0].cpu().double(), WIDTH, HEIGHT, twins[6][0], antialiased=antialiased
    )
    twin = expected(mode, image, alpha)
    assert renders.shape == (1, HEIGHT, WIDTH, len(twin)) and alphas.shape == (1, HEIGHT, WIDTH, 1)
    agree(renders[0].permute(2, 0, 1), twin, 1e-3 if "D" in mode else 1e-4)
    agree(alphas[0, ..., 0], alpha)
    generator = torch.Generator().manual_seed(0)
    weights, alpha_weights = torch.randn(twin.shape, generator=generator), torch.randn(alpha.shape, generator=generator)
    loss = (renders[0].permute(2, 0, 1) * weights.to(device)).sum() + (
        alphas[0, ..., 0] * alpha_weights.to(device)
    ).sum()
    all_names = ["means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds"]
    names = [n for n in all_names if mode.startswith("RGB") or n not in ("colors", "backgrounds")]
    ours = torch.autograd.grad(loss, [inputs[all_names.index(n)] for n in names])
    twin_loss = (twin * weights.double()).sum() + (alpha * alpha_weights.double()).sum()
    theirs = torch.autograd.grad(twin_loss, [twins[all_names.index(n)] for n in names])
    # Expected depth does not depend on the opacity of a splat alone in its pixel: terms of depth / alpha^2, thousands
    # of times the result, cancel, and what remains of them is rounding.
    gradients_agree(ours, theirs, names, floor=1e-2 if mode.endswith("ED") else 1e-6)


@pytest.mark.parametrize("channels", [1, 5, 32, 40])
def test_any_number_of_channels_and_cameras(channels, device):
    shape, colors, viewmats, Ks, backgrounds = scene_of(2, 80, device, cameras=2, channels=channels)
    renders, alphas, meta = scgs_warp.rasterization(
        *shape, colors, viewmats, Ks, WIDTH, HEIGHT, backgrounds=backgrounds
    )
    assert renders.shape == (2, HEIGHT, WIDTH, channels) and meta["n_cameras"] == 2
    for k in range(2):
        doubles = [x.cpu().double() for x in (*shape, colors, viewmats[k], Ks[k])]
        image, alpha, splats = rasterize(*doubles, WIDTH, HEIGHT, backgrounds[k].cpu().double())
        agree(renders[k].permute(2, 0, 1), image[:-1])
        agree(alphas[k, ..., 0], alpha)
        for name in ("means2d", "depths", "conics"):
            seen = (meta["radii"][k] > 0).all(1).cpu()
            ours = meta[name][k].cpu().double()[seen]
            torch.testing.assert_close(ours, getattr(splats, name)[seen], rtol=1e-3, atol=1e-3)
    per_camera = colors.expand(2, -1, -1).contiguous()
    again, _, _ = scgs_warp.rasterization(*shape, per_camera, viewmats, Ks, WIDTH, HEIGHT, backgrounds=backgrounds)
    assert torch.equal(again, renders)


@pytest.mark.parametrize("degree", range(4))
def test_harmonics(degree, device):
    shape, _, viewmats, Ks, _ = scene_of(3, 100, device, cameras=2)
    g = random_gaussians(3, 100, device)
    coefficients = torch.cat([g.sh_dc[:, None], g.sh_rest], 1)
    inputs = leaves_of(*shape, coefficients, viewmats)
    renders, _, _ = scgs_warp.rasterization(*inputs, Ks, WIDTH, HEIGHT, sh_degree=degree)
    twins = leaves_of(*shape, coefficients, viewmats, double=True)
    images = []
    for k in range(2):
        view = twins[5][k]
        camera = -view[:3, :3].T @ view[:3, 3]
        colors = harmonics_reference(twins[4][:, 0], twins[4][:, 1:], twins[0], camera, degree)
        images.append(rasterize(*twins[:4], colors, view, Ks[k].cpu().double(), WIDTH, HEIGHT)[0][:3])
    twin = torch.stack(images).permute(0, 2, 3, 1)
    agree(renders, twin)
    weights = torch.randn(twin.shape, generator=torch.Generator().manual_seed(degree))
    ours = torch.autograd.grad((renders * weights.to(device)).sum(), inputs)
    theirs = torch.autograd.grad((twin * weights.double()).sum(), twins)
    gradients_agree(ours, theirs, ("means", "quats", "scales", "opacities", "colors", "viewmats"))
    per_camera = coefficients.expand(2, -1, -1, -1)
    again, _, _ = scgs_warp.rasterization(*shape, per_camera, viewmats, Ks, WIDTH, HEIGHT, sh_degree=degree)
    assert torch.equal(again, renders)


@pytest.mark.parametrize("cameras", [1, 2])
def test_means2d_retains_its_gradient_and_absgrad(device, cameras):
    shape, colors, viewmats, Ks, _ = scene_of(4, 60, device, cameras=cameras)
    inputs = leaves_of(*shape)
    renders, _, meta = scgs_warp.rasterization(*inputs, colors, viewmats, Ks, WIDTH, HEIGHT, absgrad=True)
    meta["means2d"].retain_grad()
    renders.square().sum().backward()
    grad, absgrad = meta["means2d"].grad, meta["means2d"].absgrad
    assert grad.shape == absgrad.shape == (cameras, 60, 2)
    assert (absgrad >= grad.abs() - 1e-4 * absgrad.max()).all()
    seen = (meta["radii"] > 0).all(-1)
    assert absgrad[seen].any(-1).double().mean() > 0.8 and not absgrad[~seen].any()
    assert absgrad.sum() > 1.2 * grad.abs().sum()  # per-pixel gradients cancel


def test_names_order_and_defaults_are_those_of_gsplat():
    try:
        from gsplat.rendering import rasterization as theirs
    except Exception as error:
        pytest.skip(f"gsplat cannot be imported: {error}")
    ours = inspect.signature(scgs_warp.rasterization).parameters
    other = inspect.signature(theirs).parameters
    assert list(ours) == list(other)
    for name in ours:
        default = ours[name].default
        assert default == other[name].default or default == getattr(other[name].default, "name", None), name


@pytest.mark.parametrize(
    "argument",
    [
        {"camera_model": "fisheye"},
        {"distributed": True},
        {"with_ut": True},
        {"with_eval3d": True},
        {"covars": torch.zeros(5, 3, 3)},
        {"radial_coeffs": torch.zeros(1, 6)},
        {"rolling_shutter": "ROLLING_TOP_TO_BOTTOM"},
        {"viewmats_rs": torch.eye(4)[None]},
        {"sh_degree": 4},
        {"render_mode": "normals"},
        {"rasterize_mode": "sharp"},
        {"backgrounds": torch.zeros(3)},
        {"colors": torch.zeros(4, 3)},
        {"viewmats": torch.eye(4)},
        {"Ks": torch.eye(3)},
        {"means": torch.zeros(5, 3, dtype=torch.float64)},
        {"means": torch.zeros(2, 5, 3)},
        {"opacities": torch.zeros(5, 1)},
        {"means": None},
        {"colors": None},
        {"viewmats": None},
        {"sh_degree": 1, "colors": torch.zeros(5, 3, 3)},
        {"sh_degree": 1.5, "colors": torch.zeros(5, 16, 3)},
        {"sh_degree": "1", "colors": torch.zeros(5, 16, 3)},
        {"width": "45"},
        {"height": 37.5},
        {"height": None},
        {"near_plane": None},
        {"far_plane": float("nan")},
        {"eps2d": "small"},
        {"scales": torch.ones(5, 3).to_sparse()},
        {"quats": torch.ones(5, 4, device="meta")},
        {"Ks": torch.eye(3, device="meta")[None]},
    ],
    ids=lambda a: "-".join(a),
)
def test_what_is_wrong_or_not_done_is_named(argument):
    shape, colors, viewmats, Ks, _ = scene_of(5, 5, "cpu")
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height")
    arguments = dict(zip(names, (*shape, colors, viewmats, Ks, WIDTH, HEIGHT))) | argument
    with pytest.raises((ValueError, NotImplementedError), match=next(iter(argument))):
        scgs_warp.rasterization(**arguments)


@pytest.mark.parametrize("setting", SETTINGS)
def test_what_the_caller_has_set_for_torch_changes_nothing(setting):
    def drawn():
        inputs = leaves_of(*shape, coefficients, viewmats)
        renders, alphas, meta = scgs_warp.rasterization(
            *inputs, Ks, WIDTH, HEIGHT, sh_degree=3, render_mode="RGB+ED", absgrad=True
        )
        (renders.square().sum() + alphas.sum()).backward()
        return [renders, alphas, meta["means2d"].absgrad, *(leaf.grad for leaf in inputs)]

    g = random_gaussians(3, 100)
    shape, _, viewmats, Ks, _ = scene_of(3, 100, "cpu")
    coefficients = torch.cat([g.sh_dc[:, None], g.sh_rest], 1)
    plain = drawn()
    with SETTINGS[setting]():
        changed = drawn()
    assert all(torch.equal(a, b) for a, b in zip(plain, changed))


def test_meta_says_what_it_does_not_hold():
    shape, colors, viewmats, Ks, _ = scene_of(4, 6, "cpu")
    meta = scgs_warp.rasterization(*shape, colors, viewmats, Ks, WIDTH, HEIGHT)[2]
    assert "gaussian_ids" not in meta and meta.get("gaussian_ids") is None and len(meta) == 8
    with pytest.raises(KeyError, match=r"gaussian_ids: not in meta, which holds means2d, .* give packed=False"):
        meta["gaussian_ids"]


def test_arrays_of_numpy_are_named():
    arrays = [np.zeros((2, columns), np.float32) for columns in (3, 4, 3)]
    with pytest.raises(ValueError, match=r"means must be a torch tensor, got ndarray; use torch\.as_tensor"):
        scgs_warp.rasterization(*arrays, np.zeros(2), np.zeros((2, 3)), np.eye(4)[None], np.eye(3)[None], 8, 8)


def test_render_is_rasterization_with_expected_depth(device):
    g, camera = random_gaussians(6, 120, device), random_camera(6, WIDTH, HEIGHT, device)
    background = torch.tensor([0.1, 0.2, 0.3], device=device)
    image = render(g, camera, background)
    assert image.rgb.permute(2, 0, 1).is_contiguous()
    coefficients = torch.cat([g.sh_dc[:, None], g.sh_rest], 1)
    renders, alphas, _ = scgs_warp.rasterization(
        g.means, g.quats, g.scales, g.opacities, coefficients, camera.viewmat[None], camera.K[None], WIDTH, HEIGHT,
        sh_degree=3, backgrounds=background[None], render_mode="RGB+ED",
    )  # fmt: skip
    torch.testing.assert_close(image.rgb, renders[0, ..., :3], rtol=0, atol=1e-6)
    torch.testing.assert_close(image.depth, renders[0, ..., 3], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(image.alpha, alphas[0, ..., 0], rtol=0, atol=1e-6)
    assert (image.depth[image.alpha == 0] == 0).all() and image.depth.max() > 1


def test_empty_scene_is_the_background(device):
    g, camera = random_gaussians(7, 0, device), random_camera(7, WIDTH, HEIGHT, device)
    leaves = Gaussians(*(x.requires_grad_() for x in g.tensors().values()))
    background = torch.tensor([0.1, 0.2, 0.3], device=device, requires_grad=True)
    image = render(leaves, camera, background)
    assert torch.equal(image.rgb, background.detach().expand(HEIGHT, WIDTH, 3))
    assert not image.alpha.any() and not image.depth.any()
    image.rgb.sum().backward()
    torch.testing.assert_close(background.grad, torch.full_like(background, WIDTH * HEIGHT))


def test_broken_gaussians_leave_no_trace(device):
    g, camera = random_gaussians(8, 60, device), random_camera(8, WIDTH, HEIGHT, device)
    kept = render(Gaussians(*(x[:50] for x in g.tensors().values())), camera)
    for row, name in enumerate(("means", "quats", "scales", "opacities")):
        getattr(g, name)[50 + 2 * row] = float("nan")
        getattr(g, name)[51 + 2 * row] = float("inf")
    g.opacities[58:] = 0.0
    leaves = Gaussians(*(x.requires_grad_() for x in g.tensors().values()))
    image = render(leaves, camera)
    torch.testing.assert_close(image.rgb, kept.rgb)
    (image.rgb.square().sum() + image.depth.sum()).backward()
    assert all(x.grad.isfinite().all() for x in leaves.tensors().values())


def test_stats_are_filled_by_the_backward_pass(device):
    g, camera = random_gaussians(9, 60, device), random_camera(9, WIDTH, HEIGHT, device)
    means = g.means.clone().requires_grad_()
    stats = Stats.zeros(60, device)
    moved = Gaussians(means, g.quats, g.scales, g.opacities, g.sh_dc, g.sh_rest)
    for turn in (1, 2):
        render(moved, camera, stats=stats).rgb.square().mean().backward()
        assert stats.count.max() == turn
    assert (stats.grad_norm > 0).sum() > 20 and stats.max_radii.max() > 0


def test_same_bits_for_any_thread_count(all_threads):
    g, camera = random_gaussians(10, 3000), random_camera(10, 128, 96)
    results = []
    for threads in (1, 2, 3):
        environment.configure(threads=threads)
        leaves = Gaussians(*(x.detach().clone().requires_grad_() for x in g.tensors().values()))
        viewmat = camera.viewmat.clone().requires_grad_()
        image = render(leaves, type(camera)(viewmat, camera.K, 128, 96))
        (image.rgb.square().mean() + image.depth.mean()).backward()
        results.append([image.rgb, image.depth, viewmat.grad, *(x.grad for x in leaves.tensors().values())])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))
