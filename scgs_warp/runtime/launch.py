"""The one place that hands torch tensors to Warp: ``launch`` and ``launch_blocks``.

On a CPU a Warp launch runs its grid in one thread and releases the GIL, so ``launch`` cuts the grid into chunks and
lets a few threads take them one by one (``cpu_threads``). Kernels find their place through their first argument,
``first``. Their arguments are packed here, not by Warp: a step has some 60 launches, of a few tens of microseconds.
On CUDA a launch goes to torch's current stream, whole.
"""

from __future__ import annotations

import ctypes
import functools
import os
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
import warp as wp

from . import environment
from .cpu_threads import cut_by_load, cut_evenly, share
from .cuda_graph import warp_stream
from .cuda_launch import RecordedKernel

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


_parameters: dict[wp.Kernel, list[_ArrayParameter | None]] = {}
_cpu_kernels: dict[wp.Kernel, _CpuKernel] = {}
_cuda_kernels: dict[tuple[wp.Kernel, int | None, int], RecordedKernel] = {}


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
    parameters = _parameters_of(kernel, args)
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


MOST_LAYOUTS = 256
"""Shapes a parameter remembers: those of most tensors stay the same, some change with every frame."""


class _CpuKernel:
    """A kernel made ready for the CPU: its compiled entry, and how its arguments lie in memory."""

    def __init__(self, kernel: wp.Kernel, args: tuple) -> None:
        self.kernel = kernel
        self.parameters = _parameters_of(kernel, args)
        packed, _ = _pack(kernel, args)
        self._command: Any = wp.launch(kernel, dim=1, inputs=[0, *packed], device="cpu", record_cmd=True)  # loads it
        self._entry = self._command.hooks.forward
        params = self._command.params
        self._bounds = functools.lru_cache(maxsize=4096)(lambda size: bytes(type(params[0])((size,))))
        self.types = [type(value) for value in params[2:]]
        fields = [(f"f{k}", type(value)) for k, value in enumerate(params[1:])]
        structure: Any = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
        self.layouts: list[dict[torch.Size, bytes]] = [{} for _ in self.types]
        self._packer = struct.Struct(self._format(structure, fields))

    @staticmethod
    def _format(structure: Any, fields: list[tuple[str, Any]]) -> str:
        """Of ``struct``, with the compiler's padding written out; ``first`` is prepended to each chunk's arguments."""
        text, end = "=", ctypes.sizeof(ctypes.c_int)
        for label, ctype in fields[1:]:
            offset, size = getattr(structure, label).offset, ctypes.sizeof(ctype)
            text += f"{offset - end}x"
            if ctype is _descriptor_type:
                text += f"Q{size - 8}s"  # address, and a tail that depends on nothing but the shape
            else:
                text += _SCALAR_FORMATS.get(ctype, f"{size}s")
            end = offset + size
        return text + f"{ctypes.sizeof(structure) - end}x"

    def pack(self, args: tuple) -> bytes:
        """The arguments after ``first``, checked."""
        values: list[Any] = []
        for parameter, ctype, layouts, value in zip(self.parameters, self.types, self.layouts, args):
            if isinstance(value, torch.Tensor):
                tail = layouts.get(value.shape)
                if (
                    tail is None
                    or parameter is None
                    or value.dtype is not parameter.dtype
                    or not value.is_contiguous()
                    or not value.is_cpu
                ):
                    tail = self._new_layout(parameter, layouts, value)
                values.append(value.data_ptr())
                values.append(tail)
            elif ctype in _SCALAR_FORMATS:
                values.append(0 if value is None else value)
            else:
                if value is None:
                    value = ctype()  # an array that the kernel will not touch
                elif type(value) is not ctype:  # Warp's structures and vectors
                    value = value.__ctype__() if hasattr(value, "__ctype__") else ctype(value)
                raw = bytes(value)
                values += [int.from_bytes(raw[:8], "little"), raw[8:]] if ctype is _descriptor_type else [raw]
        try:
            return self._packer.pack(*values)
        except struct.error as error:
            raise TypeError(f"kernel {self.kernel.key}: {error}") from None

    def _new_layout(
        self, parameter: _ArrayParameter | None, layouts: dict[torch.Size, bytes], value: torch.Tensor
    ) -> bytes:
        if parameter is None:
            raise TypeError(f"kernel {self.kernel.key}: a tensor was given for a parameter that is no array")
        if not value.is_cpu:
            raise ValueError(f"kernel {self.kernel.key}: {parameter.label} is on {value.device}, others on cpu")
        tail = bytes(_array(self.kernel, parameter, value))[8:]
        if len(layouts) >= MOST_LAYOUTS:
            layouts.clear()
        layouts[value.shape] = tail
        return tail

    def bind(self, arguments: bytes, tensors: tuple, begin: int = 0) -> Callable[[int, int], None]:
        """What runs a part of the grid, given its first index after ``begin`` and its size; holds on to the tensors."""
        entry, bounds = self._entry, self._bounds

        def call(first: int, size: int, _tensors: tuple = tensors) -> None:
            entry(bounds(size), (begin + first).to_bytes(4, "little") + arguments)

        return call


