"""What a compiled kernel takes of a GPU: registers, stack, shared and constant memory, and its theoretical occupancy.

Warp compiles kernels for an architecture without a GPU of that kind. The numbers stand in the cubin, an ELF file whose
section ``.nv.info`` holds records (format, attribute, size, values), so no tool beside Python is needed.
"""

from __future__ import annotations

import importlib
import json
import pkgutil
import struct
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import warp as wp

import scgs_warp.kernels
from scgs_warp.runtime import launch  # noqa: F401  (initialises Warp quietly)

ARCHITECTURES = (75, 90, 120)
BLOCK = 256
"""Threads of a block: all kernels are launched with Warp's default."""
SUFFIX = "_cuda_kernel_forward"


class Resources(NamedTuple):
    """What one kernel takes, as its cubin states it."""

    registers: int
    """32-bit registers of a thread."""
    stack: int
    """Bytes of a thread's stack: spilled registers, and arrays with indices that are not known when compiling."""
    shared: int
    """Bytes of shared memory of a block, static and dynamic."""
    constant: int
    """Bytes of arguments, in constant bank 0."""


class Multiprocessor(NamedTuple):
    """Limits of one multiprocessor; CUDA C++ Programming Guide, table of technical specifications."""

    warps: int
    blocks: int
    shared: int
    """Bytes of shared memory for all blocks."""
    reserved: int
    """Bytes of shared memory that the system keeps in every block."""
    registers: int = 65536


MULTIPROCESSORS = {
    75: Multiprocessor(32, 16, 64 << 10, 0),
    90: Multiprocessor(64, 32, 228 << 10, 1 << 10),
    120: Multiprocessor(48, 24, 100 << 10, 1 << 10),
}


def module_names() -> list[str]:
    """Return all modules that may hold kernels for CUDA, relative to ``scgs_warp.kernels``."""
    prefix = "scgs_warp.kernels."
    found = pkgutil.walk_packages(scgs_warp.kernels.__path__, prefix)
    names = sorted(module.name.removeprefix(prefix) for module in found if not module.ispkg)
    return [name for name in names if not name.startswith("cpu.")]


def kernels_of(name: str) -> list[wp.Kernel]:
    """Return the kernels that a module defines."""
    module: ModuleType = importlib.import_module(f"scgs_warp.kernels.{name}")
    return [k for k in vars(module).values() if isinstance(k, wp.Kernel) and k.module.name == module.__name__]


def compile_module(name: str, architectures: Iterable[int], folder: Path) -> dict[int, Path]:
    """Compile a module's kernels; return the cubin of each architecture."""
    module = kernels_of(name)[0].module
    artifacts = wp.compile_aot_module(module, arch=tuple(architectures), module_dir=folder, use_ptx=False)
    return {a: path for a in architectures for path in artifacts if path.name.endswith(f".sm{a}.cubin")}


def resources(name: str, cubin: Path) -> dict[str, Resources]:
    """Return what each kernel of a module takes, by the kernel's key."""
    found = read_cubin(cubin.read_bytes())
    (meta,) = cubin.parent.glob("*.meta")
    dynamic = json.loads(meta.read_text(encoding="utf-8"))
    taken = {}
    for kernel in kernels_of(name):
        symbol = f"{kernel.get_mangled_name()}{SUFFIX}"
        own = found[symbol]
        taken[kernel.key] = own._replace(shared=own.shared + int(dynamic.get(f"{symbol}_smem_bytes", 0)))
    return taken


def occupancy(taken: Resources, architecture: int, threads: int = BLOCK) -> float:
    """Return the share of a multiprocessor's warps that can be resident at once."""
    limits, warps = MULTIPROCESSORS[architecture], threads // 32
    registers = -(-taken.registers * 32 // 256) * 256  # a warp gets registers in units of 256
    shared = -(-(taken.shared + limits.reserved) // 256) * 256
    blocks = min(limits.warps // warps, limits.blocks, limits.registers // registers // warps)
    if shared:
        blocks = min(blocks, limits.shared // shared)
    return blocks * warps / limits.warps


class _Section(NamedTuple):
    name: str
    offset: int
    size: int
    link: int


_REGISTER_COUNT, _FRAME_SIZE = 0x2F, 0x11
_SIZED = 4
"""Format of a record whose values have a length of their own; other records are four bytes long."""


def read_cubin(data: bytes) -> dict[str, Resources]:
    """Return what each kernel of a cubin takes, by its symbol.

    Raises:
        ValueError: this is no 64-bit ELF file.
    """
    if data[:5] != b"\x7fELF\x02":
        raise ValueError("a cubin is a 64-bit ELF file; this is something else")
    sections = _sections(data)
    by_name = {section.name: section for section in sections}
    symbols = _symbols(data, by_name[".symtab"], sections)
    counts = _records(data, by_name[".nv.info"], symbols)
    found = {}
    for name, values in counts.items():
        if f".text.{name}" in by_name:
            shared, constant = by_name.get(f".nv.shared.{name}"), by_name.get(f".nv.constant0.{name}")
            sizes = (0 if section is None else section.size for section in (shared, constant))
            found[name] = Resources(values.get(_REGISTER_COUNT, 0), values.get(_FRAME_SIZE, 0), *sizes)
    return found


def _sections(data: bytes) -> list[_Section]:
    (table,) = struct.unpack_from("<Q", data, 0x28)
    size, count, names = struct.unpack_from("<HHH", data, 0x3A)
    headers = [struct.unpack_from("<IIQQQQI", data, table + size * index) for index in range(count)]
    texts = headers[names][4]
    return [_Section(_text(data, texts + h[0]), h[4], h[5], h[6]) for h in headers]


def _symbols(data: bytes, table: _Section, sections: list[_Section]) -> list[str]:
    texts, width = sections[table.link].offset, 24
    starts = range(table.offset, table.offset + table.size, width)
    return [_text(data, texts + struct.unpack_from("<I", data, start)[0]) for start in starts]


def _records(data: bytes, info: _Section, symbols: list[str]) -> dict[str, dict[int, int]]:
    """Return, by symbol, the values of the records that hold one number for it."""
    found: dict[str, dict[int, int]] = {}
    at = info.offset
    while at < info.offset + info.size:
        form, attribute, size = struct.unpack_from("<BBH", data, at)
        at += 4
        if form == _SIZED:
            if attribute in (_REGISTER_COUNT, _FRAME_SIZE):
                symbol, value = struct.unpack_from("<II", data, at)
                found.setdefault(symbols[symbol], {})[attribute] = value
            at += size
    return found


def _text(data: bytes, start: int) -> str:
    return data[start : data.index(b"\0", start)].decode()
