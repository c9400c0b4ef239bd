"""Compile ``device.cpp`` against the installed torch and load it, before anybody imports torch."""

from __future__ import annotations

import ctypes
import hashlib
import importlib.metadata
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

SOURCE = Path(__file__).with_name("device.cpp")
COMPILER = shutil.which("g++")
FLAGS = ("-O1", "-std=c++20", "-shared", "-fPIC", "-Wno-attributes")


def load() -> ctypes.CDLL:
    """Return the library, compiled unless an equal one lies in the temporary folder.

    Raises:
        RuntimeError: torch was imported before, there is no compiler, or it fails.
    """
    if "torch" in sys.modules:
        raise RuntimeError("the pretended device must be loaded before torch")
    if COMPILER is None:
        raise RuntimeError("the pretended device needs g++")
    spec = importlib.util.find_spec("torch")
    if spec is None or spec.origin is None:
        raise RuntimeError("the pretended device needs torch")
    torch = Path(spec.origin).parent
    parts = (SOURCE.read_text(encoding="utf-8"), importlib.metadata.version("torch"), str(torch), *FLAGS)
    name = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
    library = Path(tempfile.gettempdir()) / f"scgs-pretended-cuda-{os.getuid()}" / f"{name}.so"
    if not library.is_file():
        _compile(torch, library)
    return ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)


def _compile(torch: Path, library: Path) -> None:
    library.parent.mkdir(mode=0o700, exist_ok=True)
    unfinished = library.with_suffix(f".{os.getpid()}")
    include, lib = torch / "include", torch / "lib"
    places = [f"-I{include}", f"-I{include}/torch/csrc/api/include", f"-L{lib}", f"-Wl,-rpath,{lib}"]
    command = [str(COMPILER), *FLAGS, str(SOURCE), "-o", str(unfinished), *places, "-ltorch_cpu", "-lc10"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise RuntimeError(f"{SOURCE.name} does not compile:\n{result.stderr[-4000:]}")
    unfinished.replace(library)
