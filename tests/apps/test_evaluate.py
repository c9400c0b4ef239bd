"""apps/evaluate.py as a user runs it."""

from __future__ import annotations

import json

from helpers.app_runs import run_app


def test_evaluate(trained, tmp_path):
    path = tmp_path / "metrics.json"
    done = run_app("evaluate", "--run", str(trained), "--json", str(path), "--device", "cpu")
    assert done.returncode == 0, done.stderr
    assert json.loads(path.read_text())["psnr"] == json.loads((trained / "metrics.json").read_text())["psnr"]


def test_a_folder_without_a_run(tmp_path):
    done = run_app("evaluate", "--run", str(tmp_path))
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, done.stderr
