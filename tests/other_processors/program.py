"""Kernels of one Warp module as a program for another processor."""

from __future__ import annotations

import mmap
import re
import shutil
import struct
import subprocess
from pathlib import Path
from typing import NamedTuple

import warp as wp

from helpers.clang import compiler_path

DRIVER = Path(__file__).with_name("driver.cc")
SHARED_SIZE = 1 << 28
"""Bytes of the file that a program shares with the tests; only those that are touched take memory."""
ARGUMENTS_AT, REGIONS_AT = 64, 8192
"""Where in this file a launch's arguments and its arrays begin; the bounds of the grid come first."""
EMULATOR = "qemu-aarch64"
LIBRARIES = Path("/usr/aarch64-linux-gnu/lib/libc.a")


class Processor(NamedTuple):
    """A processor that kernels are compiled for."""

    flags: tuple[str, ...]
    """Words for Clang."""
    feature: str
    """What /proc/cpuinfo must list if the processor is not emulated."""
    emulated: bool = False


PROCESSORS = {
    "avx512": Processor(("-march=x86-64-v4",), "avx512vl"),
    "avx2": Processor(("-march=x86-64-v3",), "avx2"),
    # Neither AVX2 nor fused multiply-adds; older processors lack F16C, without which Warp's own code does not run.
    "avx": Processor(("-march=ivybridge",), "f16c"),
    "neon": Processor(("--target=aarch64-linux-gnu",), "", emulated=True),
}


def why_not(name: str) -> str | None:
    """Return why this machine cannot run programs for a processor; None if it can."""
    processor = PROCESSORS[name]
    if compiler_path() is None:
        return "no Clang of version 16 or newer is installed"
    if processor.emulated:
        if shutil.which(EMULATOR) is None or not LIBRARIES.is_file():
            return f"no {EMULATOR} with the C library for it"
        return None
    facts = Path("/proc/cpuinfo")
    if not facts.is_file() or not re.search(rf"^flags\b.*\b{processor.feature}\b", facts.read_text(), re.MULTILINE):
        return f"this processor has no {processor.feature}"
    return None


class Program:
    """A module's kernels, compiled for a processor and waiting for launches."""

    def __init__(self, module: wp.Module, processor: Processor, folder: Path, shared: Path) -> None:
        name = module.get_module_identifier(block_dim=1)
        source = Path(str(wp.config.kernel_cache_dir)) / name / f"{name}.cpp"
        entries = re.findall(r"^WP_API void (\w+_cpu_forward)\(", source.read_text(encoding="utf-8"), re.MULTILINE)
        self._index = {entry: index for index, entry in enumerate(entries)}
        path = _build(source, entries, processor, folder / name)
        words = [*([EMULATOR] if processor.emulated else []), str(path), str(shared), str(SHARED_SIZE)]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.base: int = struct.unpack("=Q", self._read(8))[0]
        """Address of the shared file in the program."""

    def _read(self, count: int) -> bytes:
        assert self._process.stdout is not None
        found = self._process.stdout.read(count)
        if len(found) != count:
            raise RuntimeError(f"the program ended with status {self._process.wait()}: {self._process.args}")
        return found

    def run(self, kernel: wp.Kernel) -> None:
        """Run a kernel on what the shared file holds."""
        assert self._process.stdin is not None
        self._process.stdin.write(struct.pack("=I", self._index[f"{kernel.get_mangled_name()}_cpu_forward"]))
        self._process.stdin.flush()
        self._read(1)

    def close(self) -> None:
        """End the program."""
        self._process.communicate(timeout=60)


def _build(source: Path, entries: list[str], processor: Processor, path: Path) -> Path:
    """Compile what Warp compiles, as it compiles it, and link it with the driver."""
    common = [str(compiler_path()), *processor.flags, "-std=c++17", "-O2", "-ffp-contract=off", "-w", "-DNDEBUG"]
    inlining = ["-mllvm", "-inline-threshold=9000", "-mllvm", "-inline-cold-callsite-threshold=3000"]
    headers = str(Path(wp.__file__).parent / "native")
    object_path, driver = f"{path}.o", f"{path}.driver.o"
    listed = " ".join(f"ENTRY({entry})" for entry in entries)
    defined = [f"-DENTRIES={listed}", f"-DARGUMENTS={ARGUMENTS_AT}"]
    for words in (
        [*common, *inlining, "-I", headers, "-c", str(source), "-o", object_path],
        [*common, *defined, "-c", str(DRIVER), "-o", driver],
        [*common, "-nostdlib++", "-static", object_path, driver, "-lm", "-o", str(path)],
    ):
        made = subprocess.run(words, capture_output=True, text=True, check=False, timeout=600)
        if made.returncode:
            raise RuntimeError(f"{' '.join(words)}\n{made.stderr[-4000:]}")
    return path


def shared_file(path: Path) -> mmap.mmap:
    """Make the file that programs share with the tests."""
    with open(path, "wb+") as file:
        file.truncate(SHARED_SIZE)
        return mmap.mmap(file.fileno(), SHARED_SIZE)
