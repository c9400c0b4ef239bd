"""The pytest plugin: launches of SIMD forms run on the processor that ``SCGS_PROCESSOR`` names, in the chunks that
this machine's threads would take.

Every launch also runs here, and ``SCGS_PROCESSOR_LEDGER`` names a JSON file that gets what differed: for each kernel
its launches, those with the same values, and the largest difference relative to the largest magnitude of an array.
"""

from __future__ import annotations

import json
import os
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch  # noqa: F401
import warp as wp

from other_processors import memory
from other_processors.program import ARGUMENTS_AT, PROCESSORS, REGIONS_AT, SHARED_SIZE, Program, shared_file
from scgs_warp.runtime import launch
from scgs_warp.runtime.cpu_kernel import CpuKernel
from scgs_warp.runtime.cpu_threads import Chunks

FORMS = "scgs_warp.kernels.cpu."
PARAMETERS = 3
"""Number of sets of parameters with which each test runs."""


class Device:
    """The other processor: the programs of the modules that were launched, and what differed."""

    def __init__(self, name: str, folder: Path) -> None:
        self._processor, self._folder = PROCESSORS[name], folder
        self._shared = shared_file(folder / "shared")
        self._programs: dict[str, Program] = {}
        self._lock = threading.Lock()
        self.ledger: dict[str, dict] = {}

    def launch(self, kernel: CpuKernel, here: Callable[[], None], bounds: bytes, arguments: bytes) -> None:
        """Run a chunk there and here, compare, and keep the results from there."""
        offsets = kernel.pack.__self__.offsets  # type: ignore[attr-defined]
        regions = memory.regions_of(kernel.kernel, arguments, offsets)
        layout = memory.Layout(regions, REGIONS_AT, SHARED_SIZE)
        with self._lock:
            program = self._program(kernel.kernel)
            words = bytearray(arguments)
            for offset in memory.array_offsets(kernel.kernel, offsets):
                address = int.from_bytes(words[offset : offset + 8], "little")
                words[offset : offset + 8] = layout.moved(address, program.base).to_bytes(8, "little")
            self._shared[: len(bounds)] = bounds
            self._shared[ARGUMENTS_AT : ARGUMENTS_AT + len(words)] = bytes(words)
            for region, place in layout.places:
                data = layout.moved_table(region.read(), program.base) if region.table else region.read()
                self._shared[place : place + region.size] = data.tobytes()
            program.run(kernel.kernel)
            here()
            pairs = []
            for region, place in layout.places:
                if not region.table:
                    there = np.frombuffer(self._shared[place : place + region.size], np.uint8)
                    pairs.append((there, region.read(), region.dtype))
                    region.write(there)
            self._note(kernel.kernel, pairs)

    def _program(self, kernel: wp.Kernel) -> Program:
        name = kernel.module.name
        if name not in self._programs:
            self._programs[name] = Program(kernel.module, self._processor, self._folder, self._folder / "shared")
        return self._programs[name]

    def _note(self, kernel: wp.Kernel, pairs: list[tuple[np.ndarray, np.ndarray, type]]) -> None:
        name = f"{kernel.module.name.removeprefix(FORMS)}.{kernel.key.split('.')[-1]}"
        row = self.ledger.setdefault(name, {"launches": 0, "same_values": 0, "largest_difference": 0.0})
        row["launches"] += 1
        row["same_values"] += all(same(there.view(dtype), here.view(dtype)) for there, here, dtype in pairs)
        for there, here, dtype in pairs:
            if dtype is not np.uint8:
                found = difference(there.view(dtype), here.view(dtype))
                row["largest_difference"] = max(row["largest_difference"], found)

    def close(self) -> None:
        for program in self._programs.values():
            program.close()


def same(there: np.ndarray, here: np.ndarray) -> bool:
    """Return whether all values are the same; NaNs count as one value, since processors differ in their bits."""
    return np.array_equal(there, here, equal_nan=there.dtype.kind == "f")


def difference(there: np.ndarray, here: np.ndarray) -> float:
    """Return the largest difference of finite values, relative to the largest magnitude of the two arrays."""
    finite = np.isfinite(there) & np.isfinite(here)
    a, b = there[finite].astype(np.float64), here[finite].astype(np.float64)
    largest = max(np.abs(a).max(initial=0.0), np.abs(b).max(initial=0.0))
    return float(np.abs(a - b).max(initial=0.0) / largest) if largest else 0.0


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep a few sets of parameters of each test, evenly spread."""
    tests: dict[str, list[pytest.Item]] = {}
    for item in items:
        tests.setdefault(item.nodeid.partition("[")[0], []).append(item)
    kept = set()
    for sets in tests.values():
        wanted = min(PARAMETERS, len(sets))
        kept |= {sets[round(k * (len(sets) - 1) / max(wanted - 1, 1))] for k in range(wanted)}
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = [item for item in items if item in kept]


def pytest_configure(config: pytest.Config) -> None:
    folder = tempfile.TemporaryDirectory(prefix="scgs-warp-processor-")
    device = Device(os.environ["SCGS_PROCESSOR"], Path(folder.name))
    memory.note_addresses()

    def run(kernel: CpuKernel, packed: bytes, begin: int, size: int) -> None:
        bounds, words = kernel.bounds(size), begin.to_bytes(4, "little") + packed

        def here() -> None:
            kernel._entry(bounds, words)

        if kernel.kernel.module.name.startswith(FORMS):
            device.launch(kernel, here, bounds, words)
        else:
            here()

    def run_all(self: CpuKernel, args: tuple, begin: int, size: int) -> None:
        run(self, self.pack(args), begin, size)

    def share(kernel: CpuKernel, packed: bytes, chunks: Chunks, _threads: int, begin: int) -> bool:
        for first, size in chunks:
            run(kernel, packed, begin + first, size)
        return True

    CpuKernel.__call__ = run_all  # type: ignore[method-assign]
    launch.share = share  # type: ignore[assignment]

    def finish() -> None:
        device.close()
        folder.cleanup()
        if os.environ.get("SCGS_PROCESSOR_LEDGER"):
            Path(os.environ["SCGS_PROCESSOR_LEDGER"]).write_text(json.dumps(device.ledger, indent=1) + "\n")

    config.add_cleanup(finish)
