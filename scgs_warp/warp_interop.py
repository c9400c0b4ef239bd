"""The one place that hands torch tensors to Warp: ``launch`` and ``launch_blocks``.

On a CPU a Warp launch runs its grid in one thread and releases the GIL, so ``launch`` cuts the grid into chunks and
lets a small pool of threads take them one by one. Kernels find their place through their first argument, ``first``.
On CUDA a launch goes to torch's current stream, whole.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import torch
import warp as wp

from . import environment
from .cuda_graph import on_torch_stream

wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)


def _init_quietly() -> None:
    """Warp reports a missing CUDA driver on the C level's stderr; on a laptop without a GPU that is no news."""
    if os.path.exists("/dev/nvidiactl") or os.name != "posix":
        wp.init()
        return
    saved, sink = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        wp.init()
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(sink)


_init_quietly()

_descriptor_type: Any = type(wp.from_torch(torch.zeros(1), return_ctype=True))
"""Warp's C array descriptor (data, grad, shape, strides), which has no public name."""

CHUNKS_PER_THREAD = 8
"""Chunks a thread, so that a few heavy ones (tiles full of splats) still balance."""

_TORCH_DTYPES = {
    wp.float32: torch.float32,
    wp.float64: torch.float64,
    wp.int32: torch.int32,
    wp.int64: torch.int64,
    wp.uint8: torch.uint8,
    wp.bool: torch.bool,
}


class _ArrayParameter(NamedTuple):
    """What an array parameter of a kernel expects of a tensor."""

    label: str
    dtype: torch.dtype
    inner: tuple[int, ...]  # shape of one element: (3,) for vec3
    ndim: int  # dimensions without the inner ones
    element_size: int


class _Cpu(NamedTuple):
    """A kernel made ready for the CPU: its compiled entry and the ctypes structure of its arguments."""

    command: Any  # a wp.Launch; keeps the module loaded
    arguments: type[ctypes.Structure]
    bounds: type[ctypes.Structure]


_pool: ThreadPoolExecutor | None = None
_pool_state = (0, False)
_parameters: dict[wp.Kernel, list[_ArrayParameter | None]] = {}
_cpu_kernels: dict[wp.Kernel, _Cpu] = {}


def _describe_parameters(kernel: wp.Kernel) -> list[_ArrayParameter | None]:
    found: list[_ArrayParameter | None] = []
    for argument in kernel.adj.args[1:]:
        if not wp.types.is_array(argument.type):
            found.append(None)
            continue
        dtype = argument.type.dtype
        scalar = getattr(dtype, "_wp_scalar_type_", dtype)
        scalar = {float: wp.float32, int: wp.int32, bool: wp.bool}.get(scalar, scalar)
        inner = tuple(getattr(dtype, "_shape_", ()))
        size = wp.types.type_size_in_bytes(dtype)
        found.append(_ArrayParameter(argument.label, _TORCH_DTYPES[scalar], inner, argument.type.ndim, size))
    return found


def _array(kernel: wp.Kernel, parameter: _ArrayParameter, tensor: torch.Tensor) -> Any:
    """Warp's descriptor of a contiguous tensor; wrong dtype, shape or strides raise with the argument's name."""
    shape = tuple(tensor.shape)
    outer = shape[: len(shape) - len(parameter.inner)]
    if (
        tensor.dtype != parameter.dtype
        or len(outer) != parameter.ndim
        or shape[len(outer) :] != parameter.inner
        or not tensor.is_contiguous()
    ):
        expected = f"contiguous {parameter.dtype} with {parameter.ndim} dimensions of {parameter.inner or 'scalars'}"
        raise ValueError(
            f"kernel {kernel.key}: {parameter.label} must be {expected}, "
            f"got {tensor.dtype} {shape}, strides {tensor.stride()}"
        )
    strides, step = [], parameter.element_size
    for extent in reversed(outer):
        strides.append(step)
        step *= extent
    return _descriptor_type(tensor.data_ptr(), 0, len(outer), outer, strides[::-1])


def _pack(kernel: wp.Kernel, args: tuple) -> tuple[list, torch.device | None]:
    """Torch tensors to Warp array descriptors of the kernel's types; everything else as it is."""
    parameters = _parameters.get(kernel)
    if parameters is None:
        parameters = _parameters[kernel] = _describe_parameters(kernel)
    if len(parameters) != len(args):
        raise TypeError(f"kernel {kernel.key} takes {len(parameters)} arguments after 'first', got {len(args)}")
    packed, device = [], None
    for parameter, value in zip(parameters, args):
        if isinstance(value, torch.Tensor):
            if parameter is None:
                raise TypeError(f"kernel {kernel.key}: a tensor was given for a parameter that is no array")
            if device is None:
                device = value.device
            elif device != value.device:
                raise ValueError(f"kernel {kernel.key}: {parameter.label} is on {value.device}, others on {device}")
            value = _array(kernel, parameter, value)
        packed.append(value)
    return packed, device


