"""Posing: the network's output to a pose, and, without gradients, the pose to Gaussians, in a launch each."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..kernels import posing as kernels
from ..kernels.cpu import posing as cpu_kernels
from ..kernels.neighbors import MAX_NEIGHBORS
from ..kernels.types import LANES
from ..runtime.launch import launch
from ..types import Pose
from .finishing import check_rest
from .forms import Form, chosen_form
from .skinning import check_inputs, pack_palette, pose_tensors

WIDTHS = {"translations": 3, "rotations": 4, "shape_rotations": 4, "log_scales": 3, "tints": 3}
"""Number of columns of each field of a pose."""


class _UnitPose(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, motion: Tensor, columns: tuple[int, ...]):
        widths = 3, 4, 4, 3
        parts = [None if at < 0 else motion.new_empty(len(motion), width) for at, width in zip(columns, widths)]
        launch(kernels.unit_pose, len(motion), motion, *columns, *parts)
        ctx.save_for_backward(motion)
        ctx.columns = columns
        ctx.set_materialize_grads(False)
        return tuple(parts)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients):  # type: ignore[override]
        (motion,) = ctx.saved_tensors
        columns = tuple(-1 if v is None else at for at, v in zip(ctx.columns, gradients))
        v_parts = [None if v is None else v.contiguous() for v in gradients]
        v_motion = torch.empty_like(motion)
        launch(kernels.unit_pose_adjoint, len(motion), motion, *columns, *v_parts, v_motion)
        return v_motion, None


def unit_pose(motion: Tensor, heads: dict[str, int]) -> Pose:
    """Split the output of the deformation network into a pose.

    Args:
        motion: [M, C] output. Its quaternions are differences from the identity.
        heads: the numbers of columns of the pose's fields, in their order.

    Returns:
        The pose, with gradients to ``motion``. A quaternion of norm 0 becomes the identity, without a gradient.

    Raises:
        ValueError: the heads do not cover the columns, or one has not the width of its field.
    """
    columns = sum(heads.values())
    if motion.ndim != 2 or motion.shape[1] != columns:
        raise ValueError(f"motion must be [M, {columns}], got {tuple(motion.shape)}")
    for name, width in heads.items():
        if WIDTHS.get(name) != width:
            raise ValueError(f"heads: {name} has {width} columns; the fields of a pose have {WIDTHS}")
    starts, at = {}, 0
    for name, width in heads.items():
        starts[name], at = at, at + width
    extras = "tints" if "tints" in heads else "log_scales"
    fields = "translations", "rotations", "shape_rotations", extras
    columns = tuple(starts.get(name, -1) for name in fields)
    return Pose(**dict(zip(fields, _UnitPose.apply(motion.contiguous(), columns))))  # type: ignore[arg-type]


def pose_gaussians(
    rest: tuple[Tensor, ...],
    nodes: Tensor,
    pose: Pose,
    indices: Tensor,
    weights: Tensor,
    quats_own: Tensor | None = None,
    *,
    form: Form = "auto",
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Move Gaussians by linear blend skinning, apply correctives, tints and shading, and activate them.

    Args:
        rest: means [N, 3], quats [N, 4] wxyz of any norm, log scales [N, 3], opacity logits [N], ``sh_dc`` [N, 3],
            correctives [N, 27] or [N, 0], and shading [N, 10] or [N, 0].
        nodes: [M, 3] control points at rest.
        pose: of the M control points.
        indices: [N, K] int32 nearest control points of each Gaussian.
        weights: [N, K] their weights; rows sum to 1.
        quats_own: [N, 4] wxyz, any norm: rotations that correctives and shading follow instead of the moved ones.
        form: kernels to run: ``plain`` on any device, ``cpu`` in SIMD; ``auto`` takes the fastest for the device.

    Returns:
        Means, quats, scales, opacities and ``sh_dc``, as ``skin``, ``correct``, ``tint``, ``shade`` and the activations
        give them (form ``cpu`` to the bit); no gradients.

    Raises:
        ValueError: a shape or the form is wrong, or there are more neighbours than the form takes.
    """
    check_inputs(rest[0], rest[1], nodes, pose, indices, weights)
    check_rest(rest, quats_own)
    if form == "cpu" and indices.shape[1] > MAX_NEIGHBORS:
        raise ValueError(f"form cpu takes up to {MAX_NEIGHBORS} neighbours, got {indices.shape[1]}")
    translations, rotations, shapes, extras = (None if x is None else x.contiguous() for x in pose_tensors(pose))
    kind = int(0 if extras is None else kernels.LOG_SCALES if pose.tints is None else kernels.TINTS)
    quats_own, count = None if quats_own is None else quats_own.contiguous(), len(rest[0])
    rest, nodes = tuple(value.detach().contiguous() for value in rest), nodes.detach().contiguous()
    binding = indices.contiguous(), weights.contiguous(), quats_own, int(quats_own is not None)
    means, quats, scales, opacities, sh_dc = (torch.empty_like(value) for value in rest[:5])
    posed = means, quats, scales, opacities, sh_dc
    if form == "auto" and indices.shape[1] > MAX_NEIGHBORS:
        form = "plain"
    form = chosen_form(form, nodes.device)
    if form == "cpu":
        palette = pack_palette(nodes, (translations, rotations, shapes, extras))
        launch(cpu_kernels.pose_gaussians, -(-count // LANES), *rest, *palette, kind, *binding, *posed, grain=32)
    else:
        pose_of_nodes = translations, rotations, rotations if shapes is None else shapes, extras, kind
        launch(kernels.pose_gaussians, count, *rest, nodes, *pose_of_nodes, *binding, *posed)
    return posed
