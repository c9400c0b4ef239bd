"""What a launch reads and writes: found in the bytes of its arguments, copied to a shared file and back."""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
import warp as wp

from scgs_warp.runtime.kernel_arguments import parameters_of

TABLES = ("addresses_in", "table_in")
"""Names of kernels' parameters whose elements may be addresses."""
ALIGNMENT = 64
FLOATS = {torch.float32: np.float32, torch.float64: np.float64}

known: dict[int, int] = {}
"""Bytes from an address to the end of its tensor's storage, the newest last, for all addresses that were asked for."""


class Region(NamedTuple):
    """Memory of this process."""

    address: int
    size: int
    dtype: type = np.uint8
    table: bool = False
    """Its elements may be addresses; no kernel writes to it."""

    def read(self) -> np.ndarray:
        """Copy its bytes."""
        return np.frombuffer(ctypes.string_at(self.address, self.size), np.uint8)

    def write(self, data: np.ndarray) -> None:
        """Replace its bytes."""
        ctypes.memmove(self.address, data.tobytes(), self.size)


def note_addresses() -> None:
    """From now on, keep the addresses that anybody asks a tensor for: those in tables are among them."""
    ask = torch.Tensor.data_ptr

    def data_ptr(self: torch.Tensor) -> int:
        address = ask(self)
        if address and not self.is_meta:
            known.pop(address, None)
            known[address] = self.untyped_storage().nbytes() - self.storage_offset() * self.element_size()
        return address

    torch.Tensor.data_ptr = data_ptr  # type: ignore[method-assign]


def _addressed(values: Iterable[int]) -> list[Region]:
    """Return the regions in which the values lie that are addresses."""
    found = []
    for value in values:
        if value < 1 << 32:
            continue
        begin = next(begin for begin in reversed(known) if begin <= value < begin + known[begin])
        found.append(Region(begin, known[begin], np.float32))
    return found


def array_offsets(kernel: wp.Kernel, offsets: list[int]) -> list[int]:
    """Return where in the arguments' bytes the addresses of arrays are."""
    return [offset for parameter, offset in zip(parameters_of(kernel), offsets[1:]) if parameter is not None]


def regions_of(kernel: wp.Kernel, arguments: bytes, offsets: list[int]) -> list[Region]:
    """Return the memory of a launch's arrays and of what their tables point to, in order and without overlaps.

    Args:
        arguments: the bytes of all arguments, as Warp lays them out.
        offsets: where each argument begins, ``first`` included.
    """
    found = []
    for parameter, offset in zip(parameters_of(kernel), offsets[1:]):
        if parameter is None:
            continue
        address, _, *shape = struct.unpack_from("=QQ4i", arguments, offset)
        (ndim,) = struct.unpack_from("=i", arguments, offset + 48)
        size = parameter.element_size * int(np.prod(shape[:ndim], dtype=np.int64))
        if not address or not size:
            continue
        table = parameter.label in TABLES
        region = Region(address, size, FLOATS.get(parameter.dtype, np.uint8), table)
        found.append(region)
        if table:
            found += _addressed(region.read().view(np.int64).tolist())
    merged: list[Region] = []
    for region in sorted(set(found), key=lambda region: (region.address, -region.size)):
        if merged and region.address < merged[-1].address + merged[-1].size:
            last = merged.pop()
            end = max(last.address + last.size, region.address + region.size)
            region = last._replace(size=end - last.address)
        merged.append(region)
    return merged


class Layout:
    """Places of regions in a shared file, each as far from a multiple of 64 bytes as in this process."""

    def __init__(self, regions: list[Region], begin: int, limit: int) -> None:
        self.places: list[tuple[Region, int]] = []
        end = begin
        for region in regions:
            place = -(-end // ALIGNMENT) * ALIGNMENT + region.address % ALIGNMENT
            self.places.append((region, place))
            end = place + region.size + ALIGNMENT
        if end > limit:
            raise RuntimeError(f"a launch takes {end} bytes of memory; the shared file has {limit}")
        self.begin = begin

    def moved(self, address: int, base: int) -> int:
        """Return where the address is in a process that has the file at ``base``; other numbers stay as they are."""
        for region, place in self.places:
            if region.address <= address < region.address + region.size:
                return base + place + address - region.address
        return address

    def moved_table(self, data: np.ndarray, base: int) -> np.ndarray:
        """Move all addresses of a table."""
        return np.array([self.moved(value, base) for value in data.view(np.int64).tolist()], np.int64).view(np.uint8)
