"""The one place that hands torch tensors to Warp: ``launch`` and ``launch_blocks``.

On a CPU a Warp launch runs its grid in one thread and releases the GIL, so ``launch`` cuts the grid into chunks that
several threads take one by one (``cpu_threads``). A kernel's first argument, ``first``, is the index at which its chunk
begins. On CUDA the whole grid is launched at once, on torch's current stream.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp

from . import environment
from .cpu_kernel import CpuKernel
from .cpu_threads import cut_by_load, cut_evenly, share
from .cuda_graph import warp_stream
from .cuda_launch import RecordedKernel
from .kernel_arguments import warp_arguments
from .kernel_cache import prepared

_cpu_kernels: dict[wp.Kernel, CpuKernel] = {}
_cuda_kernels: dict[tuple[wp.Kernel, int | None, int], RecordedKernel] = {}


def launch(
    kernel: wp.Kernel, count: int, *args, grain: int = 512, load: torch.Tensor | None = None, begin: int = 0
) -> None:
    """Run ``kernel`` for the grid indices begin .. begin + count - 1.

    Args:
        kernel: a Warp kernel whose first argument is ``first: int``.
        count: size of the one-dimensional grid; 0 does nothing.
        args: the kernel's other arguments, in order: contiguous tensors on one device, numbers, Warp values, or None
            for an array that the kernel will not touch.
        grain: smallest number of grid indices in a chunk on a CPU (1 for kernels whose index is a whole tile).
        load: [count] integers on the CPU, ascending: cumulative cost of the indices, each included. If given, chunks
            are cut by cost, and ``grain`` is only the number of indices from which threads share the work.
        begin: the first grid index.

    Raises:
        ValueError: a tensor's dtype, shape, strides or device is not what the kernel declares.
        TypeError: the number or the kind of an argument is wrong.
    """
    if count <= 0:
        return
    for value in args:
        if isinstance(value, torch.Tensor):
            if value.is_cuda:
                _launch_on_cuda(kernel, count, args, value.device, begin=begin)
                return
            break
    cpu = _cpu_kernels.get(kernel)
    if cpu is None:
        cpu = _cpu_kernels[kernel] = prepared(kernel, lambda: CpuKernel(kernel, args))
    threads = min(environment.thread_count(), -(-count // grain))
    if threads > 1:
        chunks = cut_evenly(count, threads, grain) if load is None else cut_by_load(load, threads)
        if share(cpu, cpu.pack(args), chunks, threads, begin):
            return
    cpu(args, begin, count)


def _launch_on_cuda(
    kernel: wp.Kernel,
    dim: int | tuple[int, int],
    args: tuple,
    device: torch.device,
    block_dim: int = 256,
    begin: int = 0,
) -> None:
    """Launch on torch's current stream of ``device``."""
    key = kernel, device.index, block_dim
    ready = _cuda_kernels.get(key)
    if ready is None:
        ready = _cuda_kernels[key] = prepared(kernel, lambda: RecordedKernel(kernel, args, dim, device, block_dim))
    ready.launch(dim, args, warp_stream(device), begin)


def launch_blocks(kernel: wp.Kernel, blocks: int, *args, block_dim: int, begin: int = 0) -> None:
    """Run a block-cooperative kernel (Warp's tile API): ``block, lane = wp.tid()`` of a grid ``(blocks, block_dim)``
    whose first block is ``begin``.

    On a CPU this works only in a process that set ``wp.config.enable_cpu_blocks``.

    Raises:
        RuntimeError: the tensors are on a CPU where Warp would silently run one lane of each block.
    """
    if blocks <= 0:
        return
    device = next((value.device for value in args if isinstance(value, torch.Tensor)), None)
    if device is not None and device.type == "cuda":
        _launch_on_cuda(kernel, (blocks, block_dim), args, device, block_dim, begin)
        return
    if not wp.config.enable_cpu_blocks:
        raise RuntimeError(f"kernel {kernel.key} needs a GPU (or wp.config.enable_cpu_blocks, in a test process)")
    inputs = [begin, *warp_arguments(kernel, args)]
    wp.launch(kernel, dim=(blocks, block_dim), inputs=inputs, device="cpu", block_dim=block_dim)


def warp_view(tensor: torch.Tensor, dtype: Any = None) -> wp.array:
    """Return the tensor as a Warp array over the same memory, for Warp's utilities (radix sort). The tensor must
    outlive it."""
    return wp.from_torch(tensor.detach(), dtype=dtype)
