"""Launches on CUDA at the price of packing a few numbers.

Warp's own launch looks everything up anew and takes some tens of microseconds, and a frame drawn step by step has two
dozen of them. Here a kernel's arguments lie in one block of memory, written by one call of ``struct``; Warp's recorded
launch, made once, reads them there.
"""

from __future__ import annotations

import ctypes
import struct
import threading
from collections.abc import Callable, Sequence
from typing import Any

import torch
import warp as wp

MOST_LAYOUTS = 256
"""Shapes that a parameter remembers."""
_ALIGNMENT = 16
_FORMATS = {
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


class RecordedKernel:
    """A kernel, ready to be launched on one device with one block size."""

    def __init__(
        self,
        kernel: wp.Kernel,
        parameters: Sequence[Any],
        packed: Sequence[Any],
        describe: Callable[[wp.Kernel, Any, torch.Tensor], Any],
        dim: int | tuple[int, int],
        device: torch.device,
        block_dim: int = 256,
    ) -> None:
        """
        Args:
            parameters: of every argument after ``first``: ``label`` and ``dtype`` of an array, or None.
            packed: these arguments once, as Warp takes them.
            describe: makes Warp's descriptor of a tensor, or raises ValueError.
        """
        self._kernel, self._parameters, self._describe, self._device = kernel, parameters, describe, device
        where = wp.device_from_torch(device)
        self._command: Any = wp.launch(
            kernel, dim=dim, inputs=[0, *packed], device=where, block_dim=block_dim, record_cmd=True
        )
        self._dim = dim
        self._types = [type(value) for value in self._command.params[2:]]
        self._layouts: list[dict[torch.Size, bytes]] = [{} for _ in self._types]
        self._lock = threading.Lock()
        self._settle()

    def _settle(self) -> None:
        """Give the recorded launch's arguments their places in one buffer."""
        params, addresses = self._command.params, self._command.params_addr
        offsets, end, text = [], 0, "="
        for index, value in enumerate(params[1:]):
            size = ctypes.sizeof(value)
            offset = -(-end // _ALIGNMENT) * _ALIGNMENT
            offsets.append(offset)
            form = "i"  # ``first``
            if index > 0:
                form = (
                    f"Q{size - 8}s"
                    if self._parameters[index - 1] is not None
                    else _FORMATS.get(type(value), f"{size}s")
                )
            text += f"{offset - end}x{form}"
            end = offset + size
        self._packer = struct.Struct(text)
        self._buffer = (ctypes.c_char * (end + _ALIGNMENT))()
        skipped = -ctypes.addressof(self._buffer) % _ALIGNMENT
        self._begin = skipped
        for index, offset in enumerate(offsets, 1):
            params[index] = type(params[index]).from_buffer(self._buffer, skipped + offset)
            if addresses is not None:
                addresses[index] = ctypes.c_void_p(ctypes.addressof(params[index]))

    def launch(self, dim: int | tuple[int, int], args: tuple, stream: wp.Stream | None, begin: int = 0) -> None:
        """Run the kernel on ``stream`` with other arguments, from grid index ``begin`` on.

        Raises:
            ValueError: a tensor's dtype, shape, strides or device is not what the kernel declares.
            TypeError: the number or the kind of an argument is not.
        """
        values: list[Any] = [begin]
        if len(args) != len(self._parameters):
            raise TypeError(
                f"kernel {self._kernel.key} takes {len(self._parameters)} arguments after 'first', got {len(args)}"
            )
        for parameter, ctype, layouts, value in zip(self._parameters, self._types, self._layouts, args):
            if isinstance(value, torch.Tensor):
                tail = layouts.get(value.shape)
                if (
                    tail is None
                    or value.dtype is not parameter.dtype
                    or not value.is_contiguous()
                    or value.device != self._device
                ):
                    tail = self._new_layout(parameter, layouts, value)
                values += (value.data_ptr(), tail)
            elif parameter is not None:  # an array that the kernel will not touch, or one already described
                raw = bytes(ctype() if value is None else value)
                values += (int.from_bytes(raw[:8], "little"), raw[8:])
            elif ctype in _FORMATS:
                values.append(value)
            else:  # Warp's structures and vectors
                if type(value) is not ctype:
                    value = value.__ctype__() if hasattr(value, "__ctype__") else ctype(*value)
                values.append(bytes(value))
        with self._lock:
            try:
                self._packer.pack_into(self._buffer, self._begin, *values)
            except struct.error as error:
                raise TypeError(f"kernel {self._kernel.key}: {error}") from None
            if dim != self._dim:
                self._command.set_dim(dim)
                self._dim = dim
            self._command.launch(stream)

    def _new_layout(self, parameter: Any, layouts: dict[torch.Size, bytes], value: torch.Tensor) -> bytes:
        if parameter is None:
            raise TypeError(f"kernel {self._kernel.key}: a tensor was given for a parameter that is no array")
        if value.device != self._device:
            raise ValueError(
                f"kernel {self._kernel.key}: {parameter.label} is on {value.device}, others on {self._device}"
            )
        tail = bytes(self._describe(self._kernel, parameter, value))[8:]
        if len(layouts) >= MOST_LAYOUTS:
            layouts.clear()
        layouts[value.shape] = tail
        return tail
