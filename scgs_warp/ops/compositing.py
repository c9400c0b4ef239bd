"""Compositing: alpha blending of each tile's sorted splats into pixels, and its adjoint."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from ..kernels import compositing as kernels
from ..kernels.cpu import compositing as cpu_kernels
from ..kernels.types import CHANNEL_GROUP, LANES, PACKED_GEOMETRY, SLOT_GEOMETRY, TILE_SIZE
from ..runtime import debug, memory
from ..runtime.launch import launch
from ..types import Splats, Stats, Tiles
from . import checks, compositing_cuda, forms
from .binning import bin_window
from .memory_windows import Demand, Window, slot_bytes
from .shapes import check_shapes

Form = Literal["auto", "plain", "cpu", "cuda", "blocks"]
EMPTY_TILE = 8
"""Cost of reading and writing a tile's pixels on a CPU, as the number of pairs of splat and tile that cost the same."""


@dataclass(frozen=True)
class _Job:
    """Arguments of one call of ``composite`` except its differentiable tensors."""

    splats: Splats
    tiles: Tiles
    stats: Stats | None
    absgrad: Tensor | None
    form: str
    depth_unit: float | None = None


def demand(splats: Splats, channels: Tensor, background: Tensor | None = None) -> Demand:
    """Estimate the memory that :func:`composite` and later uses of its image take, without the lists of splats."""
    count, width = channels.shape
    packed = 4 * _packed_width(width) if channels.device.type == "cpu" else 4
    tensors = (splats.means2d, splats.conics, splats.opacities, channels)
    per_pair = slot_bytes(tensors if background is None else (*tensors, background), _slot_width(width))
    gradients = 4 * (8 + width) if per_pair else 0
    images = image_demand(splats.width, splats.height, width, per_pair > 0)
    return Demand(images + (packed + gradients) * count, per_pair)


def image_demand(width: int, height: int, channels: int, gradients: bool = False) -> int:
    """Estimate the bytes of an image, its alpha, and derived tensors: depth, colours, gradients, a loss's images."""
    planes = 3 * (channels + 1) + 2 if gradients else channels + 3
    return 4 * planes * width * height


