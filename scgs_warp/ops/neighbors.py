"""Control points of every Gaussian: exact nearest neighbours and RBF weights (SC-GS, Eq. 5)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernels import neighbors as kernels
from ..kernels.cpu import neighbor_lists, neighbors
from ..kernels.cuda import neighbors as cuda_kernels
from ..runtime.launch import launch
from . import cuda_blocks, radix
from .node_sums import rbf_node_sums

SAMPLE = 4096
"""Smallest number of points (all, if there are fewer) from which the extent of candidate lists is estimated."""


class NodeLists(NamedTuple):
    """The (Gaussian, neighbour) pairs of every node in ascending order, the order in which its gradients are summed."""

    order: Tensor
    """[N * K] int32, indices ``i * K + k`` of the pairs, sorted by node."""
    begin: Tensor
    """[M + 1] int32, node m's pairs are ``order[begin[m]:begin[m + 1]]``."""


def node_lists(indices: Tensor, count: int) -> NodeLists:
    """List the pairs of each of ``count`` nodes, without host contact.

    Args:
        indices: [N, K] int32 in [-1, count). Pairs of node -1 belong to no node; they come first in ``order``.
    """
    pairs, device = indices.numel(), indices.device
    keys, order = (torch.empty(2 * pairs, dtype=torch.int32, device=device) for _ in range(2))
    begin = torch.empty(count + 1, dtype=torch.int32, device=device)
    launch(kernels.number_pairs, pairs, indices.reshape(-1), keys, order)
    radix.radix_sort(keys, order, pairs, count.bit_length())
    launch(kernels.node_begins, pairs + 1, keys, begin)
    return NodeLists(order[:pairs], begin)


