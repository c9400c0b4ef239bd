"""The block forms of compositing against the plain form, on CUDA where there is one; else the portable one on the CPU's
block emulation (the native one: ``test_compositing_native``).

The emulation is a setting of the process that must be made before a kernel is compiled, so it runs in one of its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
import torch

from helpers.compositing_forms import CASES, largest_differences, run_form
from helpers.paths import TESTS


@pytest.fixture(scope="module")
def differences() -> dict[str, list[float]]:
    """All cases at once: one process, one compilation."""
    if torch.cuda.is_available():
        found = {f"{case}, native": largest_differences(case, "cuda", "cuda") for case in CASES}
        return found | {case: largest_differences(case, "blocks", "cuda") for case in CASES}
    result = subprocess.run(
        [sys.executable, str(TESTS / "helpers/compositing_forms.py")],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": str(TESTS)},
        check=False,
    )
    assert result.returncode == 0, result.stderr[-3000:]
    return json.loads(result.stdout.splitlines()[-1])


@pytest.mark.parametrize("case", CASES)
def test_same_as_the_pixel_form(case, differences):
    assert max(differences[case]) < 1e-5, differences[case]
    if torch.cuda.is_available():
        # The native form's exponentials and divisions are the device's own.
        assert max(differences[f"{case}, native"]) < 1e-4, differences[f"{case}, native"]


def test_the_cases_contain_what_they_are_for():
    """Enough splats in a tile for several batches, and pixels that stop early in the opaque case."""
    _, alpha, *_ = run_form("several batches and early stop", "plain", "cpu")
    assert (alpha > 0.99).float().mean() > 0.5
    image, _, *gradients = run_form("faint, several batches", "plain", "cpu")
    assert image.shape == (1, 9, 16)
    assert (gradients[0] != 0).any(1).sum() > 256


def test_blocks_without_a_gpu_raise_instead_of_running_one_lane():
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(RuntimeError, match="enable_cpu_blocks"):
        run_form("one tile", "blocks", "cpu")
