"""Stage 1: control points as spheres of equal size, each moved by the network evaluated at its own position."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from ..config.presets import TrainConfig
from ..gaussians import GaussianParameters
from ..runtime.device_copies import sent
from ..runtime.environment import one_piece
from ..seeding import Purpose, generator
from ..types import Gaussians
from .base import Motion, MotionStep, TrainingPose, network_rate
from .chunks import ChunkedNetwork
from .network import DeformationNetwork
from .rigidity import (
    Graph,
    arap_times,
    build_graph,
    graph_is_old,
    graph_of_state,
    graph_state,
    momentary_graph,
    rigidity,
)


class _Scales(torch.autograd.Function):
    """Scales [n, 3] of n spheres from the logarithm of their radius [1, 1]. The gradient is one sum in one thread,
    because the adjoint of torch's expand sums in an order that depends on the number of threads."""

    @staticmethod
    def forward(ctx: Any, log_radius: Tensor, count: int) -> Tensor:
        scales = log_radius.exp().expand(count, 3).contiguous()
        ctx.save_for_backward(scales)
        return scales

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_scales: Tensor):  # type: ignore[override]
        (scales,) = ctx.saved_tensors
        with one_piece():
            return (v_scales * scales).sum(dtype=torch.float64).float().view(1, 1), None


class Spheres(Motion):
    """The network and the radius shared by all spheres; the spheres' centres are the means of the Gaussians."""

    name = "spheres"

    def __init__(self, network: DeformationNetwork | ChunkedNetwork, radius: float) -> None:
        super().__init__()
        self.network = network
        self.takes_time_tensor = isinstance(network, DeformationNetwork)
        self.log_radius = nn.Parameter(torch.tensor([[radius]]).log())
        self.graph: Graph | None = None
        self.held = 0
        """Number of first steps in which a network that begins with a motion stays as it is, while the spheres take
        their places and colours."""

    def translations(self, positions: Tensor, times: Tensor) -> Tensor:
        """Return displacements [T, n, 3] of ``positions`` [n, 3]. The positions are detached, because gradients through
        the encoding's high octaves would make the spheres oscillate."""
        return self.network(positions.detach(), sent(times, positions.device))["translations"]

    def _spheres_at(self, gaussians: GaussianParameters, means: Tensor) -> Gaussians:
        scales: Tensor = _Scales.apply(self.log_radius, len(gaussians))  # type: ignore[assignment]
        quats, colors = gaussians.quats.detach(), (gaussians.sh_dc, gaussians.sh_rest)
        return Gaussians(means, quats, scales, gaussians.opacities(), *colors, gaussians.sharpness)

    def gaussians_at(self, gaussians: GaussianParameters, time: float | Tensor) -> Gaussians:
        times = time if isinstance(time, Tensor) else torch.tensor([time])
        return self._spheres_at(gaussians, gaussians.means + self.translations(gaussians.means, times)[0])

    def plan(
        self, gaussians: GaussianParameters, time: float, step: int, config: TrainConfig, view: int = 0
    ) -> MotionStep:
        if step < config.pretrain.warm_up:
            return MotionStep((time,), phase="rest")
        if not self._compares(step, config):
            return MotionStep((time,))
        others = arap_times(
            config.loss, generator(config.seed, Purpose.ARAP_TIMES_OF_SPHERES, step * config.batch + view)
        )

        def positions_at(times: Tensor) -> Tensor:
            return gaussians.means + self.translations(gaussians.means, times)

        if config.pretrain.arap_by == "moment":
            with torch.no_grad():
                instants = positions_at(torch.tensor((time, *others)[-2:]))
            self.graph = momentary_graph(instants, config.loss, self.graph)
        elif graph_is_old(self.graph, step, config.loss):
            self.graph = build_graph(positions_at, config.loss, self.graph)
        weight = config.pretrain.arap_weight * config.loss.arap_every
        return MotionStep((time, *others), 0.0 if self.graph is None else weight)

    def refresh_due(self, step: int, config: TrainConfig) -> bool:
        moving = step >= config.pretrain.warm_up
        old = config.pretrain.arap_by == "moment" or graph_is_old(self.graph, step, config.loss)
        return moving and self._compares(step, config) and old

    def train_at(
        self,
        gaussians: GaussianParameters,
        plan: MotionStep,
        times: Tensor,
        weight: float | Tensor,
        config: TrainConfig,
    ) -> TrainingPose:
        if plan.phase == "rest":
            return TrainingPose(self._spheres_at(gaussians, gaussians.means), None)
        moves = self.translations(gaussians.means, times)
        posed = self._spheres_at(gaussians, gaussians.means + moves[0])
        if plan.weight == 0.0 or self.graph is None:
            return TrainingPose(posed, None)
        return TrainingPose(posed, weight * rigidity([gaussians.means.detach() + move for move in moves], self.graph))

    def _compares(self, step: int, config: TrainConfig) -> bool:
        """Return True if the step has the regulariser."""
        return config.pretrain.arap_weight > 0 and step % config.loss.arap_every == 0

    def rates(self, step: int, config: TrainConfig) -> dict[str, float]:
        rate = 0.0 if step < self.held else network_rate(step, config.pretrain.warm_up, config.optim)
        rates = {name: rate for name, _ in self.named_parameters() if name.startswith("network.")}
        return {**rates, "log_radius": config.optim.scales}

    def extra_state(self) -> dict[str, Tensor]:
        return graph_state(self.graph)

    def load_extra_state(self, tensors: dict[str, Tensor]) -> None:
        self.graph = graph_of_state(tensors, self.graph)
