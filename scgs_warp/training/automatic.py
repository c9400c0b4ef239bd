"""Settings with the value ``auto``, resolved by what the data holds."""

from __future__ import annotations

from dataclasses import replace

from ..config.presets import TrainConfig
from ..data.dataset import Dataset
from ..geometry.normalisation import FEWEST_POINTS
from .flow import follow_each_other
from .near_bound import network_scale
from .scene_distance import place
from .second_try_config import may_be_tried_again
from .silhouettes import is_in_parts, is_thin


def fewest_points(config: TrainConfig) -> int:
    """Return the smallest number of initial points that locates the scene and that control points can be sampled from.
    Fewer points are noise of a failed reconstruction."""
    return max(FEWEST_POINTS, config.motion.neighbors + 1)


def has_initial_points(data: Dataset, config: TrainConfig) -> bool:
    """Decide whether the data has at least :func:`fewest_points`."""
    return data.points is not None and len(data.points) >= fewest_points(config)


def resolve_auto(config: TrainConfig, data: Dataset) -> TrainConfig:
    """Replace ``auto`` values by those that suit the data. The gains below are for a hand over a shelf, 128 x 96
    pixels.

    Images without alpha show a full background. Its bare walls need large Gaussians (not pruning them gains 1.9 dB),
    and much of it is static beside moving surfaces (hyper-coordinates gain 0.55 dB; a motion mask gains 0.2 dB alone,
    and nothing in addition to them). If the data has points, control points start as a sample of them and Gaussians
    start at them (2 dB better than finding both with spheres).

    Where initial points are close to the cameras, the network learns more slowly.

    Thin subjects get the pooled residual. Where the subject is in separate parts and silhouettes lead spheres back to
    them, spheres may not fade. Subjects that are not thin may get a second try at stage 1.
    """
    filled = not data.with_alpha
    motion, growth = config.motion, config.densify
    if filled:
        hyper_dim = max(motion.hyper_dim, motion.hyper_dim_filled)
        config = replace(config, motion=replace(motion, hyper_dim=hyper_dim))
    if growth.prune_large == "auto":
        config = replace(config, densify=replace(growth, prune_large="never" if filled else "always"))
    if filled:  # Much of a photo is covered by Gaussians of which each contributes little.
        config = replace(config, densify=replace(config.densify, faint_share=0.0))
    else:  # Beside a cut-out subject every Gaussian is contradicted by the background of some view.
        config = replace(config, densify=replace(config.densify, least_views=1, clear_distance=0.0))
    thin = "auto" in (config.loss.pooled, config.pretrain.fade, config.pretrain.arap_by) and is_thin(data)
    if config.loss.pooled == "auto":
        config = replace(config, loss=replace(config.loss, pooled="always" if thin else "never"))
    if config.pretrain.fade == "auto":
        led = config.pretrain.silhouette > 0 and not thin and is_in_parts(data)
        config = replace(config, pretrain=replace(config.pretrain, fade="never" if led else "always"))
    if config.optim.network_scale == 0.0:
        seen = filled and has_initial_points(data, config)
        scale = network_scale(data, place(data).normalisation) if seen else 1.0
        config = replace(config, optim=replace(config.optim, network_scale=scale))
    if config.pretrain.arap_by == "auto" and not may_be_tried_again(config, data, thin):
        config = replace(config, pretrain=replace(config.pretrain, arap_by="track"))
    if config.loss.flow > 0.0 and not follow_each_other(data):
        config = replace(config, loss=replace(config.loss, flow=0.0))
    if has_initial_points(data, config) and not config.pretrain.with_points:
        config = replace(config, init_from="points", pretrain=replace(config.pretrain, steps=0))
    return config