def composite(
    splats: Splats,
    channels: Tensor,
    tiles: Tiles,
    background: Tensor | None = None,
    *,
    stats: Stats | None = None,
    absgrad: Tensor | None = None,
    depth_unit: float | None = None,
    form: Form = "auto",
) -> tuple[Tensor, Tensor]:
    """Blend the splats of each pixel front to back: sum_i channels_i alpha_i T_i + T background.

    This is equation 3 of 3D Gaussian Splatting (Kerbl et al. 2023) with gsplat 1.5.3's thresholds: alpha is clamped to
    0.999 (a clamped alpha passes no gradient), a splat is skipped where its alpha is under 1/255, and a pixel ends
    before the splat that would leave a transmittance of 1e-4 or less. A splat with a channel that is non-finite or
    beyond 1e18 is left out.

    Gradients reach ``splats.means2d``, ``conics`` and ``opacities``, ``channels`` and ``background``. A gradient of the
    geometry that overflows becomes 0.

    Args:
        splats: N projected Gaussians; ``depths`` is not read.
        channels: [N, C] values to blend: colours, depths, anything.
        tiles: result of ``bin_splats(splats)``. If it is cut into windows, they are listed and drawn one after the
            other, in the backward pass as well. Results are bit-identical, with one window's lists in memory.
        background: [C] values behind all splats. None: zeros, which also replace non-finite values.
        stats: statistics to which the backward pass adds. None: they are not collected.
        absgrad: [N, 2] buffer that the backward pass overwrites with the sum over pixels of the absolute gradients of
            ``means2d``.
        depth_unit: if given, the last channel is depth, and the last channel of the image is the expected depth: the
            blended depth divided by alpha (at least 1e-10) and by this unit. Only without gradients.
        form: kernels to run; ``auto`` takes the fastest for the device. ``plain`` is the readable reference on any
            device, ``blocks`` the portable sibling of ``cuda``.

    Returns:
        image [C, H, W] on the background, alpha [H, W] in [0, 1).

    Raises:
        ValueError: a shape, the form or the unit is wrong.
    """
    _validate(splats, channels, tiles, background, stats, absgrad)
    if depth_unit is not None and not 0.0 < depth_unit < math.inf:
        raise ValueError(f"depth_unit must be positive and finite, got {depth_unit}")
    if background is None:
        background = channels.new_zeros(channels.shape[1])
    else:
        background = background.nan_to_num(0.0, 0.0, 0.0)
    job = _Job(splats, tiles, stats, absgrad, _form(form, channels.device, tiles.tile_size), depth_unit)
    tensors: tuple[Tensor, ...] = (splats.means2d, splats.conics, splats.opacities, channels, background)
    if torch.is_grad_enabled() and any(t.requires_grad for t in tensors):
        if depth_unit is not None:
            raise ValueError("depth_unit is for images without gradients")
        if not tiles.windows and len(tiles.slots) != len(tiles.splats):
            raise ValueError("tiles.slots is empty: these tiles were made for an image without gradients")
        return _Composite.apply(*tensors, job)  # type: ignore[return-value]
    image, alpha, *_ = _forward(job, tuple(t.detach().contiguous() for t in tensors), keep=False)
    return image, alpha


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, Tensor]:
        *tensors, job = args
        tensors = tuple(t.detach().contiguous() for t in tensors)
        image, alpha, *kept = _forward(job, tensors, keep=True)
        ctx.save_for_backward(*tensors, *kept)
        ctx.job = job
        ctx.set_materialize_grads(False)
        return image, alpha

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_image: Any, v_alpha: Tensor | None) -> tuple[Tensor | None, ...]:
        *tensors, source, transmittance, last = ctx.saved_tensors
        job: _Job = ctx.job
        no_image = (tensors[3].shape[1], *transmittance.shape)
        v_image = transmittance.new_zeros(no_image) if v_image is None else v_image.contiguous()
        if v_alpha is not None:
            v_alpha = v_alpha.contiguous()
        elif job.form != "cpu":
            v_alpha = torch.zeros_like(transmittance)
        absolute = job.absgrad is not None or (job.stats is not None and job.stats.absolute)
        v_means2d, v_conics, v_opacities, v_channels = (torch.empty_like(t) for t in tensors[:4])
        absgrad = job.absgrad
        if absolute and absgrad is None:
            absgrad = torch.empty_like(v_means2d)
        count = len(v_means2d)
        outputs = (v_means2d, v_conics, v_opacities, v_channels, absgrad)
        lists = (transmittance, last, v_image, v_alpha)
        for number, (tiles, window) in enumerate(_pieces(job)):
            v_slots = _adjoint(job, tiles, window, tensors, source, lists, absolute)
            compositing_cuda.sum_slots(job.form, tiles.offsets, v_slots, outputs, more=number > 0)
            del tiles, v_slots  # frees their memory before the next window
        if debug.enabled():
            checks.check_gradients(outputs, v_image, v_alpha)
        if job.stats is not None:
            norm_of = absgrad if job.stats.absolute else v_means2d
            stats, size = job.stats, (job.tiles.width, job.tiles.height)
            radii = job.splats.radii.contiguous()
            gate = stats.outcome, int(stats.outcome is not None)
            launch(kernels.add_stats, count, norm_of, radii, *size, *gate, *stats.sums)
        v_background = _background_gradient(v_image, transmittance) if ctx.needs_input_grad[4] else None
        return v_means2d, v_conics, v_opacities, v_channels, v_background, None


def _form(form: Form, device: torch.device, tile_size: int) -> str:
    """Return the form to run; only ``plain`` takes tiles of other sizes than ``TILE_SIZE``."""
    if form == "auto" and tile_size != TILE_SIZE:
        return "plain"
    form = forms.chosen_form(form, device, Form)
    if form != "plain" and tile_size != TILE_SIZE:
        raise ValueError(f"form {form} needs tiles of {TILE_SIZE} pixels, got tile_size {tile_size}")
    return form


def _pieces(job: _Job) -> Iterator[tuple[Tiles, Window]]:
    """Yield (lists, range of tiles) of the whole image, or of each window in turn.

    The caller must drop a pair before asking for the next, so that only one window's lists are in memory.
    """
    if not job.tiles.windows:
        yield job.tiles, (0, len(job.tiles.ranges))
        return
    for window in job.tiles.windows:
        yield bin_window(job.splats, job.tiles, window), window
        memory.hand_back(str(job.splats.means2d.device))


