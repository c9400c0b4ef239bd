"""The tables of a check on a GPU."""

from __future__ import annotations

import json
from pathlib import Path

from helpers.scripts import benchmark_script

COMMIT = "2bd452c63deb78b3d9949913ba18313470cbd8f8"
MACHINE = {"torch": "2.11.0", "warp": "1.19.0"}


def written(folder: Path, **parts: dict) -> list[str]:
    """Return the lines of the tables of a report with these parts."""
    report = {"commit": COMMIT, "gpu": "NVIDIA H200", "machine": MACHINE, "parts": parts}
    (folder / "gpu_check_cuda.json").write_text(json.dumps(report), encoding="utf-8")
    return benchmark_script("gpu_table").gpu_table(folder).splitlines()


def test_nothing_is_claimed_without_a_result(tmp_path):
    assert benchmark_script("gpu_table").gpu_table(tmp_path) == "Not measured yet."


def test_checks_show_failures_and_counts(tmp_path):
    tests = {"state": "failed", "total": 1463, "skipped": 23, "failures": {"a": "text", "b": "text"}, "seconds": 201.0}
    lines = written(tmp_path, tests=tests, agreement={"state": "passed", "seconds": 44.7})
    assert lines[0].startswith("`python benchmarks/gpu_check.py` at commit 2bd452c") and "NVIDIA H200" in lines[0]
    assert "| images and gradients against the CPU's, all motion models | passed | 45 s |" in lines
    row = "| all tests that need a GPU | failed: 1,438 passed, 23 skipped, 2 failed | 3 min 21 s |"
    assert row in lines and "milliseconds" not in "".join(lines)


def test_times_stand_beside_what_they_are_compared_with(tmp_path):
    one = {"ours": {"ms_median": 2.0}, "theirs": {"ms_median": 3.0}}
    gsplat = {"1M": {"forward": one, "both": one, "ratio": {"forward": 1.5, "both": 1.5}}}
    steps = {"recorded": {"ms_median": 1.5}, "plain": {"ms_median": 11.0}}
    best = {"data": "hook", "steps": 500, "of": 1000, "seconds_of_training": 1.0, "finished": False}
    lines = written(
        tmp_path,
        frame={"rows": [{"motion": "static", "ms_median": 0.5, "fps": 3649.1, "motion_ms": 0.01}]},
        step={"in_turns": {"step/arap": steps}},
        gsplat={"versions": {"1.5.3": {"rows": gsplat}}},
        best=best,
    )
    assert any("static | 0.50 | 3,649 frames a second with two under way; motion 0.01 ms |" in line for line in lines)
    assert any("with ARAP | 1.50 | recorded; 11.0 operation by operation |" in line for line in lines)
    assert any("1M Gaussians, image | 2.00 | gsplat 1.5.3 takes 3.00, 1.50 of our time |" in line for line in lines)
    assert any("`hook` with `best`" in line and "| 2.00 | 500 of 1,000 steps in 1 s |" in line for line in lines)
    done = {**best, "steps": 1000, "finished": True, "psnr": 43.014, "gaussians": 93_873}
    assert any(
        line.endswith("1,000 of 1,000 steps in 1 s; 43.01 dB, 93,873 Gaussians |")
        for line in written(tmp_path, best=done)
    )


def test_parts_not_run_are_taken_from_the_newest_earlier_report(tmp_path):
    for commit, date, state in (("a" * 40, "2026-01-01", "failed"), (COMMIT, "2026-02-01", "passed")):
        parts = {"sanitizer": {"state": state, "seconds": 50.0}, "bits": {"state": "failed", "seconds": 1.0}}
        report = {"commit": commit, "date": date, "gpu": "NVIDIA H200", "machine": MACHINE, "parts": parts}
        (tmp_path / f"gpu_check_cuda-{commit[:7]}-1.json").write_text(json.dumps(report), encoding="utf-8")
    lines = written(tmp_path, sanitizer={"state": "not run"}, bits={"state": "passed", "seconds": 9.0})
    subject = "compute-sanitizer, memcheck and racecheck: a frame and a step, operation by operation"
    (row,) = (line for line in lines if subject in line)
    assert row.replace(" ‡", "") == f"| {subject} | passed, at 2bd452c | 50 s |"
    assert any("the same bits | passed | 9 s |" in line for line in lines)
