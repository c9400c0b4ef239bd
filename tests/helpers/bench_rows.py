"""Tiny benchmarks, and checks of every row of them."""

from __future__ import annotations

import json

import pytest

from scgs_warp.apps import bench as app
from scgs_warp.benchmark import plan as bench_plan

TINY = ["--gaussians", "120", "--nodes", "12", "--size", "48", "--seconds", "0", "--threads", "1"]


def report_of(tmp_path, *arguments: str) -> dict:
    path = tmp_path / "rows.json"
    assert app.cli([*arguments, "--json", str(path)]) == 0
    report = json.loads(path.read_text(encoding="utf-8"))
    assert report["date"] and report["machine"]["processor"] and report["machine"]["cores"] >= 1
    assert "host" not in path.read_text(encoding="utf-8") and str(tmp_path) not in path.read_text(encoding="utf-8")
    return report


def rows_of(tmp_path, *arguments: str) -> list[dict]:
    return report_of(tmp_path, *arguments)["rows"]


def check_rows(rows: list[dict], device: str) -> None:
    for row in rows:
        assert tuple(row) == bench_plan.KEYS
        assert row["device"] == device and row["threads"] == 1 and (row["width"], row["height"]) == (48, 48)
        assert 0 <= row["ms_min"] <= row["ms_median"]
        assert row["pairs"] > 0 and 1 <= row["contributors"] < 120 and row["two_thread_scaling"] > 0.3
        assert row["peak_mib"] > row["extra_mib"] >= 0 and row["model_mib"] > 0
        assert 0 < row["covered"] <= 48 * 48
        assert (row["fps"] is None) != (row["share"] is None)
    whole = None
    shares = {}
    for row in rows:
        if row["share"] is None:
            assert row["fps"] == pytest.approx(1e3 / row["ms_median"])
            whole = row["name"], row["motion"]
            shares[whole] = []
        else:
            assert whole is not None and row["name"].startswith(f"{whole[0]}/") and row["motion"] == whole[1]
            shares[whole].append(row["share"])
    assert all(sum(values) == pytest.approx(1.0) for values in shares.values())
