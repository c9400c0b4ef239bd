"""Tiles to pixels: alpha compositing of sorted splats, and its adjoint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from ..kernels import compositing as kernels
from ..kernels import compositing_cpu as cpu_kernels
from ..kernels.types import SLOT_GEOMETRY
from ..types import Splats, Stats, Tiles
from ..warp_interop import launch
from . import compositing_cuda

Form = Literal["auto", "pixel", "cpu", "cuda", "blocks"]


EMPTY_TILE = 8
"""What reading and writing a tile's pixels costs on a CPU, in pairs of splat and tile."""


@dataclass(frozen=True)
class _Job:
    """What one call of ``composite`` holds beside its differentiable tensors."""

    splats: Splats
    tiles: Tiles
    stats: Stats | None
    absgrad: Tensor | None
    form: str


def composite(
    splats: Splats,
    channels: Tensor,
    tiles: Tiles,
    background: Tensor | None = None,
    *,
    stats: Stats | None = None,
    absgrad: Tensor | None = None,
    form: Form = "auto",
) -> tuple[Tensor, Tensor]:
    """Blend the splats of each pixel front to back: sum_i channels_i alpha_i T_i + T background.

    3D Gaussian Splatting (Kerbl et al. 2023), equation 3, with gsplat 1.5.3's thresholds: alpha is at most 0.999 (and
    passes no gradient there), is skipped under 1/255, and a pixel ends for good before the splat that would leave a
    transmittance of 1e-4 or less. A splat with a channel that is not finite, or beyond 1e18, is left out.

    Gradients go to ``splats.means2d``, ``conics`` and ``opacities``, to ``channels`` and to ``background``. One to the
    geometry that overflows counts as none.

    Args:
        splats: N projected Gaussians; ``depths`` is not read.
        channels: [N, C] what is blended: colours, depths, anything.
        tiles: of ``bin_splats(splats)``.
        background: [C] what shines through. None: zeros, as what is not finite.
        stats: if given, the backward pass adds to it what ``Stats`` says.
        absgrad: [N, 2] buffer that the backward pass overwrites with the sum over pixels of the absolute gradients of
            ``means2d``.
        form: which of the kernels runs; ``auto`` takes the fastest for the device. ``pixel`` is the readable
            reference on any device, ``blocks`` the portable sibling of ``cuda``.

    Returns:
        image [C, H, W] on the background, alpha [H, W] in [0, 1).

    Raises:
        ValueError: a shape or the form does not fit.
    """
    _validate(splats, channels, tiles, background, stats, absgrad)
    if background is None:
        background = channels.new_zeros(channels.shape[1])
    else:
        background = background.nan_to_num(0.0, 0.0, 0.0)
    job = _Job(splats, tiles, stats, absgrad, _resolve_form(form, channels.device, tiles.tile_size))
    tensors: tuple[Tensor, ...] = (splats.means2d, splats.conics, splats.opacities, channels, background)
    if torch.is_grad_enabled() and any(t.requires_grad for t in tensors):
        if len(tiles.slots) != len(tiles.splats):
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
        return image, alpha

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_image: Tensor, v_alpha: Tensor) -> tuple[Tensor | None, ...]:
        *tensors, source, transmittance, last = ctx.saved_tensors
        v_image, v_alpha = v_image.contiguous(), v_alpha.contiguous()
        job: _Job = ctx.job
        absolute = job.absgrad is not None or (job.stats is not None and job.stats.absolute)
        v_slots = _adjoint(job, tensors, source, transmittance, last, v_image, v_alpha, absolute)
        v_means2d, v_conics, v_opacities, v_channels = (torch.empty_like(t) for t in tensors[:4])
        absgrad = job.absgrad
        if absolute and absgrad is None:
            absgrad = torch.empty_like(v_means2d)
        count = len(v_means2d)
        outputs = (v_means2d, v_conics, v_opacities, v_channels, absgrad)
        compositing_cuda.sum_slots(job.form, job.tiles.offsets, v_slots, outputs)
        if job.stats is not None:
            norm_of = absgrad if job.stats.absolute else v_means2d
            stats, size = job.stats, (job.tiles.width, job.tiles.height)
            radii = job.splats.radii.contiguous()
            launch(kernels.add_stats, count, norm_of, radii, *size, stats.grad_norm, stats.count, stats.max_radii)
        v_background = _background_gradient(v_image, transmittance) if ctx.needs_input_grad[4] else None
        return v_means2d, v_conics, v_opacities, v_channels, v_background, None


def _resolve_form(form: str, device: torch.device, tile_size: int) -> str:
    if form not in ("auto", "pixel", "cpu", "cuda", "blocks"):
        raise ValueError(f"form must be auto, pixel, cpu, cuda or blocks, got {form!r}")
    if form == "auto":
        form = "cuda" if device.type == "cuda" else "cpu"
        return form if tile_size == cpu_kernels.TILE_SIDE else "pixel"
    if form != "pixel" and tile_size != cpu_kernels.TILE_SIDE:
        raise ValueError(f"form {form} needs tiles of {cpu_kernels.TILE_SIDE} pixels, got tile_size {tile_size}")
    if form == "cpu" and device.type != "cpu":
        raise ValueError(f"form cpu needs tensors on the CPU, got {device}")
    return form