def _prepare_cpu(kernel: wp.Kernel, packed: list) -> _Cpu:
    command: Any = wp.launch(kernel, dim=1, inputs=[0, *packed], device="cpu", record_cmd=True)
    fields = [(argument.label, type(value)) for argument, value in zip(kernel.adj.args, command.params[1:])]
    arguments = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
    return _Cpu(command, arguments, type(command.params[0]))


def _cpu_arguments(kernel: wp.Kernel, cpu: _Cpu, packed: list) -> ctypes.Structure:
    arguments = cpu.arguments()
    fields: Any = cpu.arguments._fields_[1:]
    for (label, ctype), value in zip(fields, packed):
        if value is None:
            continue  # a null array
        if type(value) is not ctype:
            value = value.__ctype__() if hasattr(value, "__ctype__") else ctype(value)
        setattr(arguments, label, value)
    return arguments


def launch(kernel: wp.Kernel, count: int, *args, grain: int = 512) -> None:
    """Run ``kernel`` for the grid indices 0 .. count - 1.

    Args:
        kernel: a Warp kernel whose first argument is ``first: int``.
        count: size of the one-dimensional grid; 0 does nothing.
        args: the kernel's other arguments, in order: contiguous tensors on one device, numbers, Warp values, or None
            for an array that the kernel will not touch.
        grain: fewest grid indices worth a chunk of their own on a CPU (1 for kernels whose index is a whole tile).

    Raises:
        ValueError: a tensor's dtype, shape, strides or device is not what the kernel declares.
    """
    if count <= 0:
        return
    packed, device = _pack(kernel, args)
    if device is not None and device.type == "cuda":
        with _torch_stream(device):
            wp.launch(kernel, dim=count, inputs=[0, *packed], device=wp.device_from_torch(device))
        return
    cpu = _cpu_kernels.get(kernel)
    if cpu is None:
        cpu = _cpu_kernels[kernel] = _prepare_cpu(kernel, packed)
    arguments = _cpu_arguments(kernel, cpu, packed)
    threads = min(environment.thread_count(), -(-count // grain))
    if threads <= 1:
        cpu.command.hooks.forward(ctypes.byref(cpu.bounds((count,))), ctypes.byref(arguments))
    else:
        _launch_chunks(cpu, arguments, count, threads, grain)


def _launch_chunks(cpu: _Cpu, arguments: ctypes.Structure, count: int, threads: int, grain: int) -> None:
    size = max(grain, -(-count // (threads * CHUNKS_PER_THREAD)))
    starts = range(0, count, size)
    first_label = cpu.arguments._fields_[0][0]
    ticket = itertools.count()

    def work() -> None:
        own = cpu.arguments.from_buffer_copy(arguments)
        while (turn := next(ticket)) < len(starts):
            first = starts[turn]
            setattr(own, first_label, first)
            cpu.command.hooks.forward(ctypes.byref(cpu.bounds((min(size, count - first),))), ctypes.byref(own))

    pool = _workers(threads - 1)
    helpers = [pool.submit(work) for _ in range(threads - 1)]
    work()
    for helper in helpers:
        helper.result()


def _workers(count: int) -> ThreadPoolExecutor:
    global _pool, _pool_state
    flush = environment.configured()
    if _pool is None or _pool_state[0] < count or _pool_state[1] != flush:
        # Denormals are flushed in every thread or in none: results must not depend on who computes them.
        _pool = ThreadPoolExecutor(count, "warp", initializer=lambda: torch.set_flush_denormal(flush))
        _pool_state = (count, flush)
    return _pool


def _torch_stream(device: torch.device) -> contextlib.AbstractContextManager:
    return on_torch_stream(device)


def launch_blocks(kernel: wp.Kernel, blocks: int, *args, block_dim: int) -> None:
    """Run a block-cooperative kernel (Warp's tile API): ``block, lane = wp.tid()`` of a grid ``(blocks, block_dim)``.

    On a CPU it is right only in a process that set ``wp.config.enable_cpu_blocks``; elsewhere it raises instead of
    silently running one lane.
    """
    if blocks <= 0:
        return
    packed, device = _pack(kernel, args)
    on_cuda = device is not None and device.type == "cuda"
    if not on_cuda and not wp.config.enable_cpu_blocks:
        raise RuntimeError(f"kernel {kernel.key} needs a GPU (or wp.config.enable_cpu_blocks, in a test process)")
    with _torch_stream(device) if on_cuda and device else contextlib.nullcontext():
        wp.launch(
            kernel,
            dim=(blocks, block_dim),
            inputs=[0, *packed],
            device=wp.device_from_torch(device) if on_cuda and device else "cpu",
            block_dim=block_dim,
        )


def warp_view(tensor: torch.Tensor, dtype: Any = None) -> wp.array:
    """The tensor as a Warp array over the same memory, for Warp's utilities (scan, radix sort). It must outlive it."""
    return wp.from_torch(tensor.detach(), dtype=dtype)
