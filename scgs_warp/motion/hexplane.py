"""4D-GS: features from multi-resolution planes over (x, y, z, t), decoded per Gaussian (seed Table S2's rival)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..config import TrainConfig
from ..gaussians import GaussianParameters
from ..optim import generator, log_linear
from ..types import Gaussians
from .base import Motion, TrainingPose

PAIRS = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))
"""Axes of the six planes; 3 is time."""
CHANNELS = 32
SPATIAL = 64
TEMPORAL = 25
MULTIPLES = (1, 2)
"""Spatial resolutions: 64 and 128; time keeps 25 in both, as in the 4D-GS configuration for D-NeRF."""
WIDTH = 64
BOUND = 1.6
"""Half size of the planes' cube, normalised units."""


class HexPlane(Motion):
    """Six feature planes at two resolutions, multiplied over the planes, concatenated over resolutions, and three small
    heads for position, rotation and log scale."""

    name = "hexplane"

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        random = generator(seed, 12)
        self.planes = nn.ParameterList()
        for multiple in MULTIPLES:
            for _, second in PAIRS:
                rows = TEMPORAL if second == 3 else SPATIAL * multiple
                shape = (1, CHANNELS, rows, SPATIAL * multiple)
                # Space planes vary at first, time planes are 1: the scene starts at rest.
                plane = torch.ones(shape) if second == 3 else 0.1 + 0.4 * torch.rand(shape, generator=random)
                self.planes.append(nn.Parameter(plane))
        self.trunk = nn.Linear(CHANNELS * len(MULTIPLES), WIDTH)
        widths = {"means": 3, "quats": 4, "log_scales": 3}
        self.heads = nn.ModuleDict(
            {
                name: nn.Sequential(nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, width))
                for name, width in widths.items()
            }
        )
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.xavier_uniform_(layer.weight, generator=random)
                nn.init.zeros_(layer.bias)
        for head in self.heads.values():
            last = head[-1]  # type: ignore[index]
            nn.init.normal_(last.weight, std=1e-4, generator=random)

    def features(self, positions: Tensor, time: float) -> Tensor:
        """[N, 64] bilinear samples; positions outside the cube take the border's value."""
        when = positions.new_full((positions.shape[0], 1), 2.0 * time - 1.0)
        where = torch.cat([positions / BOUND, when], dim=1)
        found = []
        for level in range(len(MULTIPLES)):
            product = None
            for place, pair in enumerate(PAIRS):
                grid = where[:, pair].view(1, 1, -1, 2)
                plane = self.planes[level * len(PAIRS) + place]
                sample = F.grid_sample(plane, grid, align_corners=True, padding_mode="border")[0, :, 0]
                product = sample if product is None else product * sample
            found.append(product)
        return torch.cat(found).T

    def gaussians_at(self, gaussians: GaussianParameters, time: float) -> Gaussians:
        hidden = self.trunk(self.features(gaussians.means, time))
        change = {name: head(hidden) for name, head in self.heads.items()}
        return Gaussians(
            gaussians.means + change["means"],
            gaussians.quats + change["quats"],
            (gaussians.log_scales + change["log_scales"]).exp(),
            gaussians.opacities(),
            gaussians.sh_dc,
            gaussians.sh_rest,
        )

    def smoothness(self) -> Tensor:
        """Total variation of all planes: squared first differences in space, squared second differences in time."""
        terms = []
        for place, plane in enumerate(self.planes):
            across = plane[..., 1:] - plane[..., :-1]
            down = plane[..., 1:, :] - plane[..., :-1, :]
            if PAIRS[place % len(PAIRS)][1] == 3:
                down = down[..., 1:, :] - down[..., :-1, :]
            # Per-row sums first: their order does not depend on the number of threads.
            terms += [across.square().mean(-1).mean(-1).mean(), down.square().mean(-1).mean(-1).mean()]
        return torch.stack(terms).sum()

    def train_at(
        self, gaussians: GaussianParameters, time: float, step: int, config: TrainConfig, seed: int
    ) -> TrainingPose:
        if step < config.freeze:  # coarse: a static scene first (4D-GS)
            return TrainingPose(gaussians.activate(), None)
        weight = config.loss.hexplane_tv
        return TrainingPose(self.gaussians_at(gaussians, time), weight * self.smoothness() if weight > 0 else None)

    def rates(self, step: int, config: TrainConfig) -> dict[str, float]:
        joint = max(0, step - config.freeze)
        optim = config.optim
        decay = log_linear(1.0, 0.01, joint, optim.network_until)
        return {
            name: (optim.planes if name.startswith("planes.") else optim.network) * decay
            for name, _ in self.named_parameters()
        }
