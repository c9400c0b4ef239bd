"""Summaries of rows: the cost of motion, and the paper's Table S2."""

from __future__ import annotations

import pytest

from helpers.bench_rows import TINY, report_of
from scgs_warp.benchmark import summary
from scgs_warp.benchmark import timing as bench_clock
from scgs_warp.config.presets import MOTIONS

pytestmark = pytest.mark.usefixtures("all_threads")


def test_the_paper_s_table_is_put_beside(tmp_path, capsys):
    report = report_of(tmp_path, "frame", *TINY, "--table-s2", "--device", "cpu")
    table = {row["motion"]: row for row in report["table_s2"]}
    compared = {row["motion"]: row for row in report["compared"]}
    assert set(table) == set(compared) == set(MOTIONS)
    for name, row in table.items():
        assert row["threads"] == 1 and row["fps"] == pytest.approx(1e3 / compared[name]["ms_median"])
        assert row["ratio_to_static"] == compared[name]["ratios"]["static"] > 0
        assert row["ratio_to_per_gaussian"] == compared[name]["ratios"]["per-gaussian"] > 0
    assert table["static"]["ratio_to_static"] == table["per-gaussian"]["ratio_to_per_gaussian"] == 1.0
    assert table["control-points"]["paper_ratio_to_per_gaussian"] == pytest.approx(2.61, abs=0.005)
    printed = capsys.readouterr().out
    assert "(paper: 295.4 frames/s, 0.99, 2.61 x)" in printed and "(paper: 145.8 frames/s, 0.49, 1.29 x)" in printed


def test_what_motion_costs(tmp_path, capsys):
    report = report_of(tmp_path, "frame", *TINY, "--motion", "control-points,static", "--device", "cpu")
    (cost,) = report["motion"]
    median = {row["name"]: row["ms_median"] for row in report["rows"] if row["motion"] == "control-points"}
    assert cost["ms_median"] == pytest.approx(median["frame/network"] + median["frame/skin"])
    assert cost["ratio_to_static"] == report["compared"][0]["ratios"]["static"]
    assert "of static's frames/s" in capsys.readouterr().out
    assert summary.motion_costs(report["rows"], []) == [{**cost, "ratio_to_static": None}]


def test_what_disturbs_the_machine_meets_all_models_alike(monkeypatch):
    """The second takes twice as long as the first, and the machine is ten times slower in every other turn."""
    clock = [0.0]
    monkeypatch.setattr(bench_clock.time, "perf_counter", lambda: clock[0])

    def drawer(cost: float):
        def draw(index: int) -> None:
            clock[0] += cost * (10 if index % 2 else 1)

        return draw

    first, second = summary.compare_frames({"a": drawer(1.0), "b": drawer(2.0)}, 1, 30.0, "cpu")
    assert first["ratios"] == pytest.approx({"a": 1.0, "b": 2.0}) and second["ratios"]["a"] == pytest.approx(0.5)
    assert second["ms_min"] == pytest.approx(2e3) and first["fps"] == pytest.approx(1e3 / first["ms_median"])
