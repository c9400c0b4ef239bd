"""Tasks that a machine of a cluster runs for an ablation: describe the machine, and train a cell.

Arguments and results are plain data; nothing here depends on Ray.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import json
import os
import socket
import tempfile
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from .. import __version__
from ..errors import UserError
from ..runtime import environment, memory
from ..runtime.provenance import processor
from ..storage.files import read_text, write_atomically
from ..training.run_folder import LOCK
from .cells import LOG, attempt, cell_from_json

WORKER = "worker.json"
"""File in a cell's folder with the machine and the process that train the cell, or trained it last."""
PACKAGES = ("torch", "warp-lang", "numpy")
"""Packages whose versions must agree, since other versions may round differently."""
LOCK_SECONDS = 150.0
"""Longest wait for a lost worker's lock: a file server releases a dead machine's locks after a lease, NFS after 90
s."""
SMALL = 1 << 22
"""Largest size in bytes of a file whose content is part of a fingerprint; a larger file contributes its size only."""


def source_hash() -> str:
    """Hash the code that trains: the package without its apps, wherever its parts are installed."""
    digest = hashlib.sha256()
    for name in ("scgs_warp", "scgs_warp.kernels"):
        spec = importlib.util.find_spec(name)
        assert spec is not None and spec.submodule_search_locations
        root = Path(spec.submodule_search_locations[0])
        files = {path.relative_to(root).as_posix(): path for path in root.rglob("*.py")}
        for relative, path in sorted(files.items()):
            if name == "scgs_warp" and relative.partition("/")[0] in ("kernels", "apps"):
                continue  # An installed package contains these folders; in a clone they lie elsewhere.
            content = path.read_bytes().replace(b"\r\n", b"\n")
            digest.update(f"{name}/{relative} {len(content)}\n".encode())
            digest.update(content)
    return digest.hexdigest()


def identity() -> dict[str, str]:
    """Return the properties that two machines must share: the version, the code and the packages that compute."""
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {"scgs_warp": __version__, "code": source_hash()[:12], **versions}


def identity_difference(actual: dict[str, str], wanted: dict[str, str]) -> str | None:
    """Return the first difference of two identities, such as ``torch 2.8.0, not 2.9.0``; None if they agree."""
    for name, value in wanted.items():
        if actual.get(name) != value:
            return f"{name} {actual.get(name)}, not {value}"
    return None


def fingerprint(folder: Path) -> str:
    """Hash the files directly in a data folder, small ones with their content, to recognise copies.

    Raises:
        OSError: the folder cannot be read.
    """
    digest = hashlib.sha256()
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or not path.is_file():
            continue
        size = path.stat().st_size
        digest.update(f"{path.name} {size}\n".encode())
        if size <= SMALL:
            digest.update(path.read_bytes())
    return digest.hexdigest()


def inspect_machine(question: dict[str, Any]) -> dict[str, Any]:
    """Describe this machine, and check whether it can train the cells.

    Args:
        question: ``token_file`` in the folder of the cells, which the driver holds locked, and the ``token`` in it;
            ``data``, fingerprints by folder; ``weights``, a file, or None.

    Returns:
        ``host``, ``identity``, ``processor``, and ``problem`` in one line, None if the machine can train them.
    """
    return {
        "host": socket.gethostname(),
        "identity": identity(),
        "processor": processor(),
        "problem": _folder_problem(Path(question["token_file"]), question["token"]) or _data_problem(question),
    }


def _folder_problem(file: Path, token: str) -> str | None:
    """Check that the cells' folder is the shared one, can be written, and shows the locks of other machines."""
    try:
        same = read_text(file) == token
    except OSError:
        same = False
    if not same:
        return f"does not see --output {file.parent}; it must be one folder for all machines (a file server)"
    try:
        with tempfile.TemporaryFile(dir=file.parent):
            pass
    except OSError as error:
        return f"cannot write to --output {file.parent} ({error.strerror})"
    try:
        if os.name == "posix" and is_unlocked(file):
            return (
                f"takes a lock in --output {file.parent} that another machine holds: two could train one cell; "
                "mount it with locks for all (NFS 4; Lustre with -o flock)"
            )
    except OSError as error:
        return f"knows no locks in --output {file.parent} ({error.strerror}); mount it with locks (NFS 4)"
    return None


def is_unlocked(file: Path) -> bool:
    """Return whether ``file`` is free of locks of all processes; True where there are no such locks (Windows).

    Raises:
        OSError: the file cannot be opened, or the file system has no locks.
    """
    try:
        import fcntl
    except ImportError:
        return True
    descriptor = os.open(file, os.O_RDWR)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    finally:
        os.close(descriptor)
    return True


def _data_problem(question: dict[str, Any]) -> str | None:
    for folder, expected in question["data"].items():
        try:
            actual = fingerprint(Path(folder))
        except OSError as error:
            return f"cannot read --data {folder} ({error.strerror}); it must be there under the same path everywhere"
        if actual != expected:
            return f"has another --data {folder}; it must hold the same files everywhere"
    weights = question["weights"]
    if weights is not None and not Path(weights).is_file():
        return f"has no --lpips-weights {weights}; it must be there under the same path everywhere"
    return None


def train_cell(order: dict[str, Any]) -> dict[str, Any]:
    """Train and measure a cell, or complete what is left to do.

    Args:
        order: ``cell`` as JSON; ``threads``; ``identity`` that this machine must have; ``sweep`` and ``attempt``, by
            which the driver recognises ``worker.json``; ``wait``, seconds for a lost worker's lock; ``memory``, bytes
            that the cell may take, or None; ``siblings``, cells at a time on this machine.

    Returns:
        ``failure``, one line, or None; and ``stopped``: whether a signal ended it, with the checkpoint saved.
    """
    environment.configure(order["threads"])
    os.environ[memory.SIBLINGS_VARIABLE] = str(order["siblings"])
    if order["memory"] is not None:
        memory.set_limit(order["memory"] / memory.GIB)
    cell = cell_from_json(order["cell"])
    folder = Path(cell.folder)
    worker = {"sweep": order["sweep"], "attempt": order["attempt"], "host": socket.gethostname(), "pid": os.getpid()}
    try:
        differs = identity_difference(identity(), order["identity"])
        if differs is not None:  # The machine joined the cluster after it was inspected.
            failure = f"{worker['host']} has {differs}; install the same everywhere, and change nothing meanwhile"
            return {"failure": failure, "stopped": False}
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / WORKER, json.dumps(worker).encode())
        with open(folder / LOG, "a", buffering=1, encoding="utf-8") as log, redirect_stdout(log), redirect_stderr(log):
            print(f"on {worker['host']}, process {worker['pid']}")
            _wait_for_lock(folder / LOCK, order["wait"])
            _check_device(cell.device, worker["host"])
            failure = attempt(cell)
    except KeyboardInterrupt:
        return {"failure": None, "stopped": True}
    except (UserError, OSError) as error:
        return {"failure": " ".join(str(error).split()), "stopped": False}
    return {"failure": failure, "stopped": False}


def _wait_for_lock(file: Path, seconds: float) -> None:
    """Wait, for at most ``seconds``, until a lost worker's lock is released."""
    until = time.monotonic() + seconds
    if seconds <= 0.0 or not file.is_file() or is_unlocked(file):
        return
    print(f"waiting for the lock {file}")
    while time.monotonic() < until and not is_unlocked(file):
        time.sleep(1.0)


def _check_device(device: str, host: str) -> None:
    if device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise UserError(f"{host}: torch finds no CUDA GPU there; install a CUDA build of torch, or --device cpu")
