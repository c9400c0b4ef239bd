"""Motion models, one class each, behind the protocol of ``base.Motion``."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ..config.presets import TrainConfig
from .base import Motion
from .control_points import ControlPoints, heads_of, make_network
from .hexplane import TEMPORAL, HexPlane
from .per_gaussian import PER_GAUSSIAN_HEADS, PerGaussian
from .spheres import Spheres
from .static import Static

__all__ = ["ControlPoints", "HexPlane", "Motion", "PerGaussian", "Spheres", "Static", "build_motion"]


def build_motion(name: str, config: TrainConfig, state: Mapping[str, Tensor] | None = None) -> Motion:
    """Make a motion model by name; ``state``, a checkpoint's tensors, gives the sizes of control points and planes.

    Raises:
        ValueError: the name is unknown.
    """
    if name == "static":
        return Static()
    if name == "hexplane":
        times = config.motion.plane_times if state is None else state["planes.3"].shape[0]
        return HexPlane(config.seed, times or TEMPORAL)
    if name == "per-gaussian":
        return PerGaussian(make_network(config.motion, PER_GAUSSIAN_HEADS, config.seed))
    if name == "spheres":
        return Spheres(make_network(config.motion, heads_of(config.motion), config.seed), 1.0)
    if name == "control-points":
        count = config.motion.nodes if state is None else state["positions"].shape[0]
        network = make_network(config.motion, heads_of(config.motion), config.seed)
        return ControlPoints(torch.zeros(count, 3), torch.ones(count), network, config.motion)
    raise ValueError(f"no motion model is called {name!r}")