def chunk_size(nodes: int) -> int:
    """Return the number of Gaussians whose node gradients are summed into one buffer on a CPU.

    It depends on the node count alone, and is a multiple of the 16 lanes of the kernels.
    """
    return max(2048, -(-4 * nodes // 16) * 16)


def _check_nearest(points: Tensor, nodes: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Validate points and nodes, and return them contiguous and detached."""
    if points.ndim != 2:
        raise ValueError(f"points must be [N, D], got {tuple(points.shape)}")
    if nodes.ndim != 2 or nodes.shape[1] != points.shape[1] or points.shape[1] == 0:
        raise ValueError(f"nodes must be [M, {points.shape[1]}] (D > 0) as points, got {tuple(nodes.shape)}")
    if not 1 <= k <= min(nodes.shape[0], kernels.MAX_NEIGHBORS):
        raise ValueError(f"k must be in 1 .. min(M, {kernels.MAX_NEIGHBORS}), got {k} with M = {nodes.shape[0]} nodes")
    return points.detach().contiguous(), nodes.detach().contiguous()


def _in_lanes(points: Tensor) -> bool:
    return points.device.type == "cpu" and points.shape[1] <= neighbors.MAX_DIMENSIONS


def nearest(points: Tensor, nodes: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Find the exact ``k`` nearest nodes of every point, nearest first; ties go to the lower index. No gradient.

    Args:
        points: [N, D] float32.
        nodes: [M, D] float32.
        k: neighbours per point, 1 .. min(M, 16).

    Returns:
        Indices [N, k] int32, always in [0, M), and squared distances [N, k]; NaN and infinite distances become
        infinity.

    Raises:
        ValueError: a shape is wrong, or ``k`` is out of range.
    """
    points, nodes = _check_nearest(points, nodes, k)
    indices = torch.empty(points.shape[0], k, dtype=torch.int32, device=points.device)
    distances = torch.empty(points.shape[0], k, device=points.device)
    arguments = points, nodes, k, indices, distances
    if _in_lanes(points):
        launch(neighbors.nearest, _blocks(points), *arguments, grain=16)
    elif points.is_cuda and k <= cuda_kernels.MAX_NEIGHBORS and points.shape[1] <= cuda_kernels.MAX_DIMENSIONS:
        blocks = -(-points.shape[0] // cuda_kernels.BLOCK_DIM)
        cuda_blocks.launch_native(cuda_kernels.nearest, blocks, *arguments)
    else:
        launch(kernels.nearest, points.shape[0], *arguments)
    return indices, distances


def _blocks(points: Tensor) -> int:
    return -(-points.shape[0] // neighbors.LANES)


class CandidateLists(NamedTuple):
    """Candidate nodes of every block of sixteen points, with the positions that the nodes had when they were listed."""

    k: int
    """Number of neighbours for which the lists were made."""
    order: Tensor
    """[N] int32, the points in Morton order; each sixteen in a row are a block."""
    centres: Tensor
    """[blocks, D + 1] centre and reach of each block."""
    counts: Tensor
    """[blocks] int32, number of candidates."""
    lists: Tensor
    """[blocks, LIST_SIZE] int32, the candidates."""
    nodes: Tensor
    """[M, D] positions of the nodes when the lists were made."""

    def fit(self, points: Tensor, nodes: Tensor, k: int) -> bool:
        width = points.shape[1] + 1
        return (
            k == self.k
            and self.order.shape[0] == points.shape[0]
            and self.centres.shape[1] == width
            and self.nodes.shape == nodes.shape
        )


class NeighborSearch:
    """A search like :func:`nearest` that is faster if points and nodes move little between calls.

    On a CPU it remembers candidate nodes for blocks of points that are close together. A later call searches a block's
    candidates only, if a bound on all movements since then proves that they suffice, and otherwise every node. The
    remembered candidates never change a result, so they need be neither invalidated nor saved.
    """

    def __init__(self) -> None:
        self.lists: CandidateLists | None = None
        """Candidates in use, or None before the first search."""
        self.full_searches = 0
        """Number of blocks searched in full since the lists were made."""

    def __call__(self, points: Tensor, nodes: Tensor, k: int) -> Tensor:
        """Return exactly the indices of ``nearest(points, nodes, k)``, [N, k] int32.

        Raises:
            ValueError: as :func:`nearest`.
        """
        points, nodes = _check_nearest(points, nodes, k)
        if not _in_lanes(points):
            return nearest(points, nodes, k)[0]
        blocks = _blocks(points)
        # New lists cost about as much as a full search of every block, so they are made after as many full searches.
        own = self.lists  # read once: another thread may replace them
        if own is None or self.full_searches > blocks or not own.fit(points, nodes, k):
            indices, distances = nearest(points, nodes, k)
            self.lists, self.full_searches = _make_lists(points, nodes, distances), 0
            return indices
        shift, failed = torch.empty(1), torch.empty(blocks, dtype=torch.int32)
        launch(neighbor_lists.largest_shift, 1, own.nodes, nodes, shift)
        indices = torch.empty(points.shape[0], k, dtype=torch.int32)
        lists = own.order, own.centres, own.counts, own.lists, shift
        launch(neighbors.nearest_listed, blocks, points, nodes, k, *lists, indices, failed, grain=16)
        self.full_searches += int(failed.sum())
        return indices


def _make_lists(points: Tensor, nodes: Tensor, distances: Tensor) -> CandidateLists:
    codes = torch.empty(points.shape[0], dtype=torch.int32)
    if points.shape[0]:
        space = points.nan_to_num(0.0, 0.0, 0.0)
        sample = space[:: max(1, points.shape[0] // SAMPLE)]
        tails = max(1, len(sample) // 100)  # a few points far out would make the cubes of all others too large
        low, high = (sample.kthvalue(rank, 0).values for rank in (tails, len(sample) + 1 - tails))
        widest = (high - low).argsort(descending=True, stable=True)[:4]
        space = ((space - low) / float((high - low).max().clamp_min(1e-12)))[:, widest].contiguous()
        launch(neighbor_lists.morton_codes, points.shape[0], space, codes)
    order = torch.argsort(codes).int()
    blocks, width = _blocks(points), points.shape[1] + 1
    centres, counts = torch.empty(blocks, width), torch.empty(blocks, dtype=torch.int32)
    lists = torch.empty(blocks, int(neighbor_lists.LIST_SIZE), dtype=torch.int32)
    columns = nodes.T.contiguous()
    launch(neighbor_lists.list_blocks, blocks, points, columns, order, distances, centres, counts, lists, grain=16)
    return CandidateLists(distances.shape[1], order, centres, counts, lists, nodes.clone())


def _node_sums(
    indices: Tensor, points: Tensor, nodes: Tensor, v_logits: Tensor, lists: NodeLists | None
) -> tuple[int, Tensor]:
    """Sum the nodes' gradients in parts, and return the number of parts and their buffer [parts * M, 2 + D]."""
    count, width = nodes.shape[0], 2 + nodes.shape[1]
    if lists is None and points.device.type == "cpu":
        size = chunk_size(count)
        chunks = -(-points.shape[0] // size)
        sums = torch.zeros(chunks * count, width)
        launch(kernels.rbf_reduce_chunks, chunks, size, points, nodes, indices, v_logits, sums, grain=1)
        return chunks, sums
    return 1, rbf_node_sums(*(lists or node_lists(indices, count)), points, nodes, indices, v_logits)


class _RbfWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points, nodes, radii, strengths, indices, lists):
        weights = torch.empty(indices.shape, device=points.device)
        named = int(strengths is not None)
        launch(kernels.rbf_weights, points.shape[0], points, nodes, radii, strengths, named, indices, weights)
        ctx.save_for_backward(points, nodes, radii, strengths, indices, weights)
        ctx.lists = lists
        return weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients):  # type: ignore[override]
        points, nodes, radii, strengths, indices, weights = ctx.saved_tensors
        v_weights = gradients[0].contiguous()
        v_logits, v_points = torch.empty_like(weights), torch.empty_like(points)
        launch(
            kernels.rbf_weights_adjoint,
            points.shape[0],
            *(points, nodes, radii, indices, weights, v_weights),
            *(v_logits, v_points),
        )
        chunks, sums = _node_sums(indices, points, nodes, v_logits, ctx.lists)
        v_nodes, v_radii = torch.empty_like(nodes), torch.empty_like(radii)
        v_strengths = None if strengths is None else torch.empty_like(strengths)
        named = int(strengths is not None)
        outputs = v_nodes, v_radii, v_strengths
        launch(kernels.rbf_finish, nodes.shape[0], chunks, radii, strengths, named, sums, *outputs, grain=128)
        return v_points, v_nodes, v_radii, v_strengths, None, None


def rbf_weights(
    points: Tensor,
    nodes: Tensor,
    radii: Tensor,
    indices: Tensor,
    strengths: Tensor | None = None,
    *,
    lists: NodeLists | None = None,
) -> Tensor:
    """Return the weights of a Gaussian's control points: ``s_k exp(-d_k^2 / (2 r_k^2))``, normalised.

    See SC-GS, Eq. 5; the strengths s_k are the official code's learned node weights. The weights are computed as a
    softmax of exponents, so those of a Gaussian far from every node do not underflow. A row without a finite exponent
    gives weight 1 to its first neighbour and passes no gradient.

    Args:
        points: [N, D] rest positions, with hyper-coordinates appended if used.
        nodes: [M, D] likewise.
        radii: [M] > 0, in the units of the points.
        indices: [N, K] int32 in [0, M), as ``nearest`` gives them.
        strengths: [M] > 0. None: 1.
        lists: ``node_lists(indices, M)``, if computed before; used on CUDA.

    Returns:
        [N, K], rows sum to 1. Gradients flow to points, nodes, radii and strengths.

    Raises:
        ValueError: a shape is wrong.
    """
    if points.ndim != 2:
        raise ValueError(f"points must be [N, D], got {tuple(points.shape)}")
    if nodes.ndim != 2 or nodes.shape[1] != points.shape[1]:
        raise ValueError(f"nodes must be [M, {points.shape[1]}] as points, got {tuple(nodes.shape)}")
    for name, value in (("radii", radii), ("strengths", strengths)):
        if value is not None and tuple(value.shape) != (nodes.shape[0],):
            raise ValueError(f"{name} must be [{nodes.shape[0]}], one a node, got {tuple(value.shape)}")
    if indices.ndim != 2 or indices.shape[0] != points.shape[0] or indices.dtype != torch.int32 or not indices.shape[1]:
        raise ValueError(
            f"indices must be int32 [{points.shape[0]}, K] (K > 0), got {indices.dtype} {tuple(indices.shape)}"
        )
    strengths = None if strengths is None else strengths.contiguous()
    return _RbfWeights.apply(  # type: ignore[return-value]
        points.contiguous(), nodes.contiguous(), radii.contiguous(), strengths, indices.contiguous(), lists
    )
