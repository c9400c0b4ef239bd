"""How much of the training views each Gaussian makes up: what none of them shows can go."""

from __future__ import annotations

import torch
from torch import Tensor

from .frames import Frames
from .ops.binning import bin_splats
from .ops.compositing import composite, demand
from .ops.projection import project
from .train_state import TrainState
from .types import Camera, Gaussians

FEWEST_VIEWS = 50
STEPS_PER_VIEW = 20
"""One view is looked at for so many steps between two looks, so that they cost some 3 % of the time however many views
there are."""


def contributions(state: TrainState, frames: Frames) -> Tensor:
    """[N] pixels: the most that a Gaussian makes up of any training view (``weights_in``); infinite where it is in none
    of those looked at, which are spread evenly over the time."""
    most = torch.zeros(len(state.gaussians), device=state.device)
    ever = torch.zeros_like(most, dtype=torch.bool)
    count = min(len(frames), max(FEWEST_VIEWS, state.config.densify.opacity_reset_every // STEPS_PER_VIEW))
    for place in range(count):
        index = frames.by_time[place * len(frames) // count]
        camera = frames.cameras[index]
        with torch.no_grad():
            camera = state.cameras.apply(camera, index) if state.refines_cameras else camera
            posed = state.motion.gaussians_at(state.gaussians, frames.frames.entries[index].time)
        weights, in_view = weights_in(posed, camera, state.config.antialiased)
        torch.maximum(most, weights, out=most)
        ever |= in_view
    return torch.where(ever, most, torch.inf)


def weights_in(gaussians: Gaussians, camera: Camera, antialiased: bool = False) -> tuple[Tensor, Tensor]:
    """[N] pixels: each Gaussian's blending weights alpha T, summed over the image; [N] bool, whether it is in view,
    hidden or not. Compositing is linear in the channels: the weights are the gradients of an image of ones."""
    shape = gaussians.quats, gaussians.scales, gaussians.opacities
    size = camera.width, camera.height
    with torch.no_grad():
        splats = project(gaussians.means, *shape, camera.viewmat, camera.K, *size, antialiased=antialiased)
    with torch.enable_grad():
        ones = torch.ones(len(gaussians.means), 1, device=gaussians.means.device, requires_grad=True)
        image, _ = composite(splats, ones, bin_splats(splats, demand=demand(splats, ones)))
        (weights,) = torch.autograd.grad(image.sum(), ones)
    return weights[:, 0], splats.radii[:, 0] > 0
