"""Linear blend skinning: Gaussians follow their control points (SC-GS, Eq. 6 and 7)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernels import skinning as kernels
from ..kernels.cpu import skinning, skinning_adjoint, skinning_palette
from ..runtime.launch import launch
from ..types import Pose
from .neighbors import NodeLists, chunk_size, node_lists, rbf_weights
from .node_sums import skin_node_sums
from .shapes import check_shapes


class _Skin(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means, quats, nodes, translations, rotations, shapes, extras, weights, indices, lists):
        has_extras = int(extras is not None)
        outputs = torch.empty_like(means), torch.empty_like(quats), torch.empty_like(means) if has_extras else None
        both = rotations if shapes is None else shapes
        inputs = means, quats, nodes, translations, rotations, both, extras, has_extras, indices, weights
        launch(kernels.skin, means.shape[0], *inputs, *outputs)
        ctx.save_for_backward(means, quats, nodes, translations, rotations, shapes, extras, indices, weights)
        ctx.lists = lists
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients):  # type: ignore[override]
        means, quats, nodes, translations, rotations, shapes, extras, indices, weights = ctx.saved_tensors
        has_extras = int(extras is not None)
        v_outputs = tuple(None if v is None else v.contiguous() for v in gradients)
        both = rotations if shapes is None else shapes
        v_means, v_quats = torch.empty_like(means), torch.empty_like(quats)
        v_weights, v_blends = torch.empty_like(weights), torch.empty_like(quats)
        inputs = means, quats, nodes, translations, rotations, both, extras, has_extras, indices, weights
        own = v_means, v_quats, v_weights, v_blends
        launch(kernels.skin_adjoint, means.shape[0], *inputs, *v_outputs, *own)
        pairs = means, nodes, both, indices, weights, v_outputs[0], v_blends, v_outputs[2], has_extras
        chunks, sums = _node_sums(pairs, has_extras, ctx.lists)
        v_nodes, v_translations, v_rotations = (torch.empty_like(x) for x in (nodes, translations, rotations))
        v_shapes = None if shapes is None else torch.empty_like(shapes)
        v_extras = torch.empty_like(extras) if has_extras else None
        launch(
            kernels.skin_finish,
            nodes.shape[0],
            *(chunks, rotations, both, int(shapes is not None), has_extras, sums),
            *(v_nodes, v_translations, v_rotations, v_shapes, v_extras),
            grain=128,
        )
        of_pose = v_translations, v_rotations, v_shapes, v_extras
        return v_means, v_quats, v_nodes, *of_pose, v_weights, None, None


def _skin_lanes(means, quats, nodes, translations, rotations, shapes, extras, weights, indices) -> tuple:
    """Run ``skin`` on a CPU, without gradients."""
    has_extras = int(extras is not None)
    outputs = _like(means, quats, means if has_extras else None)
    palette = pack_palette(nodes, (translations, rotations, shapes, extras))
    launch(skinning.skin, _lanes(means), means, quats, *palette, has_extras, indices, weights, *outputs, grain=32)
    return tuple(outputs)


def _node_sums(pairs: tuple, has_extras: int, lists: NodeLists | None) -> tuple[int, Tensor]:
    """Sum the nodes' gradients in parts, and return the number of parts and their buffer [parts * M, columns]."""
    means, nodes, indices = pairs[0], pairs[1], pairs[3]
    count, width = nodes.shape[0], kernels.SUMS + 3 * has_extras
    if lists is None and means.device.type == "cpu":
        size = chunk_size(count)
        chunks = -(-means.shape[0] // size)
        sums = torch.zeros(chunks * count, width)
        launch(kernels.skin_reduce_chunks, chunks, size, *pairs, sums, grain=1)
        return chunks, sums
    return 1, skin_node_sums(*(lists or node_lists(indices, count)), pairs, has_extras)


def pose_tensors(pose: Pose) -> tuple[Tensor | None, ...]:
    """Return translations, rotations, shape rotations, and the extras: log scales or tints."""
    extras = pose.tints if pose.log_scales is None else pose.log_scales
    return pose.translations, pose.rotations, pose.shape_rotations, extras


def check_inputs(
    means: Tensor, quats: Tensor, nodes: Tensor, pose: Pose, indices: Tensor, weights: Tensor | None
) -> None:
    """Check the shapes that :func:`skin` declares.

    Raises:
        ValueError: a shape is wrong, or the pose has both log scales and tints.
    """
    if means.ndim != 2 or means.shape[1] != 3:
        raise ValueError(f"means must be [N, 3], got {tuple(means.shape)}")
    if nodes.ndim != 2 or nodes.shape[1] != 3:
        raise ValueError(f"nodes must be [M, 3], got {tuple(nodes.shape)}")
    if indices.ndim != 2 or not indices.shape[1] or indices.dtype != torch.int32:
        raise ValueError(f"indices must be int32 [N, K] with K > 0, got {indices.dtype} {tuple(indices.shape)}")
    count, total, k = nodes.shape[0], means.shape[0], indices.shape[1]
    expected = {
        "quats": (quats, (total, 4)),
        "indices": (indices, (total, k)),
        "weights": (weights, (total, k)),
        "pose.translations": (pose.translations, (count, 3)),
        "pose.rotations": (pose.rotations, (count, 4)),
        "pose.shape_rotations": (pose.shape_rotations, (count, 4)),
        "pose.log_scales": (pose.log_scales, (count, 3)),
        "pose.tints": (pose.tints, (count, 3)),
    }
    check_shapes(expected)
    if pose.log_scales is not None and pose.tints is not None:
        raise ValueError("a pose has log_scales or tints, not both")


def skin(
    means: Tensor,
    quats: Tensor,
    nodes: Tensor,
    pose: Pose,
    indices: Tensor,
    weights: Tensor,
    *,
    lists: NodeLists | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Move Gaussians with their control points (SC-GS, Eq. 6 and 7).

    ``mu_t = sum_k w_k (R_k (mu - p_k) + p_k + T_k)`` and ``q_t = unit(sum_k w_k s_k r_k) x unit(q)``, where the sign
    s_k = +-1 makes the dot product of r_k with the first neighbour's rotation non-negative. The gradient to mu includes
    the blended rotation.

    Args:
        means: [N, 3] at rest, world.
        quats: [N, 4] wxyz at rest, need not be unit.
        nodes: [M, 3] control points at rest, world.
        pose: pose of the M control points. Its rotations need not be unit; ``shape_rotations``, if given, turn the
            Gaussians' shapes instead of ``rotations``.
        indices: [N, K] int32 in [0, M), nearest first, as ``nearest`` gives them. Not checked against M.
        weights: [N, K], rows sum to 1, as ``rbf_weights`` gives them.
        lists: ``node_lists(indices, M)``, if computed before; used on CUDA.

    Returns:
        Means [N, 3], quaternions [N, 4] (wxyz, unit), and the blend of the pose's log scales or tints [N, 3] (None if
        the pose has neither).
        Gradients flow to all tensors except the indices; a Gaussian with a non-finite mean or quaternion passes none.

    Raises:
        ValueError: a shape is wrong.
    """
    check_inputs(means, quats, nodes, pose, indices, weights)
    floats = means, quats, nodes, *pose_tensors(pose), weights
    values = [None if value is None else value.contiguous() for value in floats]
    indices = indices.contiguous()
    if means.device.type == "cpu" and not torch.is_grad_enabled() and indices.shape[1] <= skinning.MAX_NEIGHBORS:
        return _skin_lanes(*values, indices=indices)
    return _Skin.apply(*values, indices, lists)  # type: ignore[return-value]


SAME_SIDE = 0.7072
"""Bound on the first component of unit quaternions. Quaternions above it are, as directions in four dimensions, less
than 45 degrees from the identity, and hence less than 90 degrees from each other."""


class Palette(NamedTuple):
    """The control points as rows, for the SIMD kernels."""

    motion: Tensor
    reach: Tensor
    aligned: int
    """Integer flag, 1 if all shape rotations are less than 90 degrees apart: the kernels then skip the sign flips."""


def pack_palette(nodes: Tensor, pose: tuple, radii=None, strengths=None, hyper=None) -> Palette:
    """Pack tensors of control points, which must be contiguous, into a palette.

    Args:
        pose: results of :func:`pose_tensors`.
    """
    translations, rotations, shapes, extras = pose
    count = nodes.shape[0]
    motion, reach = (torch.empty(count, skinning_palette.ROW) for _ in range(2))
    launch(
        skinning_palette.palette,
        count,
        *(nodes, hyper, int(hyper is not None), radii, int(radii is not None), strengths, int(strengths is not None)),
        *(translations, rotations, rotations if shapes is None else shapes),
        *(extras, int(extras is not None), motion, reach),
        grain=128,
    )
    return Palette(motion, reach, int((motion.numpy()[:, 12] > SAME_SIDE).all()))


class _SkinRbf(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means, quats, hyper, nodes, hyper_nodes, radii, strengths, *pose_and_indices):
        *pose, indices = pose_and_indices
        has_hyper, has_strengths, has_extras = (int(value is not None) for value in (hyper, strengths, pose[3]))
        palette = pack_palette(nodes, tuple(pose), radii, strengths, hyper_nodes)
        weights = torch.empty(indices.shape)
        outputs = _like(means, quats, means if has_extras else None)
        launch(
            skinning.skin_rbf,
            _lanes(means),
            *(means, quats, hyper, has_hyper, *palette, has_strengths, has_extras, indices, weights, *outputs),
            grain=32,
        )
        saved = means, quats, hyper, nodes, hyper_nodes, radii, strengths, *pose
        ctx.save_for_backward(*saved, indices, weights, palette.motion, palette.reach)
        ctx.flags = has_hyper, has_strengths, has_extras, palette.aligned
        return tuple(outputs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients):  # type: ignore[override]
        means, quats, hyper, nodes, hyper_nodes, radii, strengths, *pose, indices, weights, motion, reach = (
            ctx.saved_tensors
        )
        translations, rotations, shapes, extras = pose
        (has_hyper, has_strengths, has_extras, aligned), count = ctx.flags, nodes.shape[0]
        v_outputs = (None if v is None else v.contiguous() for v in gradients)
        size = chunk_size(count)
        chunks = -(-means.shape[0] // size)
        v_motion, v_reach = (torch.empty(chunks, count, skinning_palette.ROW) for _ in range(2))
        v_means, v_quats, v_hyper = _like(means, quats, hyper)
        launch(
            skinning_adjoint.skin_rbf_adjoint,
            chunks,
            *(size, means, quats, hyper, has_hyper, motion, reach, aligned, has_strengths, has_extras),
            *(indices, weights, *v_outputs),
            *(v_means, v_quats, v_hyper, v_motion.view(-1, 16), v_reach.view(-1, 16)),
            grain=1,
        )
        of_nodes = _like(nodes, hyper_nodes, radii, strengths)
        of_pose = _like(translations, rotations, shapes, extras)
        both = rotations if shapes is None else shapes
        launch(
            skinning_palette.palette_adjoint,
            count,
            *(nodes, has_hyper, radii, strengths, has_strengths),
            *(rotations, both, int(shapes is not None), has_extras, v_motion, v_reach, *of_nodes, *of_pose),
            grain=64,
        )
        return v_means, v_quats, v_hyper, *of_nodes, *of_pose, None


def _lanes(means: Tensor) -> int:
    return -(-means.shape[0] // skinning.LANES)


def _like(*values: Tensor | None) -> list[Tensor | None]:
    return [None if value is None else torch.empty_like(value) for value in values]


def skin_rbf(
    means: Tensor,
    quats: Tensor,
    nodes: Tensor,
    radii: Tensor,
    pose: Pose,
    indices: Tensor,
    strengths: Tensor | None = None,
    hyper_points: Tensor | None = None,
    hyper_nodes: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Skin with the weights of ``rbf_weights``; on a CPU one kernel computes both, and one kernel its adjoint.

    Args:
        means, quats, nodes, pose, indices: as in ``skin``.
        radii, strengths: as in ``rbf_weights``.
        hyper_points: [N, H] further coordinates of the Gaussians, for the weights alone. None: no such coordinates.
        hyper_nodes: [M, H] further coordinates of the control points; required exactly with ``hyper_points``.

    Returns:
        The results of ``skin``. Gradients flow to all tensors except the indices.

    Raises:
        ValueError: a shape is wrong.
    """
    if (hyper_points is None) != (hyper_nodes is None):
        raise ValueError("hyper_points and hyper_nodes must be given together")
    width = 0 if hyper_points is None else hyper_points.shape[-1]
    check_inputs(means, quats, nodes, pose, indices, None)
    total, count = means.shape[0], nodes.shape[0]
    expected = {
        "radii": (radii, (count,)),
        "strengths": (strengths, (count,)),
        "hyper_points": (hyper_points, (total, width)),
        "hyper_nodes": (hyper_nodes, (count, width)),
    }
    check_shapes(expected)
    fits = indices.shape[1] <= skinning.MAX_NEIGHBORS and width <= skinning_palette.MAX_HYPER
    if means.device.type != "cpu" or not fits:
        points = means if hyper_points is None else torch.cat([means, hyper_points], 1)
        centers = nodes if hyper_nodes is None else torch.cat([nodes, hyper_nodes], 1)
        lists = node_lists(indices, count) if means.device.type == "cuda" and torch.is_grad_enabled() else None
        weights = rbf_weights(points, centers, radii, indices, strengths, lists=lists)
        return skin(means, quats, nodes, pose, indices, weights, lists=lists)
    floats = means, quats, hyper_points, nodes, hyper_nodes, radii, strengths, *pose_tensors(pose)
    values = (None if value is None else value.contiguous() for value in floats)
    return _SkinRbf.apply(*values, indices.contiguous())  # type: ignore[return-value]
