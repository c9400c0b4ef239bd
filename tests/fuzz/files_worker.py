"""Worker process of the campaign: reads one request per line on stdin, writes one outcome per line to stdout.

Files are damaged in place and restored. The peak of memory is reset before each case, so that no case pays for the one
before it. Address space is limited: an allocation as large as a lying header claims fails here.
"""

from __future__ import annotations

import gc
import hashlib
import importlib
import json
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fuzz.files_cases import Broken, Format
from fuzz.files_forms import mutate
from scgs_warp.errors import UserError

MODULES = ("files_data", "files_gaussians", "files_runs", "files_edits", "files_imports")
FORMATS: dict[str, Format] = {}


def load_formats(modules: Sequence[str] = MODULES) -> dict[str, Format]:
    """Register the formats of the named modules in ``FORMATS``."""
    for module in modules:
        FORMATS.update({item.name: item for item in importlib.import_module(f"fuzz.{module}").FORMATS})
    return FORMATS


HEADROOM = 3 << 30
"""Bytes of address space beyond what the idle process takes; each thread takes 8 MiB."""
MOST_RESIDENT = 700 << 20
"""Bytes that a case may allocate beyond that."""


def _status(name: str) -> int:
    """Return a line of /proc/self/status in bytes."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) << 10
    return 0


class Worker:
    """Cache of the formats' folders."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.folders: dict[str, Path] = {}
        self.files: dict[str, dict[Path, bytes]] = {}

    def prepare(self, name: str) -> None:
        """Make the folder and load it undamaged, so that one-time costs count for no case."""
        if name in self.folders:
            return
        folder = self.root / name / "scene"
        folder.parent.mkdir()
        FORMATS[name].make(folder)
        FORMATS[name].load(folder)
        self.folders[name] = folder
        self.files[name] = {path: path.read_bytes() for path in FORMATS[name].files(folder)}

    def damage(self, name: str, random: np.random.Generator) -> str:
        """Damage one file, rarely two; return which, and the kind of damage."""
        files = list(self.files[name])
        told = []
        count = min(len(files), 1 if random.random() < 0.9 else 2)
        for index in random.choice(len(files), count, replace=False):
            path = files[index]
            kind = random.random()
            if kind < 0.02:
                path.unlink(missing_ok=True)
                told.append(f"{path.name} is gone")
            elif kind < 0.04:
                path.unlink(missing_ok=True)
                path.mkdir(exist_ok=True)
                told.append(f"{path.name} is a folder")
            elif kind < 0.05:
                path.unlink(missing_ok=True)
                path.symlink_to(path.name)
                told.append(f"{path.name} is a link to itself")
            else:
                before = self.files[name][path]
                after = mutate(path.name, before, random)
                path.write_bytes(after)
                told.append(f"{path.name}: {len(before)} bytes became {len(after)}")
        return "; ".join(told)

    def restore(self, name: str) -> None:
        for path, content in self.files[name].items():
            if path.is_symlink():
                path.unlink()
            elif path.is_dir():
                shutil.rmtree(path)
            if not path.exists() or path.read_bytes() != content:
                path.write_bytes(content)

    def run(self, name: str, seed: int) -> dict[str, Any]:
        """Run one case; ``outcome`` is ``loaded``, ``refused`` or the kind of failure, ``detail`` its message."""
        self.prepare(name)
        random = np.random.default_rng([int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big"), seed])
        told = self.damage(name, random)
        if seed % 100 == 0:  # a third of a second with these packages
            gc.collect()
        Path("/proc/self/clear_refs").write_text("5")
        before, began = _status("VmRSS"), time.monotonic()
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always", RuntimeWarning)
            outcome, detail = self._outcome(name)
        took, grown = time.monotonic() - began, _status("VmHWM") - before
        if outcome in ("loaded", "refused"):
            noisy = [str(w.message) for w in warned if issubclass(w.category, RuntimeWarning | UserWarning)]
            if grown > MOST_RESIDENT:
                outcome, detail = "memory", f"{grown >> 20} MiB; {outcome}: {detail}"
            elif noisy:
                outcome, detail = "warned", noisy[0].splitlines()[0][:200]
        self.restore(name)
        return {"outcome": outcome, "detail": detail, "seconds": round(took, 3), "mib": grown >> 20, "damage": told}

    def _outcome(self, name: str) -> tuple[str, str]:
        folder = self.folders[name]
        try:
            FORMATS[name].load(folder)
        except UserError as error:
            text = str(error)
            if "\n" in text or not text.isprintable():
                return "untidy", repr(text[:300])
            if len(text) > 1500:
                return "untidy", f"{len(text)} letters: {text[:200]}"
            if str(folder) not in text and "--" not in text:
                return "untidy", f"names no file: {text[:300]}"
            return "refused", text.replace(str(folder), "")[:200]
        except Broken as error:
            return "broken law", f"{error} | {_where()}"
        except MemoryError:
            return "out of memory", _where()
        except Exception as error:
            return "traceback", f"{type(error).__name__}: {str(error)[:160]} | {_where()}"
        return "loaded", ""


def _where() -> str:
    """Return the innermost lines of a traceback that lie in this project."""
    frames = traceback.extract_tb(sys.exc_info()[2])
    own = [f"{Path(f.filename).name}:{f.lineno} {f.name}" for f in frames if "/site-packages/" not in f.filename]
    return " < ".join(reversed(own[-4:]))


def main() -> None:
    """Serve until stdin ends."""
    with tempfile.TemporaryDirectory(prefix="fuzz-files-") as root:
        worker = Worker(Path(root))
        answers = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
        os.dup2(2, 1)  # whatever prints, the protocol stays clean
        for line in sys.stdin:
            asked = json.loads(line)
            if "prepare" in asked:
                for name in asked["prepare"]:
                    worker.prepare(name)
                limit = _status("VmSize") + HEADROOM
                resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
                answer: dict[str, Any] = {"ready": True}
            else:
                answer = worker.run(asked["format"], asked["seed"])
            answers.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    from scgs_warp.runtime import environment

    environment.configure(1)
    load_formats(sys.argv[1:] or MODULES)
    main()
