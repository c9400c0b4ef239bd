"""The paper's baseline: the network of SC-GS, evaluated at every Gaussian instead of at control points."""

from __future__ import annotations

import torch
from torch import Tensor

from ..config.presets import TrainConfig
from ..gaussians import GaussianParameters
from ..runtime.device_copies import sent
from ..types import Gaussians
from .base import Motion, MotionStep, TrainingPose, moved_by, network_rate
from .chunks import ChunkedNetwork
from .network import DeformationNetwork


class PerGaussian(Motion):
    """Motion model that predicts residuals of position, rotation and scale for each Gaussian, from its rest position
    and the time."""

    name = "per-gaussian"

    def __init__(self, network: DeformationNetwork | ChunkedNetwork) -> None:
        super().__init__()
        self.network = network
        self.takes_time_tensor = isinstance(network, DeformationNetwork)

    def gaussians_at(self, gaussians: GaussianParameters, time: float | Tensor) -> Gaussians:
        times = time if isinstance(time, Tensor) else torch.tensor([time])
        out = self.network(gaussians.means.detach(), sent(times, gaussians.means.device))
        return moved_by(gaussians, out["translations"][0], out["rotations"][0], out["log_scales"][0])

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
        if plan.phase == "rest":
            return TrainingPose(gaussians.activate(), None)
        return TrainingPose(self.gaussians_at(gaussians, times[:1]), None)

    def rates(self, step: int, config: TrainConfig) -> dict[str, float]:
        rate = network_rate(step, config.coarse, config.optim)
        return {name: rate for name, _ in self.named_parameters()}


PER_GAUSSIAN_HEADS = {"rotations": 4, "translations": 3, "log_scales": 3}
