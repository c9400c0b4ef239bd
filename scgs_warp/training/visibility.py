"""Contribution of each Gaussian to the training views, the criterion of visibility pruning."""

from __future__ import annotations

import torch
from torch import Tensor

from ..ops.binning import bin_splats
from ..ops.compositing import composite, demand
from ..ops.projection import project
from ..types import Camera, Gaussians
from .frames import Frames
from .state import TrainState


def contributions(state: TrainState, frames: Frames, indices: list[int]) -> Tensor:
    """Measure each Gaussian's largest contribution to any of these frames.

    Returns:
        [N] pixels (:func:`view_contributions`); infinite for Gaussians outside all of the frames, which therefore
        cannot judge them.
    """
    most = torch.zeros(len(state.gaussians), device=state.device)
    ever = torch.zeros_like(most, dtype=torch.bool)
    for index in indices:
        camera = frames.views[index].to(state.device)
        with torch.no_grad():
            camera = state.cameras.apply(camera, index) if state.refines_cameras else camera
            posed = state.motion.gaussians_at(state.gaussians, frames.frames.entries[index].time)
        weights, in_view = view_contributions(posed, camera, state.config.antialiased)
        torch.maximum(most, weights, out=most)
        ever |= in_view
    return torch.where(ever, most, torch.inf)


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
