"""Least times of stages: bytes and flops that a stage needs, over the machine's best rates.

The models count what the mathematics needs, with each input read once and each output written once. They are lower
bounds, not predictions: sorting, searching a tile for pixels and rounding up to vectors come on top.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import nn

from ..kernels.cpu import roofline as kernels
from ..kernels.types import LANES, ROOFLINE_BLOCK, ROOFLINE_CHAINS
from ..motion import ControlPoints
from ..runtime import environment
from ..runtime.launch import launch
from ..scene.scene import Scene
from .memory import hand_back
from .scenes import Load

TURNS = 10
CHUNKS = 64
ROUNDS = 40_000
"""Rounds of multiply-adds in a chunk, which takes well under a millisecond but far longer than handing it to a
thread."""
BLOCKS = 256
"""MiB to copy, more than any cache holds."""
FLOAT = 4
GEOMETRY = 12 + 16 + 12 + 4
"""Bytes of a Gaussian's mean, quaternion, scales and opacity."""
SPLAT = 8 + 12 + 4 + 4 + 8
"""Bytes of a splat: mean, conic, depth, opacity, radii."""
PROJECT_FLOPS = 170
"""Flops to project a Gaussian: view transform 18, rotation 36, its product with scales and view 63, Jacobian 30,
covariance and inverse 23."""
HARMONIC_FLOPS = 80
"""Flops for the direction and the basis of degree 3."""
BLEND_FLOPS = 28
"""Flops of a splat at a pixel, without channels: quadratic form 10, exponential 13, opacity and thresholds 3,
transmittance 2."""
ADJOINT_FLOPS = 70
"""Flops of a splat at a pixel in the adjoint: forward values (28), and gradients of alpha, power, mean, conic and
opacity."""


class Limits(NamedTuple):
    """Best rates of the machine on a number of threads."""

    threads: int
    gigabytes: float
    """Bandwidth of copying in GB/s; bytes read and bytes written both count."""
    gigaflops: float
    """Arithmetic in single precision in Gflop/s; a multiply-add counts as two."""

    def milliseconds(self, work: Work) -> float:
        """Return the least time for ``work`` if memory traffic and arithmetic overlap."""
        return 1e3 * max(work.bytes / (1e9 * self.gigabytes), work.flops / (1e9 * self.gigaflops))


class Work(NamedTuple):
    """Least work of a stage."""

    bytes: float
    flops: float


def _best(function: Callable[[], None]) -> float:
    times = []
    for _ in range(TURNS + 1):
        began = time.perf_counter()
        function()
        times.append(time.perf_counter() - began)
    return min(times[1:])


def measure_limits(threads: int, blocks: int | None = None) -> Limits:
    """Measure bandwidth and arithmetic on ``threads`` threads; the best of several turns counts."""
    before = environment.thread_count()
    environment.configure(threads)
    values = torch.empty(CHUNKS)
    computing = _best(lambda: launch(kernels.multiply_add, CHUNKS, ROUNDS, values, grain=1))
    blocks = BLOCKS if blocks is None else blocks
    moving = _copying(blocks)
    hand_back()  # These buffers must not count in a row's memory.
    environment.configure(before)
    flops = 2.0 * CHUNKS * ROUNDS * ROOFLINE_CHAINS * LANES
    return Limits(threads, 2 * FLOAT * blocks * ROOFLINE_BLOCK / moving / 1e9, flops / computing / 1e9)


def _copying(blocks: int) -> float:
    """Return the seconds for copying ``blocks`` blocks."""
    source, target = torch.ones(blocks * ROOFLINE_BLOCK), torch.zeros(blocks * ROOFLINE_BLOCK)
    return _best(lambda: launch(kernels.copy, blocks, source, target, grain=1))


def _network(layers: list[nn.Linear], rows: int) -> Work:
    """Count the work of a network: a multiply-add per weight and row, weights moved once, every layer's input and
    output moved once."""
    weights = sum(layer.weight.numel() + layer.out_features for layer in layers)
    activations = sum(layer.in_features + layer.out_features for layer in layers)
    products = sum(layer.weight.numel() for layer in layers)
    return Work(FLOAT * (weights + rows * activations), 2.0 * rows * products)


def frame_work(scene: Scene, load: Load, width: int, height: int) -> dict[str, Work]:
    """Count the work of each stage of a frame with colour, depth and harmonics of degree 3; neighbours and weights are
    cached."""
    count = scene.gaussian_count
    work = {}
    if scene.motion.moves:
        layers = [layer for layer in scene.motion.modules() if isinstance(layer, nn.Linear)]
        sparse = isinstance(scene.motion, ControlPoints)
        work["network"] = _network(layers, scene.control_point_count if sparse else count)
        if sparse:
            neighbors = scene.config.motion.neighbors
            # Mean and quaternion go in and out, index and weight of each neighbour go in. For each neighbour a 3 x 4
            # matrix and a quaternion are added up; the sums are applied, multiplied and normalised.
            # Shading, tints and correctives read their own numbers; the colour goes in and out.
            learnt = scene.gaussians.shading.shape[1] + scene.gaussians.correctives.shape[1]
            colors = 24 if scene.gaussians.shading.shape[1] or scene.config.motion.has_tints else 0
            work["skin"] = Work(
                count * (2 * (12 + 16) + 8 * neighbors + FLOAT * learnt + colors),
                count * (32.0 * neighbors + 56 + 2.0 * learnt),
            )
    return {**work, **draw_work(count, load, width, height, 4)}


def draw_work(count: int, load: Load, width: int, height: int, channels: int) -> dict[str, Work]:
    """Count the work of projection, harmonics, binning and compositing of one image."""
    blended = load.contributors * load.covered
    coefficients = 48
    image = FLOAT * width * height * (channels + 1)
    return {
        "project": Work(count * (GEOMETRY + SPLAT), count * PROJECT_FLOPS),
        "harmonics": Work(count * FLOAT * (coefficients + 3 + 3), count * (HARMONIC_FLOPS + 2.0 * coefficients)),
        # Splats are read, an order of depth is written; pairs are written with their slot and read once for sorting.
        "bin": Work(count * (SPLAT + 8) + load.pairs * 12, 0.0),
        "composite": Work(load.pairs * (4 + 24 + FLOAT * channels) + image, blended * (BLEND_FLOPS + 2.0 * channels)),
    }


def backward_work(count: int, load: Load, width: int, height: int) -> Work:
    """Count the work of the adjoint from a three-channel image to all parameters; gradients of pairs are written and
    read once."""
    channels, coefficients = 3, 48
    blended = load.contributors * load.covered
    pair = 4 + 24 + FLOAT * channels + 2 * FLOAT * (2 + 3 + 1 + channels)
    projection = 2 * GEOMETRY + 2 * SPLAT
    harmonics = FLOAT * (2 * coefficients + 3 + 3 + 3)
    image = 2 * FLOAT * width * height * (channels + 1)
    moved = load.pairs * pair + count * (projection + harmonics) + image
    per_gaussian = 2.0 * PROJECT_FLOPS + HARMONIC_FLOPS + 4.0 * coefficients
    return Work(moved, blended * (ADJOINT_FLOPS + 4.0 * channels) + count * per_gaussian)
