"""Contribution of each Gaussian to the training views, the criterion of visibility pruning."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..ops.binning import bin_splats
from ..ops.compositing import composite, demand
from ..ops.projection import project
from ..types import Camera, Gaussians
from .frames import Frames
from .state import TrainState


class Seen(NamedTuple):
    """How sampled views see each Gaussian."""

    most: Tensor
    """[N] pixels, the largest contribution to a view (:func:`view_contributions`); infinite for Gaussians outside all
    of the views, which therefore cannot judge them."""
    views: Tensor
    """[N] int32, number of views to which it contributes at least the threshold."""
    nearest: Tensor
    """[N] least distance to a camera that has it in view; infinite outside all of the views."""


def seen_by(state: TrainState, frames: Frames, indices: list[int], least: float) -> Seen:
    """Measure how these frames see each Gaussian.

    Args:
        least: threshold of the contribution, in pixels.
    """
    most = torch.zeros(len(state.gaussians), device=state.device)
    views = torch.zeros_like(most, dtype=torch.int32)
    nearest = torch.full_like(most, torch.inf)
    ever = torch.zeros_like(most, dtype=torch.bool)
    for index in indices:
        camera = frames.views[index].to(state.device)
        with torch.no_grad():
            camera = state.cameras.apply(camera, index) if state.refines_cameras else camera
            posed = state.motion.gaussians_at(state.gaussians, frames.data.entries[index].time)
        weights, in_view = view_contributions(posed, camera, state.config.antialiased)
        torch.maximum(most, weights, out=most)
        views += weights >= least
        distance = (posed.means.detach() - camera.position).norm(dim=1)
        torch.minimum(nearest, torch.where(in_view, distance, torch.inf), out=nearest)
        ever |= in_view
    return Seen(torch.where(ever, most, torch.inf), views, nearest)


def faintest(contributions: Tensor, share: float) -> Tensor:
    """Find the smallest contributions that together are at most this share of the sum of all.

    Args:
        contributions: [N] pixels (:attr:`Seen.most`). Infinite ones are neither found nor counted.

    Returns:
        [N] bool. Of equal contributions, those of the first rows are found first.
    """
    finite = contributions.isfinite()
    counted = torch.where(finite, contributions, 0.0).cpu().double()  # on a GPU, sums have no fixed order
    order = counted.argsort(stable=True)
    found = torch.empty(len(order), dtype=torch.bool)
    found[order] = counted[order].cumsum(0) <= share * counted.sum()
    return found.to(finite.device) & finite


def view_contributions(gaussians: Gaussians, camera: Camera, antialiased: bool = False) -> tuple[Tensor, Tensor]:
    """Sum each Gaussian's blending weights alpha T over one image.

    Compositing is linear in the channels, so the weights are the gradients of an image of ones.

    Returns:
        [N] pixels, and [N] bool: True if the Gaussian projects into the image, even if others hide it.
    """
    shape = gaussians.quats, gaussians.scales, gaussians.opacities
    size = camera.width, camera.height
    with torch.no_grad():
        options = {"antialiased": antialiased, "sharpness": gaussians.sharpness}
        splats = project(gaussians.means, *shape, camera.viewmat, camera.K, *size, **options)
    with torch.enable_grad():
        ones = torch.ones(len(gaussians.means), 1, device=gaussians.means.device, requires_grad=True)
        image, _ = composite(splats, ones, bin_splats(splats, demand=demand(splats, ones)))
        (weights,) = torch.autograd.grad(image.sum(), ones)
    return weights[:, 0], splats.radii[:, 0] > 0
