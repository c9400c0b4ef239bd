"""Provenance of a result: date, command, commit, processor and versions."""

from __future__ import annotations

import contextlib
import importlib.metadata
import platform
import shlex
import subprocess
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import torch
import warp as wp

from . import environment


def processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Return the processor's name as the system gives it.

    A name without a number, as virtual machines have, is followed by family and model, which tell generations apart.
    """
    with contextlib.suppress(OSError):
        lines = cpuinfo.read_text(encoding="utf-8").partition("\n\n")[0].splitlines()
        fields = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
        name = fields.get("model name")
        if name and not any(sign.isdigit() for sign in name) and {"cpu family", "model"} <= fields.keys():
            return f"{name}, family {fields['cpu family']} model {fields['model']}"
        if name:
            return name
    return platform.processor() or platform.machine()


def machine(device: str) -> dict[str, Any]:
    """Describe the machine, without its name or paths."""
    return {
        "processor": processor(),
        "cores": environment.available_threads(),
        "gpu": torch.cuda.get_device_name() if device == "cuda" else None,
        "system": platform.system(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "warp": wp.__version__,
        "scgs_warp": _version(),
    }


def _version() -> str | None:
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version("scgs_warp")
    return None


def command_line(script: str, words: Sequence[str]) -> str:
    """Write a command for a checkout; absolute paths keep only their last part, since folders differ by machine."""
    parts = (word.rpartition("=") for word in words)  # --data DIR as well as --data=DIR
    names = (f"{name}{sign}{Path(value).name if Path(value).is_absolute() else value}" for name, sign, value in parts)
    return f"python {script} {shlex.join(names)}".rstrip()


def commit() -> str | None:
    """Return the commit of the measured checkout, with ``-dirty`` if its code was changed; None outside of one."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    code = [".", ":(exclude)docs", ":(exclude)*.md", ":(exclude)benchmarks/results"]
    try:
        head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True, check=True)
        differs = subprocess.run(["git", "diff", "--quiet", "HEAD", "--", *code], cwd=root, check=False).returncode
    except (OSError, subprocess.CalledProcessError):
        return None
    return head.stdout.strip() + ("-dirty" if differs else "")


def provenance(device: str) -> dict[str, Any]:
    """Return ``date``, ``commit`` and ``machine`` of a measurement."""
    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return {"date": now, "commit": commit(), "machine": machine(device)}
