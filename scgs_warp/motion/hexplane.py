"""4D-GS: features from multi-resolution planes over (x, y, z, t), decoded per Gaussian (compared in the paper's Table
S2)."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from ..config.presets import TrainConfig
from ..gaussians import GaussianParameters
from ..ops.network import Layers, evaluate, network
from ..ops.network_cache import NetworkCache
from ..ops.planes import CHANNELS, PAIRS, Smoothness, plane_features, plane_variation
from ..optim import log_linear
from ..seeding import Purpose, generator
from ..types import Gaussians
from .base import Motion, MotionStep, TrainingPose, decay_steps, moved_by

SPATIAL = 64
TEMPORAL = 25
"""Default number of texels along t."""
MULTIPLES = (1, 2)
"""Spatial resolutions: 64 and 128 texels. Time has its own resolution, the same for both, as in the 4D-GS
configurations for D-NeRF."""
WIDTH = 64
HEADS = {"means": 3, "quats": 4, "log_scales": 3}
"""Names of the heads and the widths of their outputs."""
BOUND = 1.6
"""Half the edge of the planes' cube, normalised units."""


class HexPlane(Motion):
    """Six feature planes at each of two resolutions, and three small heads for position, rotation and log scale.
    Features are multiplied over the planes and concatenated over the resolutions."""

    name = "hexplane"
    takes_time_tensor = True

    def __init__(self, seed: int = 0, times: int = TEMPORAL) -> None:
        super().__init__()
        random = generator(seed, Purpose.PLANES)
        self.planes = nn.ParameterList()
        for multiple in MULTIPLES:
            for _, second in PAIRS:
                rows = times if second == 3 else SPATIAL * multiple
                shape = (CHANNELS, rows, SPATIAL * multiple)
                # Space planes vary at first, time planes are 1: the scene starts at rest.
                plane = torch.ones(shape) if second == 3 else 0.1 + 0.4 * torch.rand(shape, generator=random)
                # Channels last: the samples of a texel lie side by side.
                self.planes.append(nn.Parameter(plane.permute(1, 2, 0).contiguous()))
        self.trunk = nn.Linear(CHANNELS * len(MULTIPLES), WIDTH)
        self.heads = nn.ModuleDict(
            {
                name: nn.Sequential(nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, width))
                for name, width in HEADS.items()
            }
        )
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.xavier_uniform_(layer.weight, generator=random)
                nn.init.zeros_(layer.bias)
        for head in self.heads.values():
            last = head[-1]  # type: ignore[index]
            nn.init.normal_(last.weight, std=1e-4, generator=random)
        self._cache = NetworkCache()

    def features(self, positions: Tensor, time: float | Tensor) -> Tensor:
        """Return features [N, 64], products of bilinear samples. Positions outside the cube take the value at its
        border."""
        return plane_features(positions / BOUND, time, list(self.planes))

    def gaussians_at(self, gaussians: GaussianParameters, time: float | Tensor) -> Gaussians:
        return self._moved(gaussians, self.features(gaussians.means, time))

    def plan(
        self, gaussians: GaussianParameters, time: float, step: int, config: TrainConfig, view: int = 0
    ) -> MotionStep:
        return MotionStep((time,), phase="rest" if step < config.coarse else "moving")

    def train_at(
        self,
        gaussians: GaussianParameters,
        plan: MotionStep,
        times: Tensor,
        weight: float | Tensor,
        config: TrainConfig,
    ) -> TrainingPose:
        if plan.phase == "rest":  # learn a static scene first (4D-GS)
            return TrainingPose(gaussians.activate(), None)
        weights = Smoothness(config.loss.hexplane_tv, config.loss.hexplane_smooth, config.loss.hexplane_rest)
        variation = plane_variation(list(self.planes), weights) if any(weights) else None
        return TrainingPose(self.gaussians_at(gaussians, times[:1]), variation)

    def train(self, mode: bool = True) -> HexPlane:
        self._cache.forget()  # the optimiser writes without raising torch's version counters
        return super().train(mode)

    def _moved(self, gaussians: GaussianParameters, features: Tensor) -> Gaussians:
        return moved_by(gaussians, *self._decode(features).split(list(HEADS.values()), dim=1))

    def _decode(self, features: Tensor) -> Tensor:
        """Evaluate trunk and heads as one network of three layers, returning [N, 10]: the trunk, the heads' first
        layers side by side, and their last layers in a block-diagonal matrix."""
        if features.device.type != "cpu":
            hidden = self.trunk(features)
            return torch.cat([head(hidden) for head in self.heads.values()], dim=1)
        when = features.new_empty(1, 0)
        if self.training or torch.is_grad_enabled():
            return network(features, when, *self._layers())
        parameters = (p for module in (self.trunk, self.heads) for p in module.parameters())
        packed = self._cache.layers(parameters, lambda: Layers(*self._layers(), features.shape[1]))
        return evaluate(packed, features, when)

    def _layers(self) -> tuple[list[Tensor], list[Tensor]]:
        first, last = ([cast(nn.Linear, head[index]) for head in self.heads.values()] for index in (1, 3))  # type: ignore[index]
        weights = [
            self.trunk.weight,
            torch.cat([layer.weight for layer in first]),
            torch.block_diag(*(layer.weight for layer in last)),
        ]
        biases = [self.trunk.bias, *(torch.cat([layer.bias for layer in heads]) for heads in (first, last))]
        return weights, biases

    def rates(self, step: int, config: TrainConfig) -> dict[str, float]:
        optim = config.optim
        decay = log_linear(1.0, 0.01, decay_steps(step, config.coarse, optim), optim.network_until)
        network = optim.network * (optim.network_scale or 1.0)
        return {
            name: (optim.planes if name.startswith("planes.") else network) * decay
            for name, _ in self.named_parameters()
        }
