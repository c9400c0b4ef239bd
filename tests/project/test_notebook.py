"""The tutorial notebook runs from its first cell to its last."""

from __future__ import annotations

import json
import os
import subprocess
import sys

from helpers.paths import ROOT
from helpers.tiny import write_dnerf

NOTEBOOK = ROOT / "examples/tutorial.ipynb"
QUICK = {"DATA = None": 'DATA = "blobs"', "STEPS = 7_000": "STEPS = 60"}
"""Replacements with which the notebook takes seconds."""


def cells() -> list[str]:
    """Return the code of the notebook, cell by cell."""
    content = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert content["nbformat"] == 4
    return ["".join(cell["source"]) for cell in content["cells"] if cell["cell_type"] == "code"]


def test_the_notebook_runs(tmp_path):
    write_dnerf(tmp_path / "blobs")
    code = "\n\n".join(cells())
    for given, quick in QUICK.items():
        assert code.count(given) == 1
        code = code.replace(given, quick)
    (tmp_path / "tutorial.py").write_text(code, encoding="utf-8")
    environ = {**os.environ, "MPLBACKEND": "agg", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "tutorial.py"], cwd=tmp_path, env=environ, capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stderr
    assert "held-out views" in done.stdout and "Gaussians" in done.stdout
    for name in ("turntable.mp4", "edit.json", "moment.ply", "scene.html", "runs/tutorial/metrics.json"):
        assert (tmp_path / name).stat().st_size > 300, name


def test_it_is_committed_without_outputs():
    content = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    for cell in content["cells"]:
        assert cell["cell_type"] == "markdown" or (cell["outputs"] == [] and cell["execution_count"] is None)