_SCALAR_FORMATS = {
    ctypes.c_int8: "b",
    ctypes.c_uint8: "B",
    ctypes.c_int16: "h",
    ctypes.c_uint16: "H",
    ctypes.c_int32: "i",
    ctypes.c_uint32: "I",
    ctypes.c_int64: "q",
    ctypes.c_uint64: "Q",
    ctypes.c_float: "f",
    ctypes.c_double: "d",
    ctypes.c_bool: "?",
}


def _parameters_of(kernel: wp.Kernel, args: tuple) -> list[_ArrayParameter | None]:
    parameters = _parameters.get(kernel)
    if parameters is None:
        parameters = _parameters[kernel] = _describe_parameters(kernel)
    if len(parameters) != len(args):
        raise TypeError(f"kernel {kernel.key} takes {len(parameters)} arguments after 'first', got {len(args)}")
    return parameters


def launch(
    kernel: wp.Kernel, count: int, *args, grain: int = 512, load: torch.Tensor | None = None, begin: int = 0
) -> None:
    """Run ``kernel`` for the grid indices begin .. begin + count - 1.

    Args:
        kernel: a Warp kernel whose first argument is ``first: int``.
        count: size of the one-dimensional grid; 0 does nothing.
        args: the kernel's other arguments, in order: contiguous tensors on one device, numbers, Warp values, or None
            for an array that the kernel will not touch.
        grain: fewest grid indices worth a chunk of their own on a CPU (1 for kernels whose index is a whole tile).
        load: [count] integers on the CPU that never fall: what the indices up to each cost, itself included. Chunks are
            then cut by cost, and ``grain`` only says from how many indices on threads share the work.
        begin: the first grid index.

    Raises:
        ValueError: a tensor's dtype, shape, strides or device is not what the kernel declares.
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
        cpu = _cpu_kernels[kernel] = _CpuKernel(kernel, args)
    elif len(args) != len(cpu.parameters):
        _parameters_of(kernel, args)
    call = cpu.bind(cpu.pack(args), args, begin)
    threads = min(environment.thread_count(), -(-count // grain))
    if threads <= 1:
        call(0, count)
    else:
        share(call, cut_evenly(count, threads, grain) if load is None else cut_by_load(load, threads), threads)


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
        packed, _ = _pack(kernel, args)
        ready = RecordedKernel(kernel, _parameters[kernel], packed, _array, dim, device, block_dim)
        _cuda_kernels[key] = ready
    ready.launch(dim, args, warp_stream(device), begin)


def launch_blocks(kernel: wp.Kernel, blocks: int, *args, block_dim: int, begin: int = 0) -> None:
    """Run a block-cooperative kernel (Warp's tile API): ``block, lane = wp.tid()`` of a grid ``(blocks, block_dim)``,
    whose first block is ``begin``.

    On a CPU it is right only in a process that set ``wp.config.enable_cpu_blocks``; elsewhere it raises instead of
    silently running one lane.
    """
    if blocks <= 0:
        return
    device = next((value.device for value in args if isinstance(value, torch.Tensor)), None)
    if device is not None and device.type == "cuda":
        _launch_on_cuda(kernel, (blocks, block_dim), args, device, block_dim, begin)
        return
    if not wp.config.enable_cpu_blocks:
        raise RuntimeError(f"kernel {kernel.key} needs a GPU (or wp.config.enable_cpu_blocks, in a test process)")
    packed, _ = _pack(kernel, args)
    wp.launch(kernel, dim=(blocks, block_dim), inputs=[begin, *packed], device="cpu", block_dim=block_dim)


def warp_view(tensor: torch.Tensor, dtype: Any = None) -> wp.array:
    """The tensor as a Warp array over the same memory, for Warp's utilities (scan, radix sort). It must outlive it."""
    return wp.from_torch(tensor.detach(), dtype=dtype)
