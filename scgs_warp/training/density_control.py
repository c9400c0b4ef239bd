"""Between two steps: what the schedule wants of the numbers of Gaussians and control points."""

from __future__ import annotations

import dataclasses

from torch import Tensor

from ..motion.control_points import ControlPoints
from ..motion.node_density import adapt_control_points
from ..motion.spheres import Spheres
from ..seeding import generator
from .densify import densify, mean_gradient, most_that_fit, prune, reset_opacities, resets, threshold
from .pretrain import densify_spheres, thin_spheres
from .state import TrainState


def adapt(state: TrainState, size: tuple[int, int], kept: Tensor | None = None) -> str | None:
    """After the step: what the schedule wants of numbers of Gaussians and control points. ``stage_step`` is the step
    just done.

    Args:
        size: width and height of the step's image.
        kept: [N] bool, the Gaussians that are ``seen``; the others are pruned. None: that is not due.

    Returns:
        what the user should know of it, if anything.
    """
    if state.stage == "pretrain":
        _adapt_spheres(state)
        return None
    return _adapt_gaussians(state, size, kept)


def _adapt_spheres(state: TrainState) -> None:
    assert isinstance(state.motion, Spheres)
    config, done = state.config, state.stage_step + 1
    if done == config.pretrain.densify_until:
        thin_spheres(state.gaussians, state.gaussian_optimizer, state.motion, config.motion.nodes)
        state.reset_stats()
    elif done < config.pretrain.densify_until and (
        done % config.pretrain.densify_every == 0 or done == config.pretrain.warm_up
    ):
        densify_spheres(state.gaussians, state.gaussian_optimizer, state.motion, state.stats, config, state.step)
        state.reset_stats()


def _adapt_gaussians(state: TrainState, size: tuple[int, int], kept: Tensor | None) -> str | None:
    config, done, note = state.config.densify, state.stage_step + 1, None
    if done > config.until:
        return None
    if kept is not None:  # before there are newborn ones: a clone is hidden behind its parent
        state.stats = state.stats.rows(prune(state.gaussians, state.gaussian_optimizer, kept))
    if done >= config.start and done % config.interval == 0:
        limit = threshold(config, *size)
        if _nodes_due(state, done):
            assert isinstance(state.motion, ControlPoints) and state.motion_optimizer is not None
            node_limit = limit * config.node_grad_threshold / config.grad_threshold
            gradient = mean_gradient(state.stats)
            adapt_control_points(
                state.motion, state.motion_optimizer, state.gaussians, gradient, grad_threshold=node_limit
            )
        most = most_that_fit(state.gaussians, config.max_gaussians)
        most = most if state.team is None else state.team.least(most)
        if most < config.max_gaussians:
            note = f"memory has room for {most:,} Gaussians, not for {config.max_gaussians:,}; they grow no further"
            config = dataclasses.replace(config, max_gaussians=most)
        densify(
            state.gaussians,
            state.gaussian_optimizer,
            state.stats,
            config,
            grad_threshold=limit,
            extent=state.extent,
            prune_large=done > config.opacity_reset_every and config.prune_large != "never",
            random=generator(state.config.seed, 51, state.step),
        )
        state.reset_stats()
    if resets(config, done):
        reset_opacities(state.gaussians, state.gaussian_optimizer)
    return note


def _nodes_due(state: TrainState, done: int) -> bool:
    """Control points change at the first densification after each of their own milestones, up to ``nodes_until``."""
    config = state.config.densify
    if not isinstance(state.motion, ControlPoints) or done <= state.config.freeze:
        return False
    number, late = divmod(done, config.nodes_every)
    return number > 0 and late < config.interval and done - late <= config.nodes_until
