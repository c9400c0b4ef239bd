"""Kernel arguments: torch tensors checked against what a kernel declares, and packed into one block of memory.

Warp's own launch looks up every parameter again and takes tens of microseconds, and a training step has some 60
launches. Here one call of ``struct`` turns the arguments of a launch into the bytes of a C structure.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import warp as wp

from . import environment

environment.init_warp()

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
FIRST_SIZE = ctypes.sizeof(ctypes.c_int)
"""Size in bytes of a kernel's first argument, the grid index ``first``."""
LARGEST_STRIDE = 2**31 - 1
"""Largest distance in bytes between neighbouring elements along a dimension, which Warp stores as int32."""
MAX_LAYOUTS = 256
"""Largest number of shapes cached per parameter: most tensors keep their shape, but some change with every frame."""


class ArrayParameter(NamedTuple):
    """Requirements of a kernel's array parameter on a tensor."""

    label: str
    dtype: torch.dtype
    inner: tuple[int, ...]
    """Shape of one element: (3,) for vec3."""
    ndim: int
    """Number of dimensions, not counting those of an element."""
    element_size: int
    """Size of one element in bytes."""


_parameters: dict[wp.Kernel, list[ArrayParameter | None]] = {}


def parameters_of(kernel: wp.Kernel) -> list[ArrayParameter | None]:
    """Return the array parameter that a kernel declares for each argument after ``first``; None for non-arrays."""
    if kernel not in _parameters:
        _parameters[kernel] = [_describe_parameter(argument) for argument in kernel.adj.args[1:]]
    return _parameters[kernel]


def _describe_parameter(argument: Any) -> ArrayParameter | None:
    if not wp.types.is_array(argument.type):
        return None
    dtype = argument.type.dtype
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)
    scalar = {float: wp.float32, int: wp.int32, bool: wp.bool}.get(scalar, scalar)
    inner = tuple(getattr(dtype, "_shape_", ()))
    size = wp.types.type_size_in_bytes(dtype)
    return ArrayParameter(argument.label, _TORCH_DTYPES[scalar], inner, argument.type.ndim, size)


def _check_count(kernel: wp.Kernel, parameters: Sequence[Any], args: Sequence[Any]) -> None:
    if len(parameters) != len(args):
        raise TypeError(f"kernel {kernel.key} takes {len(parameters)} arguments after 'first', got {len(args)}")


def _check_tensor(
    kernel: wp.Kernel, parameter: ArrayParameter | None, tensor: torch.Tensor, device: torch.device
) -> ArrayParameter:
    if parameter is None:
        raise TypeError(f"kernel {kernel.key}: a tensor was given for a parameter that is no array")
    if tensor.device != device:
        raise ValueError(f"kernel {kernel.key}: {parameter.label} is on {tensor.device}, others on {device}")
    return parameter


def _descriptor(kernel: wp.Kernel, parameter: ArrayParameter, tensor: torch.Tensor) -> Any:
    """Return Warp's descriptor of a contiguous tensor; refuse a wrong dtype, shape or strides, naming the parameter."""
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
    if strides and max(strides) > LARGEST_STRIDE:
        raise ValueError(
            f"kernel {kernel.key}: {parameter.label} of shape {shape} has a stride of {max(strides)} bytes; kernels "
            f"take {LARGEST_STRIDE} at most"
        )
    return _descriptor_type(tensor.data_ptr(), 0, len(outer), outer, strides[::-1])


def warp_arguments(kernel: wp.Kernel, args: Sequence[Any]) -> list[Any]:
    """Convert the arguments after ``first`` for ``wp.launch``: tensors to descriptors; others stay unchanged.

    Raises:
        ValueError: a tensor's dtype, shape, strides or device is not what the kernel declares.
        TypeError: the number or the kind of an argument is wrong.
    """
    parameters = parameters_of(kernel)
    _check_count(kernel, parameters, args)
    device = next((value.device for value in args if isinstance(value, torch.Tensor)), torch.device("cpu"))
    return [
        _descriptor(kernel, _check_tensor(kernel, parameter, value, device), value)
        if isinstance(value, torch.Tensor)
        else value
        for parameter, value in zip(parameters, args)
    ]


class ArgumentPacker:
    """A reusable packer for the arguments of one kernel on one device.

    Packed bytes are those of a C structure in the compiler's layout, without its first member, ``first``.
    """

    def __init__(self, kernel: wp.Kernel, params: Sequence[Any], device: torch.device) -> None:
        """
        Args:
            kernel: its first argument is ``first: int``.
            params: ``params[1:]`` of a recorded launch of the kernel: ``first`` and the other arguments as ctypes.
            device: device on which all tensors must be.
        """
        self._kernel, self._device = kernel, device
        self._parameters = parameters_of(kernel)
        self._types = [type(value) for value in params[1:]]
        self._layouts: list[dict[torch.Size, bytes]] = [{} for _ in self._types]
        fields = [(f"f{k}", type(value)) for k, value in enumerate(params)]
        structure: Any = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
        self.offsets: list[int] = [getattr(structure, label).offset for label, _ in fields]
        """Offset of each argument in the structure, ``first`` included."""
        self.size: int = ctypes.sizeof(structure)
        """Size of the structure in bytes."""
        self._packer = struct.Struct(self._format())

    def _format(self) -> str:
        """Return the format for ``struct``, with the compiler's padding written out."""
        text, end = "=", FIRST_SIZE
        for parameter, ctype, offset in zip(self._parameters, self._types, self.offsets[1:]):
            size = ctypes.sizeof(ctype)
            # An array's address changes with every launch; the rest of its descriptor depends on the shape only.
            form = f"Q{size - 8}s" if parameter is not None else _SCALAR_FORMATS.get(ctype, f"{size}s")
            text += f"{offset - end}x{form}"
            end = offset + size
        return text + f"{self.size - end}x"

    def pack(self, args: Sequence[Any]) -> bytes:
        """Check the arguments after ``first`` and return their bytes.

        Raises:
            ValueError: a tensor's dtype, shape, strides or device is not what the kernel declares.
            TypeError: the number or the kind of an argument is wrong.
        """
        _check_count(self._kernel, self._parameters, args)
        values: list[Any] = []
        for parameter, ctype, layouts, value in zip(self._parameters, self._types, self._layouts, args):
            if isinstance(value, torch.Tensor):
                tail = layouts.get(value.shape)
                if (
                    tail is None
                    or parameter is None
                    or value.dtype is not parameter.dtype
                    or not value.is_contiguous()
                    or value.device != self._device
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
                values += [raw] if parameter is None else [int.from_bytes(raw[:8], "little"), raw[8:]]
        try:
            return self._packer.pack(*values)
        except struct.error as error:
            raise TypeError(f"kernel {self._kernel.key}: {error}") from None

    def _new_layout(
        self, parameter: ArrayParameter | None, layouts: dict[torch.Size, bytes], value: torch.Tensor
    ) -> bytes:
        parameter = _check_tensor(self._kernel, parameter, value, self._device)
        tail = bytes(_descriptor(self._kernel, parameter, value))[8:]
        if len(layouts) >= MAX_LAYOUTS:
            layouts.clear()
        layouts[value.shape] = tail
        return tail
