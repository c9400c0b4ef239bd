"""Second try at stage 1: with a turn of the whole subject or frame by frame, with neighbours of the moment, and with a
stiffer ARAP.

**Why.** Images of single moments tell neither which of two legs passes the other nor how far a round head turns, and
spheres move no further than the images require. If silhouettes show that the subject turns as a whole
(``body_turn``), the second try begins with this turn. Otherwise it adds frame after frame, so that spheres begin in the
pose of the frame before. Both tie each sphere to its neighbours of the moment (``rigidity.momentary_graph``).

**Which motion is kept.** The one that shows the training views better: bodies that truly part fit the second try worse.
But a round head that does not turn, or limbs that have exchanged their places halfway, show the views as well as the
true motion does, or better. They tear the body: what belongs together at one moment is apart at another. If the subject
may be one body, the second motion is therefore kept in two more cases: if both show the views alike and it tears the
body far less; and if the first tears the body much, the second less, and it does not show the views clearly worse.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

import torch

from ..data.dataset import Dataset, spread
from ..motion.rigidity import tearing
from ..motion.spheres import Spheres
from ..ops.sampling import farthest_points
from ..runtime.environment import one_piece
from .body_turn import find_body_turn, learn_turn
from .density_control import control_density, density_due
from .frames import Frames
from .multi_view import check_replicas
from .second_try_config import HELD, second_config
from .silhouettes import is_one_piece
from .state import StepResult, TrainState
from .stepping import Steps, take_step

VIEWS = 200
"""Largest number of training views by which both tries are compared."""
LEAST_GAIN = 0.1
"""PSNR in dB by which the second motion must be better to be kept for that alone: a smaller gain may be chance."""
CHANCE = 0.25
"""PSNR in dB by which the second motion of one body may be worse if it tears the body far less. Leaving out an eighth
of the frames changed the difference between both by 0.13 and 0.17 on two subjects."""
MOST_LOSS = 1.0
"""The same if the first motion tears the body much and the second less: firmer spheres show less detail."""
TORN = 0.03
"""Tearing that counts as much. Bodies whose limbs keep their places have 0.002 to 0.022."""
LESS, FAR_LESS = 0.75, 0.4
"""Tearing of the second motion, relative to the first, below which it counts as less and far less. Of two motions that
are right, the firmer one has about half."""
INSTANTS = 16
"""Number of instants at which tearing is measured."""
SOLID = 0.1
"""Opacity from which a sphere belongs to the body."""
BESIDE = 6
"""Number of neighbours of a sphere."""
POINTS = 256
"""Number of spheres at which tearing is measured: among more, a smaller share of the edges crosses a tear."""


def try_again(
    state: TrainState,
    frames: Frames,
    steps_of: Callable[[TrainState, Frames], Steps],
    go_on: Callable[[TrainState], None],
    tell: Callable[[str], None] = lambda text: None,
) -> str:
    """Train stage 1 a second time, from its beginning, and let ``state`` keep the better spheres.

    The result follows from the state: a run that is stopped here and resumed from the end of stage 1 repeats it.

    Args:
        state: at the end of stage 1.
        steps_of: returns what takes the steps of a state.
        go_on: called after each step with the state of the second try; raises KeyboardInterrupt to stop.
        tell: gets what is being done before the first step, from time to time; may raise as well.

    Returns:
        What was found, in one line.

    Raises:
        UserError: an image is no longer readable, or the processes of a group differ.
    """
    one_body = is_one_piece(frames.data)
    turn = (
        find_body_turn(frames.data, state.normalisation, tell) if state.config.pretrain.body_turn and one_body else None
    )
    config = second_config(state.config, turning=turn is not None)
    second = TrainState.begin(config, frames.data, str(frames.device), turn)
    if turn is not None:
        assert isinstance(second.motion, Spheres)
        held = round(HELD * config.pretrain_steps)
        learn_turn(second.motion, second.gaussians.means.detach(), turn, held, config.seed, tell)
    second.group = state.group
    failed = _train(second, frames, steps_of, go_on)
    if failed is not None:
        return f"{failed} is not finite the second time; the first motion is kept"
    check_replicas(second)
    before, after = shown_psnr(state, frames.data), shown_psnr(second, frames.data)
    better, reason = after > before + LEAST_GAIN, ""
    if not better and one_body:
        torn = torn_by(state), torn_by(second)
        most, less = (MOST_LOSS, LESS) if torn[0] > TORN else (CHANCE, FAR_LESS)
        better = after > before - most and torn[1] < less * torn[0]
        reason = f": it tears the body less ({torn[1]:.3f}, not {torn[0]:.3f})" if better else ""
    if state.group is not None:  # the first process decides: others may round differently
        better = state.group.any(state.group.first and better)
    if better:
        state.points, state.colors = second.points, second.colors
        state.exposure, state.exposure_optimizer = second.exposure, second.exposure_optimizer
        state.enter(second.gaussians, second.motion)
    kept = "second" if better else "first"
    how = "frame by frame" if turn is None else f"turned by {turn.total:.0f} degrees, as the silhouettes show"
    return f"training views: {before:.2f} dB, then {how}: {after:.2f} dB; the {kept} motion is kept{reason}"


def _train(
    state: TrainState,
    frames: Frames,
    steps_of: Callable[[TrainState, Frames], Steps],
    go_on: Callable[[TrainState], None],
) -> str | None:
    """Train stage 1 of a state to its end.

    Returns:
        The name of a term that was not finite, at which training stops; None if all were.
    """
    ordered = copy.copy(frames)  # the same images in this state's order
    ordered.config = state.config
    steps = steps_of(state, ordered)
    while state.step < state.config.pretrain_steps:
        due, last = density_due(state), state.step + 1 == state.config.pretrain_steps
        results: list[StepResult] = []
        visible = take_step(state, ordered, steps, results, settle=last)
        failed = next((result.failed for result in results if result.failed is not None), None)
        if failed is not None:
            return failed
        if due:
            control_density(state, results[-1].size, visible)
        state.step += 1
        go_on(state)
    steps.release()
    return None


@torch.no_grad()
def torn_by(state: TrainState) -> float:
    """Return by how much the motion of the solid spheres tears the body (``rigidity.tearing``)."""
    spheres, gaussians = state.motion, state.gaussians
    assert isinstance(spheres, Spheres)
    spheres.eval()
    places = gaussians.means + spheres.translations(gaussians.means, torch.linspace(0.0, 1.0, INSTANTS))
    spheres.train()
    places = places[:, gaussians.opacities() >= SOLID]
    if places.shape[1] > POINTS:
        flat = places.permute(1, 0, 2).reshape(places.shape[1], -1).contiguous()
        places = places[:, farthest_points(flat, POINTS).to(places.device)]
    with one_piece():
        return tearing(places, BESIDE)


@torch.no_grad()
def shown_psnr(state: TrainState, data: Dataset) -> float:
    """Return the PSNR of at most ``VIEWS`` training views together, drawn with the present spheres."""
    scene, squares, count = state.scene(), 0.0, 0
    scene.motion.eval()
    for index in spread(len(data), VIEWS):
        frame = data[index]
        off = scene.render(frame.camera, frame.time).rgb.cpu().clamp(0.0, 1.0) - frame.image
        off = off if frame.mask is None else off[frame.mask]
        squares += float(off.double().square().sum())
        count += off.numel()
    scene.motion.train()
    return -10.0 * math.log10(max(squares / max(count, 1), 1e-12))
