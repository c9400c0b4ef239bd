"""How much of the training views each Gaussian makes up: what none of them shows can go."""

from __future__ import annotations

import torch
from torch import Tensor

from ..ops.binning import bin_splats
from ..ops.compositing import composite, demand
from ..ops.projection import project
from ..seeding import generator
from ..types import Camera, Gaussians
from .densify import prunes_unseen
from .frames import Frames
from .state import TrainState

STEPS_PER_VIEW = 20
"""At most one view is looked at for so many steps since the last look: a few percent of the time, as a view takes about
half of a step's."""
MOST_VIEWS, FEWEST_VIEWS = 300, 50
"""More are not needed to see every side; fewer, where there are more, do not see enough to judge by."""


def seen(state: TrainState, frames: Frames) -> Tensor | None:
    """Which Gaussians are to stay when the present step is done: those that make up ``densify.min_contribution`` pixels
    of one of the views looked at, drawn at random, other ones each time.

    Returns:
        [N] bool; None where nothing is due, or the run is too short for enough views.
    """
    config = state.config.densify
    done = state.stage_step + 1
    if state.stage == "pretrain" or not prunes_unseen(config, done):
        return None
    steps = config.until if done == config.until else config.opacity_reset_every
    count = min(len(frames), MOST_VIEWS, steps // STEPS_PER_VIEW)
    if count < min(len(frames), FEWEST_VIEWS):
        return None
    order = torch.randperm(len(frames), generator=generator(state.config.seed, 52, state.step))
    return contributions(state, frames, order[:count].tolist()) >= config.min_contribution


def contributions(state: TrainState, frames: Frames, indices: list[int]) -> Tensor:
    """[N] pixels: the most that a Gaussian makes up of any of these frames (``weights_in``); infinite where it is drawn
    in none of them, hidden or not: about that these views say nothing."""
    most = torch.zeros(len(state.gaussians), device=state.device)
    ever = torch.zeros_like(most, dtype=torch.bool)
    for index in indices:
        camera = frames.cameras[index]
        with torch.no_grad():
            camera = state.cameras.apply(camera, index) if state.refines_cameras else camera
            posed = state.motion.gaussians_at(state.gaussians, frames.frames.entries[index].time)
        weights, in_view = weights_in(posed, camera, state.config.antialiased)
        torch.maximum(most, weights, out=most)
        ever |= in_view
    return torch.where(ever, most, torch.inf)


def weights_in(gaussians: Gaussians, camera: Camera, antialiased: bool = False) -> tuple[Tensor, Tensor]:
    """[N] pixels: each Gaussian's blending weights alpha T, summed over the image; [N] bool, whether it is drawn,
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
