"""Stage 1: control points as spheres of equal size, each moved by the network evaluated at its own position."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ..config.presets import LossConfig, TrainConfig
from ..gaussians import GaussianParameters
from ..seeding import generator
from ..types import Gaussians
from .base import Motion, TrainingPose, network_rate
from .network import DeformationNetwork
from .rigidity import Graph, arap_times, build_graph, rigidity


class Spheres(Motion):
    """The network and the radius shared by all spheres; the spheres' centres are the means of the Gaussians."""

    name = "spheres"

    def __init__(self, network: DeformationNetwork, radius: float) -> None:
        super().__init__()
        self.network = network
        self.log_radius = nn.Parameter(torch.tensor([[radius]]).log())
        self.graph: Graph | None = None

    def translations(self, positions: Tensor, times: Tensor) -> Tensor:
        """Return displacements [T, n, 3] of ``positions`` [n, 3]. The positions are detached, because gradients through
        the encoding's high octaves would make the spheres oscillate."""
        return self.network(positions.detach(), times.to(positions.device))["translations"]

    def _spheres_at(self, gaussians: GaussianParameters, means: Tensor) -> Gaussians:
        # The adjoint of a product with ones sums in a fixed order; that of expand does not.
        ones = torch.ones(len(gaussians), 1, device=means.device)
        scales = (ones @ self.log_radius.exp()).expand(-1, 3)
        quats, colors = gaussians.quats.detach(), (gaussians.sh_dc, gaussians.sh_rest)
        return Gaussians(means, quats, scales, gaussians.opacities(), *colors, gaussians.sharpness)

    def gaussians_at(self, gaussians: GaussianParameters, time: float) -> Gaussians:
        moved = gaussians.means + self.translations(gaussians.means, torch.tensor([time]))[0]
        return self._spheres_at(gaussians, moved)

    def train_at(
        self, gaussians: GaussianParameters, time: float, step: int, config: TrainConfig, seed: int, view: int = 0
    ) -> TrainingPose:
        if step < config.pretrain.warm_up:
            return TrainingPose(self._spheres_at(gaussians, gaussians.means), None)
        rigid = config.pretrain.arap_weight > 0 and step % config.loss.arap_every == 0
        times = [time]
        if rigid:
            self.refresh_graph(gaussians, step, config.loss)
            times += arap_times(config.loss, generator(seed, 22, step * config.batch + view))
        moves = self.translations(gaussians.means, torch.tensor(times))
        posed = self._spheres_at(gaussians, gaussians.means + moves[0])
        if not rigid or self.graph is None:
            return TrainingPose(posed, None)
        weight = config.pretrain.arap_weight * config.loss.arap_every
        return TrainingPose(posed, weight * rigidity([gaussians.means.detach() + move for move in moves], self.graph))

    def refresh_graph(self, gaussians: GaussianParameters, step: int, loss: LossConfig) -> None:
        if self.graph is None or step % loss.arap_refresh < loss.arap_every:
            self.graph = build_graph(lambda times: gaussians.means + self.translations(gaussians.means, times), loss)

    def rates(self, step: int, config: TrainConfig) -> dict[str, float]:
        rate = network_rate(step, config.pretrain.warm_up, config.optim)
        rates = {name: rate for name, _ in self.named_parameters() if name.startswith("network.")}
        return {**rates, "log_radius": config.optim.scales}

    def extra_state(self) -> dict[str, Tensor]:
        return (
            {} if self.graph is None else {"graph.neighbors": self.graph.neighbors, "graph.weights": self.graph.weights}
        )

    def load_extra_state(self, tensors: dict[str, Tensor]) -> None:
        if "graph.neighbors" in tensors:
            self.graph = Graph.of(tensors["graph.neighbors"], tensors["graph.weights"])
