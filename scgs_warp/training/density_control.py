"""Adaptive density control: the schedule by which Gaussians, spheres and control points are added, removed and reset.

``done`` is the number of completed steps of the present stage. After a main step, in this order:

1. visibility pruning: Gaussians that contribute to no sampled view are removed;
2. a densification round: control points are cloned and pruned where due; Gaussians with large gradients are cloned or
   split; transparent, oversized and non-finite ones are removed;
3. an opacity reset.

After a step of stage 1, spheres are cloned or split and pruned, and finally thinned to the number of control points.

The operations on rows are in ``gaussian_density.py``, ``sphere_density.py`` and ``motion/node_density.py`` (control
points); ``visibility.py`` measures contributions.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from ..config.presets import DensifyConfig, PretrainConfig, TrainConfig
from ..gaussians import GaussianParameters
from ..motion.control_points import ControlPoints
from ..motion.node_density import adapt_control_points
from ..motion.spheres import Spheres
from ..runtime import memory
from ..seeding import Purpose, generator
from ..types import plain_scale
from .frames import Frames
from .gaussian_density import grow_and_prune, mean_gradient, prune, reset_opacities
from .near_bound import nearest_content
from .sphere_density import densify_spheres, densify_spheres_by_gradient, thin_spheres
from .state import TrainState
from .visibility import faintest, seen_by

STEPS_PER_VIEW = 20
"""Visibility pruning renders at most one view per this many steps since the last pruning. A view takes about half as
long as a step, so the share of the time is a few percent."""
MOST_VIEWS, FEWEST_VIEWS = 300, 50
"""Limits for the number of rendered views: ``MOST_VIEWS`` are enough to see every side. With fewer than
``FEWEST_VIEWS`` (or than all views of smaller data) nothing is pruned."""
NUMBERS_PER_PARAMETER = 6
"""Number of float32 values in memory per parameter: value, gradient, two moments, posed value and its gradient."""
NUMBERS_PER_GAUSSIAN = 220
"""Number of float32 values in memory per Gaussian during a step: its splat, its gradients, four pairs of splat and
tile."""


# Schedule


def round_due(config: DensifyConfig, done: int) -> bool:
    """Decide whether Gaussians are densified after ``done`` main steps."""
    return config.start <= done <= config.until and done % config.interval == 0


def opacity_reset_due(config: DensifyConfig, done: int) -> bool:
    """Decide whether opacities are reset after ``done`` main steps. The last reset is at least half an interval before
    the end of densification, so that opacities can recover."""
    every = config.opacity_reset_every
    return done % every == 0 and done + every // 2 <= config.until


def visibility_pruning_due(config: DensifyConfig, done: int) -> bool:
    """Decide whether visibility pruning is due after ``done`` main steps: before each opacity reset and at the end of
    densification. After a reset it would come too late: all surfaces are transparent then, so hidden Gaussians
    contribute and learn colours."""
    return config.min_contribution > 0.0 and (done == config.until or opacity_reset_due(config, done))


def control_points_due(config: TrainConfig, done: int) -> bool:
    """Decide whether the round after ``done`` main steps also changes control points: the first round after each
    multiple of ``nodes_every``, up to ``nodes_until``."""
    if done <= config.freeze:
        return False
    number, late = divmod(done, config.densify.nodes_every)
    return number > 0 and late < config.densify.interval and done - late <= config.densify.nodes_until


def spheres_due(config: PretrainConfig, done: int) -> bool:
    """Decide whether spheres are densified after ``done`` steps of stage 1."""
    return done < config.densify_until and (done % config.densify_every == 0 or done == config.warm_up)


def sphere_reset_due(config: TrainConfig, done: int) -> bool:
    """Decide whether the spheres' opacities are reset after ``done`` steps of stage 1: at the interval of the main
    stage, if spheres are densified by gradient."""
    pretrain, every = config.pretrain, config.densify.opacity_reset_every
    return pretrain.densify_by == "gradient" and done < pretrain.densify_until and done % every == 0


# Thresholds and limits


def gradient_threshold(config: DensifyConfig, width: int, height: int, sharpness: float = 0.0) -> float:
    """Return the gradient threshold for this image size, normalised device coordinates. It grows with the sharpness:
    sharper splats are narrower, so the gradients of their means are larger, and a constant threshold would make more
    Gaussians."""
    return _scaled(config.grad_threshold, config, width, height, sharpness)


def _scaled(threshold: float, config: DensifyConfig, width: int, height: int, sharpness: float) -> float:
    return threshold * (800.0 / math.sqrt(width * height)) ** config.resolution_exponent / plain_scale(sharpness)


def affordable_count(gaussians: GaussianParameters, wanted: int) -> int:
    """Return the number of Gaussians that fit in memory, at most ``wanted``. Counts parameters, gradients, Adam's
    moments and the intermediate values of a step."""
    count = len(gaussians)
    numbers = sum(parameter.numel() for parameter in gaussians.parameters()) / max(count, 1)
    each = round(4 * (NUMBERS_PER_PARAMETER * numbers + NUMBERS_PER_GAUSSIAN))
    device = gaussians.means.device
    if memory.fits(each * max(min(wanted, 2 * count) - count, 0), device):  # a round at most doubles them
        return wanted
    return min(wanted, count + memory.room(device) // each)


def density_due(state: TrainState) -> bool:
    """Decide whether anything is added, removed or reset after the present step."""
    config, done = state.config, state.stage_step + 1
    if state.stage == "pretrain":
        thinned = done == config.pretrain.densify_until
        return thinned or spheres_due(config.pretrain, done) or sphere_reset_due(config, done)
    if done > config.densify.until:
        return False
    growth = config.densify
    return round_due(growth, done) or opacity_reset_due(growth, done) or visibility_pruning_due(growth, done)


# Before a step


def visible_gaussians(state: TrainState, frames: Frames) -> Tensor | None:
    """Find the Gaussians that visibility pruning keeps.

    These contribute at least ``densify.min_contribution`` pixels to one of the sampled views (to
    ``densify.least_views`` of them if all views are sampled), and no sampled view sees them closer than
    ``densify.clear_distance``. The faintest are left out as well (``densify.faint_share``, ``densify.faint_at``). The
    views are drawn at random, different ones each time.

    Returns:
        [N] bool, the rows to keep after the present step; None if visibility pruning is not due, or if the run is too
        short to render enough views.
    """
    config = state.config.densify
    done = state.stage_step + 1
    if state.stage == "pretrain" or not visibility_pruning_due(config, done):
        return None
    steps = config.until if done == config.until else config.opacity_reset_every
    count = min(len(frames), MOST_VIEWS, steps // STEPS_PER_VIEW)
    if count < min(len(frames), FEWEST_VIEWS):
        return None
    order = torch.randperm(len(frames), generator=generator(state.config.seed, Purpose.VISIBILITY_VIEWS, state.step))
    seen = seen_by(state, frames, order[:count].tolist(), config.min_contribution)
    keep = seen.most >= config.min_contribution
    if config.least_views > 1 and count == len(frames) >= config.least_views:
        keep &= (seen.views >= config.least_views) | seen.most.isinf()
    if config.clear_distance > 0.0:
        keep &= seen.nearest >= config.clear_distance * nearest_content(frames.data, state.normalisation)
    if done == config.until or config.faint_at == "resets":
        keep &= ~faintest(seen.most, config.faint_share)
    return keep


# After a step


def control_density(state: TrainState, size: tuple[int, int], visible: Tensor | None = None) -> str | None:
    """Add, remove and reset what the schedule requires after the present step. ``state.step`` does not count this step
    yet.

    Args:
        size: width and height of the step's image in pixels.
        visible: [N] bool from :func:`visible_gaussians`; rows that are False are pruned. None: visibility pruning is
            not due.

    Returns:
        A note for the user if memory limits the growth, else None.
    """
    if state.stage == "pretrain":
        _control_spheres(state)
        return None
    if state.stage_step + 1 > state.config.densify.until:
        return None
    return _control_gaussians(state, size, visible)


def _control_spheres(state: TrainState) -> None:
    assert isinstance(state.motion, Spheres)
    config, done = state.config, state.stage_step + 1
    spheres = (state.gaussians, state.gaussian_optimizer, state.motion)
    if done == config.pretrain.densify_until:
        thin_spheres(*spheres, config.motion.nodes, config.pretrain.solid_opacity)
        state.reset_stats()
    elif spheres_due(config.pretrain, done):
        if config.pretrain.densify_by == "gradient":
            densify_spheres_by_gradient(*spheres, state.stats, config, state.extent, state.step)
        else:
            densify_spheres(*spheres, state.stats, config, state.step)
        state.reset_stats()
    if sphere_reset_due(config, done):
        reset_opacities(state.gaussians, state.gaussian_optimizer)


def _control_gaussians(state: TrainState, size: tuple[int, int], visible: Tensor | None) -> str | None:
    config, done, note = state.config.densify, state.stage_step + 1, None

    # 1. Visibility pruning comes before growth, because a new clone is hidden behind its parent.
    if visible is not None:
        state.stats = state.stats.rows(prune(state.gaussians, state.gaussian_optimizer, visible))

    # 2. Densification round.
    if round_due(config, done):
        threshold = gradient_threshold(config, *size, state.gaussians.sharpness)
        if isinstance(state.motion, ControlPoints) and control_points_due(state.config, done):
            assert state.motion_optimizer is not None
            adapt_control_points(
                state.motion,
                state.motion_optimizer,
                state.gaussians,
                mean_gradient(state.stats),
                grad_threshold=_scaled(config.node_grad_threshold, config, *size, state.gaussians.sharpness),
                least_impact=config.node_impact,
                growth=config.node_growth,
            )
        most = affordable_count(state.gaussians, config.max_gaussians)
        most = most if state.group is None else state.group.minimum(most)
        if most < config.max_gaussians:
            note = f"memory has room for {most:,} Gaussians, not for {config.max_gaussians:,}; they grow no further"
            config = replace(config, max_gaussians=most)
        grow_and_prune(
            state.gaussians,
            state.gaussian_optimizer,
            state.stats,
            config,
            grad_threshold=threshold,
            extent=state.extent,
            prune_large=done > config.opacity_reset_every and config.prune_large != "never",
            random=generator(state.config.seed, Purpose.SPLIT_GAUSSIANS, state.step),
        )
        state.reset_stats()

    # 3. Opacity reset.
    if opacity_reset_due(config, done):
        reset_opacities(state.gaussians, state.gaussian_optimizer)
    return note
