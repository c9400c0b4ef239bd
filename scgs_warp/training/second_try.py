"""Second try at stage 1, for limbs that have exchanged their tracks.

Where legs pass each other while a figure walks, the left shin may become the right one halfway, since images of single
moments do not tell them apart. Such shins tear off their thighs. If neighbouring spheres part as far as this
(``torn_spheres``), stage 1 is trained again, frame by frame and with neighbours of the moment
(``rigidity.momentary_graph``). The spheres that show the training views better are kept: bodies that truly part tear
likewise, and the second try fits them worse.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from ..data.dataset import Dataset, spread
from ..evaluation.image_metrics import psnr
from .density_control import control_density, density_due, visible_gaussians
from .frames import Frames
from .state import TrainState
from .step import training_step
from .torn_spheres import second_config

VIEWS = 200
"""Largest number of training views by which both tries are compared."""


def try_again(state: TrainState, frames: Frames, go_on: Callable[[int], None]) -> str:
    """Train stage 1 a second time, from its beginning, and let ``state`` keep the better spheres.

    The result follows from the state: a run that is stopped here and resumed from the end of stage 1 repeats it.

    Args:
        state: at the end of stage 1.
        go_on: called after each step with its number; raises KeyboardInterrupt to stop.

    Returns:
        What was found, in one line.
    """
    second = TrainState.begin(second_config(state.config), frames.frames, str(frames.device))
    second.group = state.group
    while second.step < second.config.pretrain_steps:
        visible = visible_gaussians(second, frames)
        size = training_step(second, frames).size
        if density_due(second):
            control_density(second, size, visible)
        second.step += 1
        go_on(second.step)
    first_psnr, second_psnr = shown_psnr(state, frames.frames), shown_psnr(second, frames.frames)
    better = second_psnr > first_psnr
    if better:
        state.enter(second.gaussians, second.motion)
    kept = "second" if better else "first"
    return f"training views: {first_psnr:.2f} dB, the second time {second_psnr:.2f} dB; the {kept} motion is kept"


@torch.no_grad()
def shown_psnr(state: TrainState, data: Dataset) -> float:
    """Return the mean PSNR of at most ``VIEWS`` training views, drawn with the present spheres."""
    scene, total = state.scene(), 0.0
    chosen = spread(len(data), VIEWS)
    for index in chosen:
        frame = data[index]
        image = scene.render(frame.camera, frame.time).rgb.cpu()
        valid = slice(None) if frame.mask is None else frame.mask
        total += float(psnr(image[valid], frame.image[valid]))
    return total / len(chosen)
