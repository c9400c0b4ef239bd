"""``kill -9`` costs no more than the steps since the last checkpoint, and no bit (tests/helpers/killing.py)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.paths import ROOT

if not hasattr(os, "fork"):
    pytest.skip("children that begin at once need fork", allow_module_level=True)

FAST = ["before the first checkpoint", "half a checkpoint", "between the two renames", "while Gaussians are added"]


def killed(folder: Path, *arguments: str) -> list[dict]:
    """Return the outcomes of runs that were killed and resumed."""
    script = ROOT / "tests/helpers/killing.py"
    done = subprocess.run([sys.executable, str(script), str(folder), *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    runs = json.loads(done.stdout.splitlines()[-1])["runs"]
    assert all(run["killed"] for run in runs), runs
    return runs


def test_killed_at_the_worst_moments(tmp_path):
    runs = killed(tmp_path, *FAST)
    assert [run["same"] for run in runs] == [True] * len(FAST), runs
    assert [run["step"] > 0 for run in runs] == [False, True, True, True], runs
    assert not any(run["left"] for run in runs), "what was half written is still there"


@pytest.mark.slow
def test_killed_at_twenty_random_moments(tmp_path):
    runs = killed(tmp_path, "--random", "20")
    assert sum(run["same"] for run in runs) == 20, runs
    doing = " ".join(run["doing"] for run in runs)
    assert all(part in doing for part in ("pretrain", "main", "checkpoint")), doing


@pytest.mark.slow
def test_killed_at_every_chosen_moment(tmp_path):
    from helpers.killing import MOMENTS

    runs = killed(tmp_path, *MOMENTS)
    assert [run["same"] for run in runs] == [True] * len(MOMENTS), runs