def _forward(job: _Job, tensors: tuple[Tensor, ...], keep: bool) -> tuple[Any, ...]:
    """Image, alpha, and for the adjoint (None unless ``keep``): the form's view of the splats, final transmittance
    and last contributor."""
    means2d, conics, opacities, channels, background = tensors
    tiles = job.tiles
    size = (tiles.width, tiles.height, tiles.columns)
    device, count = channels.device, channels.shape[1]
    image = torch.empty(count, tiles.height, tiles.width, device=device)
    alpha = torch.empty(tiles.height, tiles.width, device=device)
    transmittance = torch.empty_like(alpha) if keep else None
    last = torch.empty(alpha.shape, dtype=torch.int32, device=device) if keep else None
    outputs = (image, alpha, transmittance, last)
    if job.form == "cpu":
        source = _pack(means2d, conics, opacities, channels)
        lists = (background, tiles.ranges, tiles.splats)
        launch(
            cpu_kernels.composite_tiles, len(tiles.ranges), source, *lists, *size, *outputs, grain=1, load=_load(tiles)
        )
    else:
        source = torch.empty_like(opacities)  # opacities of the splats that may be added
        launch(kernels.finite_opacities, len(opacities), opacities, channels, source)
        lists = (means2d, conics, source, channels, background, tiles.ranges, tiles.splats)
        if job.form == "pixel":
            launch(kernels.composite_pixels, alpha.numel(), *lists, *size, tiles.tile_size, *outputs, grain=256)
        else:
            compositing_cuda.forward(job.form, lists, size, outputs)
    return image, alpha, *((source, transmittance, last) if keep else (None, None, None))


def _load(tiles: Tiles) -> Tensor:
    """[T] what the tiles up to each cost on a CPU, in pairs."""
    return tiles.ranges[:, 1] + torch.arange(EMPTY_TILE, (len(tiles.ranges) + 1) * EMPTY_TILE, EMPTY_TILE)


def _pack(means2d: Tensor, conics: Tensor, opacities: Tensor, channels: Tensor) -> Tensor:
    group = cpu_kernels.CHANNEL_GROUP
    width = cpu_kernels.PACKED_GEOMETRY + -(-channels.shape[1] // group) * group
    packed = torch.empty(len(means2d), width)
    launch(cpu_kernels.pack_splats, len(means2d), means2d, conics, opacities, channels, packed)
    return packed


def _adjoint(
    job: _Job,
    tensors: list[Tensor],
    source: Tensor,
    transmittance: Tensor,
    last: Tensor,
    v_image: Tensor,
    v_alpha: Tensor,
    absolute: bool,
) -> Tensor:
    """[P, S] gradient of every pair, in its slot."""
    means2d, conics, _, channels, background = tensors
    tiles = job.tiles
    # A slot of up to 8 channels is one cache line.
    v_slots = torch.empty(
        len(tiles.splats), max(kernels.SLOT_WIDTH, SLOT_GEOMETRY + channels.shape[1]), device=channels.device
    )
    lists = (background, tiles.ranges, tiles.splats, tiles.slots, transmittance, last, v_image, v_alpha)
    size = (tiles.width, tiles.height, tiles.columns)
    count = len(tiles.ranges)
    if job.form == "cpu":
        rest = (*size, int(absolute), v_slots)
        launch(cpu_kernels.composite_tiles_adjoint, count, source, *lists, *rest, grain=1, load=_load(tiles))
        return v_slots
    lists = (means2d, conics, source, channels, *lists)
    if job.form == "pixel":
        rest = (*size, tiles.tile_size, int(absolute), v_slots)
        launch(kernels.composite_pixels_adjoint, count, *lists, *rest, grain=1)
    else:
        compositing_cuda.adjoint(job.form, lists, size, absolute, v_slots)
    return v_slots


def _background_gradient(v_image: Tensor, transmittance: Tensor) -> Tensor:
    """[C] sum over pixels of v_image times transmittance, in a fixed order."""
    channels, height, _ = v_image.shape
    rows = torch.empty(height, channels, device=v_image.device)
    launch(kernels.background_rows, height, v_image, transmittance, rows, grain=16)
    total = torch.empty(channels, device=v_image.device)
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
    expected: list[tuple[str, Tensor | None, tuple[int, ...]]] = [
        ("means2d", splats.means2d, (count, 2)),
        ("conics", splats.conics, (count, 3)),
        ("opacities", splats.opacities, (count,)),
        ("absgrad", absgrad, (count, 2)),
        ("tiles.offsets", tiles.offsets, (count + 1,)),
    ]
    if channels.ndim != 2 or len(channels) != count or channels.shape[1] < 1:
        raise ValueError(f"channels must be [{count}, C] with C >= 1, got {list(channels.shape)}")
    expected.append(("background", background, (channels.shape[1],)))
    if stats is not None:
        expected.append(("radii", splats.radii, (count, 2)))
        expected += [(f"stats.{n}", getattr(stats, n), (count,)) for n in ("grad_norm", "count", "max_radii")]
    for name, tensor, shape in expected:
        if tensor is not None and tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must be {list(shape)}, got {list(tensor.shape)}")
    if (splats.width, splats.height) != (tiles.width, tiles.height):
        raise ValueError(
            f"tiles are of a {tiles.width} x {tiles.height} image, splats of {splats.width} x {splats.height}"
        )
