"""The SIMD forms on other processors: the tests of their stages pass there, and every module of them has run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from other_processors.program import PROCESSORS, why_not

from scgs_warp.kernels import cpu

TESTS = Path(__file__).resolve().parents[1]
STAGES = (
    "adam", "binning", "compositing", "compositing_extremes", "correctives", "finishing", "harmonics", "neighbors",
    "network", "posing", "projection", "shading", "silhouette", "skinning", "ssim",
)  # fmt: skip
LEFT_OUT = "gsplat or thread or wrong or any_s or many_splats or refus or not_fit or nothing_to_do or in_parts"
"""Tests that do not concern the processor, or that take long where it is emulated."""
NOT_RUN = {"roofline", "sharing"}
"""Modules that compute nothing."""


def ledger_of(processor: str, stages: Sequence[str], folder: Path) -> dict[str, dict]:
    """Run the tests of these stages there, and return what was launched and differed, by kernel."""
    if reason := why_not(processor):
        pytest.skip(reason)
    environment = {
        **os.environ,
        "SCGS_PROCESSOR": processor,
        "SCGS_PROCESSOR_LEDGER": str(folder / "ledger.json"),
        "PYTHONPATH": str(TESTS),
        "SCGS_NEEDS": "",
    }
    files = [str(TESTS / "kernels" / f"test_{stage}.py") for stage in stages]
    words = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-n",
        "0",
        "-p",
        "other_processors.plugin",
        "-k",
        f"not ({LEFT_OUT})",
        *files,
    ]
    result = subprocess.run(words, cwd=TESTS.parent, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout[-6000:] + result.stderr[-2000:]
    return json.loads((folder / "ledger.json").read_text(encoding="utf-8"))


def test_one_stage_agrees_on_avx2(tmp_path):
    ledger = ledger_of("avx2", ["adam"], tmp_path)
    assert ledger["adam.adam_step"]["launches"] > 0
    assert ledger["adam.adam_step"]["largest_difference"] < 1e-6


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("processor", PROCESSORS)
def test_all_stages_agree_on_other_processors(processor, tmp_path):
    ledger = ledger_of(processor, STAGES, tmp_path)
    for kernel, row in ledger.items():
        print(f"{processor} {kernel}: {row}")
    modules = {path.stem for path in Path(cpu.__path__[0]).glob("*.py")} - {"__init__"} - NOT_RUN
    assert {kernel.partition(".")[0] for kernel in ledger} == modules