def _forward(job: _Job, tensors: tuple[Tensor, ...], keep: bool) -> tuple[Any, ...]:
    """Return image and alpha, followed by three values for the adjoint, which are None unless ``keep``: the form's
    representation of the splats, the final transmittance, and the last contributor."""
    means2d, conics, opacities, channels, background = tensors
    device, count = channels.device, channels.shape[1]
    image = torch.empty(count, job.tiles.height, job.tiles.width, device=device)
    alpha = torch.empty(job.tiles.height, job.tiles.width, device=device)
    checked = debug.enabled()
    transmittance = torch.empty_like(alpha) if keep or checked else None
    last = torch.empty(alpha.shape, dtype=torch.int32, device=device) if keep or checked else None
    outputs = (image, alpha, transmittance, last)
    if job.form == "cpu":
        source = _pack(means2d, conics, opacities, channels, job.splats.sharpness)
    else:
        source = torch.empty_like(opacities)  # opacities, with 0 for splats that are left out
        launch(kernels.finite_opacities, len(opacities), opacities, channels, source)
    for tiles, window in _pieces(job):
        _draw(job, tiles, window, tensors, source, outputs)
        if transmittance is not None and last is not None and checked:
            checks.check_pixels(tiles, window, alpha, transmittance, last)
        del tiles  # frees its memory before the next window
    if checked:
        # The expected depth of a pixel that hardly anything covers may overflow.
        colors = image if job.depth_unit is None else image[:-1]
        checks.check_image(colors, channels, background)
    if job.depth_unit is not None and job.form != "cpu":
        depth = image[-1].view(-1)
        launch(kernels.expected_depth, len(depth), depth, alpha.view(-1), job.depth_unit, depth)
    return image, alpha, *((source, transmittance, last) if keep else (None, None, None))


def _draw(
    job: _Job,
    tiles: Tiles,
    window: Window,
    tensors: tuple[Tensor, ...],
    source: Tensor,
    outputs: tuple[Tensor | None, ...],
) -> None:
    """Composite the pixels of a window of tiles."""
    means2d, conics, _, channels, background = tensors
    size = tiles.width, tiles.height, tiles.columns, job.splats.sharpness
    form, begin, count = job.form, window[0], window[1] - window[0]
    if form == "cpu":
        lists, load = (source, background, tiles.ranges, tiles.splats), _load(tiles, window)
        unit = job.depth_unit or 0.0
        launch(cpu_kernels.composite, count, *lists, *size, unit, *outputs, grain=1, load=load, begin=begin)
        return
    lists = (means2d, conics, source, channels, background, tiles.ranges, tiles.splats)
    if form != "plain":
        compositing_cuda.forward(form, lists, size, outputs, window)
        return
    for first, pixels in _pixels(tiles, window):
        arguments = (*lists, *size, tiles.tile_size, *outputs)
        launch(kernels.composite, pixels, *arguments, grain=256, begin=first)


def _pixels(tiles: Tiles, window: Window) -> list[tuple[int, int]]:
    """Return the first pixel and the number of pixels of each contiguous run (row major) that a window covers."""
    (top, left), (bottom, right) = divmod(window[0], tiles.columns), divmod(window[1], tiles.columns)
    side, width = tiles.tile_size, tiles.width
    y_begin = top * side
    if left == right == 0:
        return [(y_begin * width, (min(bottom * side, tiles.height) - y_begin) * width)]
    x_begin = left * side
    x_end = min((right or tiles.columns) * side, width)
    return [(y * width + x_begin, x_end - x_begin) for y in range(y_begin, min(y_begin + side, tiles.height))]


def _load(tiles: Tiles, window: Window) -> Tensor:
    """Return the cumulative cost on a CPU of the window's tiles, [T], in pairs."""
    ends = tiles.ranges[window[0] : window[1], 1]
    return ends + _empty_tiles(len(ends))


@functools.lru_cache(maxsize=4)
def _empty_tiles(count: int) -> Tensor:
    """Return the cumulative cost of ``count`` empty tiles, [count]."""
    with torch.inference_mode(False):
        return torch.arange(EMPTY_TILE, (count + 1) * EMPTY_TILE, EMPTY_TILE)


