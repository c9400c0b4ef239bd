"""The part of ``gpu_check`` that times this project beside gsplat, and the compilation of gsplat in the background."""

from __future__ import annotations

import fcntl
import importlib.metadata
import importlib.util
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import torch
from gpu_agreement import leaves_of
from gpu_rules import GSPLAT_RATIO, alternate, at_least, compare_images
from gpu_session import Call, NotRun, Report
from gpu_speed import met, raster_calls
from torch.utils import cpp_extension

import scgs_warp
from scgs_warp.runtime.progress import clock
from scgs_warp.storage.files import write_atomically
from scgs_warp.storage.json_files import read_json

INSTALL = "pip install gsplat==1.5.3"
BUILDING, BUILT = "building", "built"
CHILD = "--build"


def version() -> str | None:
    """Return gsplat's version; None if it is not installed."""
    if importlib.util.find_spec("gsplat") is None:
        return None
    try:
        return importlib.metadata.version("gsplat")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def note() -> Path:
    """Return the file in which a build says how far it is, beside the extensions that torch compiles."""
    root = Path(os.environ.get("TORCH_EXTENSIONS_DIR") or cpp_extension.get_default_build_root())
    return root / f"scgs-gpu-check-gsplat-{version()}-torch-{torch.__version__}.json"


def _build() -> Report | None:
    """Return what the last build noted; one that has died without a word has failed."""
    if not note().exists():
        return None
    build = read_json(note())
    with open(note().with_suffix(".lock"), "a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return {**build, "state": BUILDING}
    build = read_json(note())  # it may have ended in between
    return {**build, "state": "failed", "error": "its process has died"} if build["state"] == BUILDING else build


def compiled() -> bool:
    """Return whether gsplat came with its extension."""
    return importlib.util.find_spec("gsplat.csrc") is not None


def building() -> str | None:
    """Say for how long gsplat has been compiled, if it is."""
    if version() is None or (build := _build()) is None or build["state"] != BUILDING:
        return None
    return f"gsplat is being compiled, for {clock(time.time() - build['began'])} so far"


def start_build() -> str:
    """Compile gsplat's extension in a process that outlives this one; return a line about it."""
    if version() is None:
        return f"gsplat is not installed: {INSTALL}"
    build = _build()
    if compiled() or (build is not None and build["state"] == BUILT):
        return "gsplat is compiled already"
    if build is not None and build["state"] == BUILDING:
        return "gsplat is being compiled already"
    note().parent.mkdir(parents=True, exist_ok=True)
    _write({"state": BUILDING, "began": time.time()})
    # The process inherits the lock, which thus ends with it.
    with open(note().with_suffix(".lock"), "a") as lock, open(note().with_suffix(".log"), "wb") as log:
        fcntl.flock(lock, fcntl.LOCK_EX)
        command = [sys.executable, str(Path(__file__)), CHILD]
        subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, pass_fds=[lock.fileno()]
        )
    return f"gsplat is being compiled in the background; messages in {note().with_suffix('.log')}"


def _write(content: Report) -> None:
    write_atomically(note(), json.dumps(content).encode())


def build_here() -> None:
    """Draw with gsplat, which compiles its extension on first use; note the outcome."""
    began, error = time.time(), None
    try:
        import gsplat as peer

        leaves_of(100, (32, 32), "cuda").rasterize(peer.rasterization)
    except Exception as caught:
        error = f"{type(caught).__name__}: {caught}"
    seconds = time.time() - began
    _write({"state": "failed" if error else BUILT, "error": error, "began": began, "seconds": seconds})


def gsplat(call: Call) -> Report:
    """Compare images with gsplat's, then time both renderers in turns.

    Figures of other versions that an earlier call has measured are kept.

    Raises:
        NotRun: gsplat is not installed, not compiled, or being compiled.
    """
    s = call.setting
    if s.device != "cuda":
        raise NotRun("gsplat composites on CUDA only")
    if (own := version()) is None:
        raise NotRun(f"gsplat is not installed: {INSTALL}")
    build = _build()
    if not compiled() and (build is None or build["state"] != BUILT):
        raise NotRun(
            building()
            or (f"gsplat cannot be compiled: {build['error']}" if build else "gsplat is not compiled: --build-gsplat")
        )
    import gsplat as peer

    renderers = {"ours": scgs_warp.rasterization, "theirs": peer.rasterization}
    rows, goals, passed = {}, {}, True
    for name, (count, size) in s.scenes.items():
        leaves = leaves_of(count, size, s.device)
        with torch.no_grad():
            images = compare_images(*(leaves.rasterize(function) for function in renderers.values()))
        row: Report = {"images": images, "ratio": {}}
        passed = passed and images["passed"]
        calls = {renderer: raster_calls(leaves, function) for renderer, function in renderers.items()}
        for kind in ("forward", "both"):
            times = alternate({renderer: own[kind] for renderer, own in calls.items()}, s.device, s.repeats)
            row[kind] = times
            row["ratio"][kind] = times["theirs"]["ms_median"] / times["ours"]["ms_median"]
            goals[f"{kind} at {name}, gsplat's time / ours"] = at_least(row["ratio"][kind], GSPLAT_RATIO)
        rows[name] = row
    built_in = None if build is None else build.get("seconds")
    versions = {**call.earlier.get("versions", {}), own: {"rows": rows, "goals": goals, "built_in": built_in}}
    report = {"version": own, "versions": versions, "goals": goals}
    return {**report, "passed": passed and met(report, s)}


if __name__ == "__main__" and sys.argv[1:] == [CHILD]:
    build_here()
