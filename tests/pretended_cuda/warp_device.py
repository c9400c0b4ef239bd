"""Warp's side of the pretended device: launches on it run on the CPU, are counted, and are recorded by captures."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import warp as wp

from . import ledger
from .torch_device import Graph

native_bodies = True
"""Whether native bodies run, thread by thread in the emulation. Otherwise, in tests of whole training runs, the
portable forms take their place, which are a hundred times as fast."""


def _run(name: str, call: Callable[[], None]) -> None:
    ledger.count_launch(name)
    call()
    if Graph.capturing is not None:
        Graph.capturing.record(call)


class _Capture(contextlib.nullcontext):
    """``wp.ScopedCapture`` of a stream that torch captures."""

    graph = None

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(self)


def install(native: Path) -> None:
    """Replace Warp's streams and captures, and the project's lowest functions that launch.

    Args:
        native: folder for the compiled native bodies.
    """
    from scgs_warp.ops import cuda_blocks, forms, radix
    from scgs_warp.runtime import cuda_launch

    to_warp = wp.device_from_torch

    def device_from_torch(device: torch.device | str) -> wp.Device:
        return to_warp("cpu" if torch.device(device).type == "cuda" else device)

    wp.device_from_torch = sys.modules[wp.from_torch.__module__].device_from_torch = device_from_torch
    wp.is_cuda_available = lambda: True
    wp.stream_from_torch = lambda stream=None: None
    wp.ScopedCapture = _Capture

    kernel, launch = cuda_launch.RecordedKernel, cuda_launch.RecordedKernel.launch
    prepare = kernel.__init__

    def prepared(self, of, args, dim, device, block_dim=256) -> None:
        # Only kernels on tiles need whole blocks; others would be compiled a second time.
        blocks, wp.config.enable_cpu_blocks = wp.config.enable_cpu_blocks, isinstance(dim, tuple)
        try:
            prepare(self, of, args, dim, device, block_dim if isinstance(dim, tuple) else 1)
        finally:
            wp.config.enable_cpu_blocks = blocks
        self.name = of.key

    def launched(self, dim, args, stream, begin=0) -> None:
        _run(self.name, lambda: launch(self, dim, args, stream, begin))

    kernel.__init__, kernel.launch = prepared, launched

    sort = radix.radix_sort

    def sorted_on_device(keys, values, count, bits) -> None:
        if keys.is_cuda and count:
            _run("radix_sort_pairs", lambda: sort(keys, values, count, bits))
        else:
            sort(keys, values, count, bits)

    radix.radix_sort = sorted_on_device
    forms.chosen_form = _portable_on_demand(forms.chosen_form)
    cuda_blocks.launch_native = _native(cuda_blocks.launch_native, native)


def _portable_on_demand(choose: Callable[..., str]) -> Callable[..., str]:
    def chosen_form(form: str, *args: Any) -> str:
        found = choose(form, *args)
        return "plain" if found == "cuda" and form == "auto" and not native_bodies else found

    return chosen_form


def _native(launch: Callable[..., None], folder: Path) -> Callable[..., None]:
    """Return ``launch_native`` with the native bodies run by the emulation, which is compiled on first use."""
    from helpers import cuda_emulation

    emulated: list[Callable[..., None]] = []

    def launch_native(kernel: Any, blocks: int, *args: Any, begin: int = 0) -> None:
        devices = {value.device for value in args if isinstance(value, torch.Tensor)}
        if not all(device.type == "cuda" for device in devices):
            launch(kernel, blocks, *args, begin=begin)  # refuses
            raise ValueError(f"kernel {kernel.key}: tensors on {sorted(map(str, devices))}")
        if not emulated:
            emulated.append(cuda_emulation.launcher(cuda_emulation.build(folder)))
        _run(kernel.key, lambda: emulated[0](kernel, blocks, *args, begin=begin))

    return launch_native
