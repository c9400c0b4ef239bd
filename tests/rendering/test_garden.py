"""The rasteriser on real points (the garden scene, 138,766 of them at 648 x 420) against float64.

Two renderers agree when 99.9 % of the pixels are within the tolerance and none is beyond 8e-3: one alpha that falls on
the other side of 1/255 moves a pixel by that much. Gradients agree by the relative L2 error of each Gaussian's row.
"""

from __future__ import annotations

import pytest
import torch

import scgs_warp
from helpers.scenes import garden
from reference.projection import rows_error
from reference.render import rasterize

BACKGROUND = (0.2, 0.5, 0.7)
C0 = 0.28209479177387814


def inputs_of(data_root, device):
    g, cameras = garden(data_root, device)
    return [g.means, g.quats, g.scales, g.opacities, g.sh_dc * C0 + 0.5], cameras


def ours_of(inputs, camera, mode="RGB+D", **options):
    background = torch.tensor([BACKGROUND], device=inputs[0].device)
    size = camera.width, camera.height
    return scgs_warp.rasterization(
        *inputs[:5], inputs[5][None], camera.K[None], *size, backgrounds=background, render_mode=mode, **options
    )


def twin_of(inputs, camera, crop, meta, **options):
    """The twin in our order: neighbours in depth closer than float32's rounding may lie either way round."""
    background = torch.tensor(BACKGROUND, dtype=torch.float64)
    size, depths = (camera.width, camera.height), meta["depths"][0].detach().cpu()
    result = rasterize(*inputs, camera.K.cpu().double(), *size, background, crop, sort_by=depths, **options)
    torch.testing.assert_close(depths.double(), result[2].depths.detach(), rtol=0, atol=5e-6)
    return result


def double(tensors, grad=False):
    return [x.detach().cpu().double().requires_grad_(grad) for x in tensors]


def assert_images_agree(ours, twin, tolerance, what):
    difference = (ours.detach().cpu().double() - twin.detach()).abs()
    while difference.ndim > 2:
        difference = difference.amax(0)
    share = (difference <= tolerance).double().mean().item()
    assert share >= 0.999, f"{what}: {share:.5f} of the pixels are within {tolerance}"
    return difference.max().item()


def check_forward(data_root, device, view, crop):
    inputs, cameras = inputs_of(data_root, device)
    camera = cameras[view]
    inputs.append(camera.viewmat)
    with torch.no_grad():
        renders, alphas, meta = ours_of(inputs, camera)
        twin, twin_alpha, _ = twin_of(double(inputs), camera, crop, meta)
    x0, y0, x1, y1 = crop
    ours = renders[0].permute(2, 0, 1)[:, y0:y1, x0:x1]
    assert assert_images_agree(ours[:3], twin[:3], 1e-4, "rgb") <= 8e-3
    assert assert_images_agree(alphas[0, y0:y1, x0:x1, 0], twin_alpha, 1e-4, "alpha") <= 8e-3
    # Depth is in world units, up to 10 here: a flipped alpha moves it by as many times 1 / 255.
    assert assert_images_agree(ours[3], twin[3], 1e-3, "depth") <= 8e-3 * max(1.0, twin[3].max().item())
    assert twin_alpha.mean() > 0.3


@pytest.mark.parametrize("view", range(3))
def test_crop(data_root, device, view):
    check_forward(data_root, device, view, (240, 170, 400, 290))


@pytest.mark.slow
def test_full_frame(data_root, device):
    check_forward(data_root, device, 0, (0, 0, 648, 420))


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_gradients_of_a_crop(data_root, device, mode):
    inputs, cameras = inputs_of(data_root, device)
    camera = cameras[0]
    x0, y0, x1, y1 = crop = (304, 190, 368, 238)
    weights = torch.randn(4, y1 - y0, x1 - x0, generator=torch.Generator().manual_seed(0)) / 100
    leaves = [x.detach().clone().requires_grad_() for x in (*inputs, camera.viewmat)]
    renders, _, meta = ours_of(leaves, camera, rasterize_mode=mode)
    ours = renders[0].permute(2, 0, 1)[:, y0:y1, x0:x1]
    gradients = torch.autograd.grad((ours * weights.to(device)).sum(), leaves)
    twin_leaves = double(leaves, grad=True)
    twin, _, _ = twin_of(twin_leaves, camera, crop, meta, antialiased=mode == "antialiased")
    twin_gradients = torch.autograd.grad((twin * weights.double()).sum(), twin_leaves)
    names = ("means", "quats", "scales", "opacities", "colors")
    for name, a, b in zip(names, gradients, twin_gradients):
        error = rows_error(a.cpu(), b)
        touched = b.reshape(len(b), -1).any(1)
        assert touched.sum() > 1000
        assert (error[touched] < 1e-3).double().mean() >= 0.999, f"{name}: {error.max():.2e}"
        assert (a.cpu().double() - b).norm() < 1e-4 * b.norm(), name
    assert (gradients[5].cpu().double() - twin_gradients[5]).norm() < 1e-4 * twin_gradients[5].norm()
