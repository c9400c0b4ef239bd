"""Control points of a static scene, sampled for editing."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ..gaussians import GaussianParameters
from ..ops.neighbors import nearest, rbf_weights
from ..ops.sampling import farthest_points
from ..ops.skinning import skin
from ..types import Gaussians, Pose
from .base import Motion

COUNT = 512
"""Default number of control points."""
NEIGHBORS = 4
OPAQUE = 0.1
"""Opacity above which a Gaussian is a candidate for control points; farthest-point sampling would favour floaters,
which are more transparent."""
CORE = 0.98
"""Share of the opaque Gaussians, those nearest to their median, from which control points are sampled."""
SPACINGS = 0.75
"""Ratio of a control point's radius to the mean distance to its three nearest neighbours."""


class StaticNodes(Motion):
    """Control points [M, 3] at rest. They are buffers rather than parameters, because nothing is trained."""

    name = "static"
    moves = False
    takes_time_tensor = True

    def __init__(self, positions: Tensor, radii: Tensor) -> None:
        super().__init__()
        self.positions: Tensor
        self.radii: Tensor
        self.register_buffer("positions", positions.detach().clone())
        self.register_buffer("radii", radii.detach().clone())

    @staticmethod
    @torch.no_grad()
    def sample(gaussians: GaussianParameters, count: int = COUNT) -> StaticNodes:
        """Sample control points evenly over the opaque Gaussians, by farthest-point sampling.

        Args:
            count: number of control points; at most the number of Gaussians.
        """
        means, opacities = gaussians.means.detach(), gaussians.opacities().detach()
        finite = means.isfinite().all(dim=1)
        opaque = finite & (opacities > OPAQUE)
        points = means[opaque if bool(opaque.any()) else finite].contiguous()
        if len(points) > 16:
            # torch's median along a dimension warns on CUDA that its indices are not deterministic.
            median = points.sort(dim=0).values[(len(points) - 1) // 2]
            away = (points - median).norm(dim=1)
            points = points[away <= away.quantile(CORE) if len(away) < 10_000_000 else away > -1].contiguous()
        middle = (points - points.mean(dim=0)).norm(dim=1) if len(points) else torch.zeros(0)
        start = int(middle.argmin()) if len(points) else 0
        nodes = points[farthest_points(points, min(count, len(points)), start)]
        return StaticNodes(nodes, spacing(nodes) * SPACINGS)

    def __len__(self) -> int:
        return self.positions.shape[0]

    def poses(self, times: Tensor) -> list[Pose]:
        """Return one :class:`Pose` per time, all at rest."""
        zeros = torch.zeros_like(self.positions)
        still = torch.zeros(len(self), 4, device=zeros.device)
        still[:, 0] = 1.0
        return [Pose(zeros, still) for _ in range(times.shape[0])]

    def trajectories(self, times: Tensor) -> Tensor:
        """Return the control points [T, M, 3], the same at all times."""
        return self.positions.expand(times.shape[0], -1, -1)

    def control_points_at(self, time: float) -> Tensor:
        return self.positions

    def neighbors(self, gaussians: GaussianParameters) -> Tensor:
        """Find the nearest control points [N, K] int32 of every Gaussian, nearest first."""
        means = gaussians.means.detach()
        return nearest(means, self.positions, min(NEIGHBORS, len(self)))[0]

    @torch.no_grad()
    def binding(self, gaussians: GaussianParameters) -> tuple[Tensor, Tensor]:
        """Compute neighbours and their RBF weights (SC-GS, Eq. 5): indices [N, K], weights [N, K]."""
        indices = self.neighbors(gaussians)
        return indices, rbf_weights(gaussians.means.detach(), self.positions, self.radii, indices)

    @torch.no_grad()
    def apply_pose(
        self,
        gaussians: GaussianParameters,
        pose: Pose,
        binding: tuple[Tensor, Tensor],
        own_pose: Pose | None = None,
    ) -> Gaussians:
        """Move all Gaussians by linear blend skinning (SC-GS, Eq. 6-7). Gaussians whose control points have not moved
        stay bit-identical. ``own_pose`` has no effect: nothing follows the rotations of a scene that does not move."""
        means, quats, _ = skin(gaussians.means.detach(), gaussians.quats.detach(), self.positions, pose, *binding)
        rest = gaussians.activate()
        moved = pose.translations.any(dim=1) | pose.rotations[:, 1:].any(dim=1)
        touched = moved[binding[0].long()].any(dim=1, keepdim=True)
        means, quats = torch.where(touched, means, rest.means), torch.where(touched, quats, rest.quats)
        return replace(rest, means=means, quats=quats)

    def gaussians_at(self, gaussians: GaussianParameters, time: float | Tensor) -> Gaussians:
        return gaussians.activate()


def spacing(nodes: Tensor) -> Tensor:
    """Return the mean distance [M] to the three nearest other nodes; 1 for a single node."""
    count = min(3, nodes.shape[0] - 1)
    if count < 1:
        return torch.ones(nodes.shape[0], device=nodes.device)
    squared = nearest(nodes, nodes, count + 1)[1][:, 1:]
    distances = squared.sqrt()
    return (distances.sum(dim=1) / count).clamp_min(1e-6)
