"""Apps as a user runs them: in a process of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from helpers.paths import ROOT

SMALL = ["--preset", "cpu", "--set", "motion.layers=3", "--set", "motion.width=32", "--set", "motion.skip=2",
         "--set", "init_points=300", "--nodes", "16", "--device", "cpu"]  # fmt: skip


def run_app(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess:
    """Run ``apps/NAME.py`` with the words after its name."""
    app, *rest = arguments
    command = [sys.executable, str(ROOT / "apps" / f"{app}.py"), *rest]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=300)
