"""Distances between spheres and an image's silhouette, with gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..kernels import silhouette as kernels
from ..kernels.cpu import silhouette as cpu_kernels
from ..kernels.types import LANES
from ..runtime.launch import launch
from ..types import Camera
from .forms import Form, chosen_form
from .reduction import sum_rows

BLOCKS = 128
"""Smallest number of blocks of 16 spheres that a thread takes."""
COMPARISONS = 1 << 19
"""Smallest number of distances between spheres and pixels that a thread takes: some 50 microseconds, several times what
sharing them costs."""


def _blocks(count: int) -> int:
    return -(-count // LANES)


class _Compare(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, viewmat, K, width: int, table, size, pixels, form: Form) -> Tensor:
        spheres, count = means.shape[0], pixels.shape[0]
        points, slopes, directions = means.new_empty(spheres, 2), means.new_empty(spheres, 2), torch.empty_like(pixels)
        parts, indices = means.new_empty(spheres + count), pixels.new_empty(count, dtype=torch.int32)
        projected = means, viewmat, K, width, table, size, points, slopes, parts
        compared = points, pixels, indices, directions, parts
        if form == "cpu":
            launch(cpu_kernels.project_spheres, _blocks(spheres), *projected, grain=BLOCKS)
            grain = max(1, COMPARISONS // (LANES * spheres))
            launch(cpu_kernels.nearest_spheres, _blocks(count), *compared, grain=grain)
        else:
            launch(kernels.project_spheres, spheres, *projected)
            launch(kernels.nearest_spheres, count, *compared)
        ctx.save_for_backward(means, viewmat, K, slopes, indices, directions)
        ctx.width, ctx.form = width, form
        return sum_rows(parts[:, None])[0]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_term: Tensor):  # type: ignore[override]
        means, viewmat, K, *found = ctx.saved_tensors
        v_means = torch.empty_like(means)
        known = means, viewmat, K, ctx.width, *found, v_term.reshape(1)
        if ctx.form == "cpu":
            launch(cpu_kernels.project_spheres_adjoint, _blocks(len(means)), *known, v_means, grain=BLOCKS)
        else:
            launch(kernels.project_spheres_adjoint, len(means), *known, v_means)
        return v_means, None, None, None, None, None, None, None


def silhouette(
    means: Tensor, camera: Camera, distances: Tensor, size: Tensor, pixels: Tensor, *, form: Form = "auto"
) -> Tensor:
    """Return the mean distance of projected centres to a silhouette, plus the mean distance of its pixels to the
    nearest projected centre. Lengths in the image are in units of its width.

    Centres nearer than ``NEAREST_DEPTH``, or behind the camera, are divided by that depth. Beyond the table's border,
    distances are those at the border. The first of several nearest centres counts. If a centre is NaN, so is the term.

    Args:
        means: [N, 3] centres.
        camera: camera of the image.
        distances: [h, w] distance of each pixel to the silhouette.
        size: [2] width and height of ``distances``.
        pixels: [P, 2] positions (x, y) of pixels of the silhouette.
        form: kernels to run: ``plain`` on any device, ``cpu`` in SIMD; ``auto`` takes the fastest for the device.

    Returns:
        Scalar. Gradients flow to ``means`` only.

    Raises:
        ValueError: a shape or the form is wrong, or there are no centres, pixels or distances.
    """
    given = {
        "means": (means, ("N", 3)),
        "viewmat": (camera.viewmat, (4, 4)),
        "K": (camera.K, (3, 3)),
        "distances": (distances, ("h", "w")),
        "size": (size, (2,)),
        "pixels": (pixels, ("P", 2)),
    }
    for name, (value, shape) in given.items():
        found = tuple(value.shape)
        if len(found) != len(shape) or any(n != m if isinstance(m, int) else n == 0 for n, m in zip(found, shape)):
            raise ValueError(f"{name} must be [{', '.join(map(str, shape))}], not empty, got {found}")
    form = chosen_form(form, means.device)
    seen = camera.viewmat.detach().contiguous()[None], camera.K.detach().contiguous()[None], camera.width
    compared = (tensor.detach().contiguous() for tensor in (distances, size, pixels))
    return _Compare.apply(means.contiguous(), *seen, *compared, form)  # type: ignore[return-value]
