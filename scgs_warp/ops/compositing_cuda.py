"""Launches of the forms of compositing that use a block of threads per tile, ``cuda`` and the portable ``blocks``, and
of the sums of gradients of every form."""

from __future__ import annotations

from torch import Tensor

from ..kernels import compositing
from ..kernels.cpu import compositing as cpu_kernels
from ..kernels.cuda import compositing as native
from ..kernels.cuda import compositing_blocks
from ..kernels.cuda import slots as slots_cuda
from ..kernels.types import LANES
from ..runtime.launch import launch, launch_blocks
from . import cuda_blocks


def forward(
    form: str,
    lists: tuple[Tensor, ...],
    size: tuple[float, ...],
    outputs: tuple[Tensor | None, ...],
    window: tuple[int, int],
) -> None:
    """Composite a window of tiles.

    Args:
        lists: the kernels' tensor arguments up to the sorted list.
        size: width and height in pixels, number of tiles in a row, and sharpness.
        outputs: image, alpha, final transmittance and last contributor.
        window: begin and end of the range of tiles to composite.
    """
    begin, blocks = window[0], window[1] - window[0]
    if form == "cuda":
        cuda_blocks.launch_native(native.composite, blocks, *lists, *size, *outputs, begin=begin)
    else:
        launch_blocks(
            compositing_blocks.composite,
            blocks,
            *(*lists, *size, compositing_blocks.TILE_SIZE, *outputs),
            block_dim=compositing_blocks.BLOCK_DIM,
            begin=begin,
        )


def adjoint(
    form: str,
    lists: tuple[Tensor, ...],
    size: tuple[float, ...],
    absolute: bool,
    v_slots: Tensor,
    window: tuple[int, int],
) -> None:
    """Write the gradients of the pairs in a window of tiles into the pairs' slots.

    The portable form takes over where there are more channels than a slot of the native form holds.

    Args:
        lists: the kernels' tensor arguments up to ``v_alpha``.
        size, window: as in :func:`forward`.
    """
    begin, blocks = window[0], window[1] - window[0]
    if form == "cuda" and lists[3].shape[1] <= native.MAX_CHANNELS:
        cuda_blocks.launch_native(native.composite_adjoint, blocks, *lists, *size, v_slots, begin=begin)
    else:
        launch_blocks(
            compositing_blocks.composite_adjoint,
            blocks,
            *(*lists, *size, compositing_blocks.TILE_SIZE, int(absolute), v_slots),
            block_dim=compositing_blocks.BLOCK_DIM,
            begin=begin,
        )


def sum_slots(
    form: str, offsets: Tensor, v_slots: Tensor, outputs: tuple[Tensor | None, ...], more: bool = False
) -> None:
    """Sum each splat's slots into its gradients.

    Args:
        outputs: gradients to mean, conic, opacity and channels, and the absolute gradient to the mean.
        more: whether to add to the outputs instead of overwriting them.
    """
    count, slots = len(offsets) - 1, (offsets, v_slots, int(more))
    lines = v_slots.shape[1] == slots_cuda.SLOT_WIDTH
    if form == "cpu" and lines:
        launch(cpu_kernels.sum_slots, -(-count // LANES), *slots, *outputs, grain=32)
    elif form == "cuda" and lines:
        launch(slots_cuda.sum_slots, slots_cuda.SLOT_WIDTH * count, *slots, *outputs)
    else:
        launch(compositing.sum_slots, count, *slots, *outputs)