def _packed_width(channels: int) -> int:
    """Return the number of columns of a packed splat: whole groups of channels, one cache line for up to 4 channels."""
    if channels <= 4:
        return LANES
    return -(-(PACKED_GEOMETRY + -(-channels // CHANNEL_GROUP) * CHANNEL_GROUP) // 8) * 8


def _slot_width(channels: int) -> int:
    """Return the number of columns of a gradient slot, which is one cache line for up to 8 channels."""
    return max(kernels.SLOT_WIDTH, SLOT_GEOMETRY + channels)


def _pack(means2d: Tensor, conics: Tensor, opacities: Tensor, channels: Tensor, sharpness: float) -> Tensor:
    packed = torch.empty(len(means2d), _packed_width(channels.shape[1]))
    splats = means2d, conics, opacities, channels, sharpness
    launch(cpu_kernels.pack_splats, -(-len(means2d) // LANES), *splats, packed, grain=32)
    return packed


def _adjoint(
    job: _Job,
    tiles: Tiles,
    window: Window,
    tensors: list[Tensor],
    source: Tensor,
    pixels: tuple[Any, ...],
    absolute: bool,
) -> Tensor:
    """Return the gradient slots of all listed pairs, [P, S]. ``pixels``: final transmittance, last contributor, and the
    gradients of image and alpha; the last may be None on a CPU, which means zeros."""
    means2d, conics, _, channels, background = tensors
    v_slots = checks.unwritten_slots(len(tiles.splats), _slot_width(channels.shape[1]), channels.device)
    lists = (background, tiles.ranges, tiles.splats, tiles.slots, *pixels)
    size = tiles.width, tiles.height, tiles.columns, job.splats.sharpness
    begin, count = window[0], window[1] - window[0]
    if job.form == "cpu":
        rest, load = (*size, int(absolute), v_slots), _load(tiles, window)
        launch(cpu_kernels.composite_adjoint, count, source, *lists, *rest, grain=1, load=load, begin=begin)
    elif job.form == "plain":
        rest = (*size, tiles.tile_size, int(absolute), v_slots)
        lists = (means2d, conics, source, channels, *lists)
        launch(kernels.composite_adjoint, count, *lists, *rest, grain=1, begin=begin)
    else:
        lists = (means2d, conics, source, channels, *lists)
        compositing_cuda.adjoint(job.form, lists, size, absolute, v_slots, window)
    if debug.enabled():
        checks.check_slots(tiles, v_slots)
    return v_slots


def _background_gradient(v_image: Tensor, transmittance: Tensor) -> Tensor:
    """Return the background's gradient: the sum over pixels of v_image times transmittance, [C], in fixed order."""
    channels, height, _ = v_image.shape
    rows = v_image.new_empty(height, channels)
    launch(kernels.background_rows, height, v_image, transmittance, rows, grain=16)
    total = v_image.new_empty(channels)
    launch(kernels.sum_rows, channels, rows, total)
    return total


def _validate(
    splats: Splats,
    channels: Tensor,
    tiles: Tiles,
    background: Tensor | None,
    stats: Stats | None,
    absgrad: Tensor | None,
) -> None:
    count = len(splats.means2d)
    expected: dict[str, tuple[Tensor | None, tuple[int, ...]]] = {
        "means2d": (splats.means2d, (count, 2)),
        "conics": (splats.conics, (count, 3)),
        "opacities": (splats.opacities, (count,)),
        "absgrad": (absgrad, (count, 2)),
        "tiles.offsets": (None if tiles.windows or not len(tiles.offsets) else tiles.offsets, (count + 1,)),
    }
    if channels.ndim != 2 or len(channels) != count or channels.shape[1] < 1:
        raise ValueError(f"channels must be [{count}, C] with C >= 1, got {list(channels.shape)}")
    expected["background"] = background, (channels.shape[1],)
    if stats is not None:
        expected["radii"] = splats.radii, (count, 2)
        expected.update({f"stats.{n}": (getattr(stats, n), (count,)) for n in ("grad_norm", "count", "max_radii")})
    check_shapes(expected)
    if (splats.width, splats.height) != (tiles.width, tiles.height):
        raise ValueError(
            f"tiles are of a {tiles.width} x {tiles.height} image, splats of {splats.width} x {splats.height}"
        )
