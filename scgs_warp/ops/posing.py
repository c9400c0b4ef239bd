"""Posing without gradients on a GPU: the network's output to a pose, and the pose to Gaussians, in a launch each."""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernels import posing as kernels
from ..runtime.launch import launch
from ..types import Pose
from .skinning import pose_tensors


def unit_pose(motion: Tensor, heads: dict[str, int]) -> Pose:
    """Split the output of the deformation network into a pose.

    Args:
        motion: [M, C] output. Its quaternions are differences from the identity.
        heads: the numbers of columns of the pose's fields, in their order.
    """
    starts, at = {}, 0
    for name, width in heads.items():
        starts[name], at = at, at + width
    extras = "tints" if "tints" in heads else "log_scales"
    columns = [starts.get(name, -1) for name in ("rotations", "translations", "shape_rotations", extras)]
    fields = {name: motion.new_empty(len(motion), width) for name, width in heads.items()}
    outputs = [fields.get(name) for name in ("translations", "rotations", "shape_rotations", extras)]
    launch(kernels.unit_pose, len(motion), motion.contiguous(), *columns, *outputs)
    return Pose(**fields)


def pose_gaussians(
    rest: tuple[Tensor, ...],
    nodes: Tensor,
    pose: Pose,
    indices: Tensor,
    weights: Tensor,
    own: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Move Gaussians by linear blend skinning, apply correctives, tints and shading, and activate them.

    Args:
        rest: means [N, 3], quats [N, 4] wxyz of any norm, log scales [N, 3], opacity logits [N], ``sh_dc`` [N, 3],
            correctives [N, 27] or [N, 0], and shading [N, 10] or [N, 0].
        nodes: [M, 3] control points at rest.
        pose: of the M control points.
        indices: [N, K] int32 nearest control points of each Gaussian.
        weights: [N, K] their weights; rows sum to 1.
        own: [N, 4] wxyz, any norm: rotations that correctives and shading follow instead of the moved ones.

    Returns:
        Means, quats, scales, opacities and ``sh_dc``, as ``skin``, ``correct``, ``tint``, ``shade`` and the activations
        give them; no gradients.
    """
    translations, rotations, shapes, extras = (None if x is None else x.contiguous() for x in pose_tensors(pose))
    kind = 0 if extras is None else kernels.LOG_SCALES if pose.tints is None else kernels.TINTS
    own = None if own is None else own.contiguous()
    means, quats, scales, opacities, sh_dc = (torch.empty_like(value) for value in rest[:5])
    launch(
        kernels.pose_gaussians,
        len(rest[0]),
        *(value.detach().contiguous() for value in rest),
        *(nodes.detach().contiguous(), translations, rotations, rotations if shapes is None else shapes),
        *(extras, int(kind), indices.contiguous(), weights.contiguous(), own, int(own is not None)),
        *(means, quats, scales, opacities, sh_dc),
    )
    return means, quats, scales, opacities, sh_dc
