"""Skin of posed parts: which control points each Gaussian follows once parts turn, and how far it stretches.

Training lets a Gaussian follow whatever control points move like it over the trained motion. An arm that hangs beside
the trunk therefore shares Gaussians with the shirt. When the arm is posed, a Gaussian follows its own part and those
that it meets at a common joint.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from ..ops.bending import Bent, NodeBend, bend
from ..types import Gaussians
from .graph import ControlGraph
from .rotations import to_matrix
from .skeleton import strongest

SkinName = Literal["parts", "dual", "nodes"]

WIDEST = 2.0
"""Largest factor by which a Gaussian widens. Beyond it, a surface that tears open shows."""
LITTLE = 1e-2
"""Weight of a control point's own rotation in the fit of its surroundings, relative to the sum of its squared edges:
the edges of a thin limb lie almost on a line."""


class PartSkin(NamedTuple):
    """Binding of N Gaussians to control points, for poses of parts."""

    indices: Tensor
    """[N, K] int32"""
    weights: Tensor
    """[N, K] rows sum to 1; 0 for control points across a gap."""
    graph: ControlGraph
    """Graph that bends."""
    dual: bool
    """Whether motions blend as dual quaternions."""

    def moved(self, posed: Gaussians, rest: np.ndarray, positions: np.ndarray, turns: np.ndarray) -> Bent:
        """Move posed Gaussians, normalised units.

        Args:
            rest, positions: [M, 3] control points before and after the edit.
            turns: [M, 4] wxyz rotations of the control points by the edit; exactly the identity where there is none.
        """
        device = posed.means.device
        still = (positions == rest).all(1) & ~turns[:, 1:].any(1)

        def tensor(values: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).float().to(device)

        stretches = tensor(stretches_of(self.graph, rest, positions, turns))
        moved = torch.from_numpy((~still).astype(np.int32)).to(device)
        by = NodeBend(tensor(rest), tensor(positions - rest), tensor(turns), stretches, moved)
        return bend(
            posed.means, posed.quats, posed.scales, by, self.indices, self.weights, dual=self.dual, widest=WIDEST
        )


def part_skin(binding: tuple[Tensor, Tensor], owner: np.ndarray, graph: ControlGraph, dual: bool) -> PartSkin:
    """Restrict a binding to each Gaussian's own part, and to control points of other parts that share an edge of the
    graph with its strongest control point there.

    Args:
        binding: indices and weights [N, K].
        owner: [M] row of each control point's part.
        graph: graph without edges across gaps between parts.
    """
    nodes, weights = binding[0].cpu().numpy().astype(np.int64), binding[1].cpu().numpy().astype(np.float64)
    part = strongest(owner[nodes], weights)
    own = owner[nodes] == part[:, None]
    first = nodes[np.arange(len(nodes)), np.where(own, weights, -1.0).argmax(1)]
    lead = np.repeat(first, nodes.shape[1])
    tied = np.asarray(graph.matrix[lead, nodes.ravel()]).reshape(nodes.shape) > 0
    kept = np.where(own | tied, weights, 0.0)
    total = kept.sum(1, keepdims=True)
    alone = nodes == first[:, None]
    kept = np.where(total > 1e-6, kept / np.maximum(total, 1e-6), alone / alone.sum(1, keepdims=True))
    device = binding[0].device
    return PartSkin(binding[0].contiguous(), torch.from_numpy(kept).float().to(device).contiguous(), graph, dual)


def stretches_of(graph: ControlGraph, rest: np.ndarray, positions: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Return the stretch around each control point, [M, 3, 3]: the affine map that best explains its edges, without its
    rotation. The identity for control points whose edges keep their vectors.

    Args:
        rest, positions: [M, 3] before and after the edit.
        turns: [M, 4] wxyz rotations by the edit.
    """
    begin, ends = graph.begin, graph.neighbors
    own = np.repeat(np.arange(len(graph)), np.diff(begin))
    before, after = rest[ends] - rest[own], positions[ends] - positions[own]
    rotations = to_matrix(turns)
    back = np.einsum("eji,ej->ei", rotations[own], after)
    rows = csr_matrix((np.ones(len(ends)), np.arange(len(ends)), begin), shape=(len(graph), len(ends)))
    A, B = (
        (rows @ (x[:, :, None] * before[:, None]).reshape(-1, 9)).reshape(-1, 3, 3) for x in (before, back - before)
    )
    little = LITTLE * np.trace(A, axis1=1, axis2=2)
    A += np.where(little > 0, little, 1.0)[:, None, None] * np.eye(3)
    return np.eye(3) + B @ np.linalg.inv(A)
