"""Published figures: complete, from a named source, and consistent with themselves."""

from __future__ import annotations

import json

import pytest

from helpers.paths import ROOT
from helpers.scripts import benchmark_script
from scgs_warp.ablation.published import PUBLISHED_PSNR

RESULTS = ROOT / "benchmarks" / "results"
FILES = sorted((RESULTS / "literature").glob("*.json"))
TABLES = ("published", "published-800", "published-nerf-ds", "published-hypernerf")
RANGES = {"psnr": (10, 60), "ssim": (0.2, 1), "lpips": (0.0005, 0.5)}


@pytest.fixture(scope="module")
def literature():
    return benchmark_script("literature_tables")


@pytest.fixture(scope="module")
def report():
    return benchmark_script("report")


def contents(path):
    return json.loads(path.read_text(encoding="utf-8"))


def test_every_table_has_one_file():
    assert sorted(contents(path)["table"] for path in FILES) == sorted(TABLES)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_row_has_one_place_and_a_source(path):
    values = contents(path)
    names = [row["row"] for row in values["rows"]]
    assert len(set(names)) == len(names)
    assert {row["source"] for row in values["rows"]} == set(values["sources"])
    for source in values["sources"].values():
        assert source["checkpoint"] in ("best", "last", "not stated") and len(source["text"]) > 20
    own = {(row["label"], tuple(row["psnr"])) for row in values["rows"] if "psnr" in row}
    known = {
        tuple(figures[scene] for scene in values["scenes"] if scene in figures) for figures in PUBLISHED_PSNR.values()
    }
    assert not known & {psnr for _, psnr in own}, "name such a row by psnr_of"


@pytest.mark.parametrize("name", TABLES)
def test_figures_are_plausible_and_means_are_those_of_the_scenes(literature, name):
    found = literature.read_literature(RESULTS, name)
    for row in found.rows:
        figures = [(metric, value) for metric, scores in row.scores.items() for value in scores.values()]
        figures += row.published_mean.items()
        assert any(metric == "psnr" for metric, _ in figures), row.name
        for metric, value in figures:
            assert RANGES[metric][0] <= value <= RANGES[metric][1], (row.name, metric, value)
        differing = []
        for metric, mean in row.published_mean.items():
            computed = row.computed_mean(metric, found.scenes)
            tolerance = {"psnr": 0.011 if row.digits == 2 else 0.06, "ssim": 0.0011, "lpips": 0.0006}[metric]
            if computed is not None and abs(computed - mean) > tolerance:
                differing.append(metric)
        assert tuple(differing) == row.mean_differs, f"{row.name}: a figure is misread, or mean_differs is wrong"


def test_a_row_of_another_length_is_refused(literature, tmp_path):
    (tmp_path / "literature").mkdir()
    values = contents(FILES[0])
    values["rows"][0]["psnr"].pop()
    (tmp_path / "literature" / "x.json").write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(ValueError, match="needs 7 figures"):
        literature.read_literature(tmp_path, values["table"])
    assert literature.read_literature(tmp_path, "no-such-table") is None


def test_figures_of_the_package_stand_in_the_table(report):
    text = report.section("quality-published", RESULTS)
    figures = PUBLISHED_PSNR["control-points"]
    four = [figures[scene] for scene in ("jumpingjacks", "hook", "mutant", "standup")]
    cells = [*four, sum(four) / 4, figures["trex"], figures["bouncingballs"], figures["hellwarrior"], figures["mean"]]
    assert f"| SC-GS (80,000 steps) | {' | '.join(f'{cell:.2f}' for cell in cells)} |" in text
    assert f"| 3D-GS (static) | {PUBLISHED_PSNR['static']['jumpingjacks']:.2f} |" in report.section(
        "quality-published-800", RESULTS
    )


@pytest.mark.parametrize("name", TABLES)
def test_scenes_without_a_run_say_so_until_they_are_recorded(report, tmp_path, name):
    (tmp_path / "quality").mkdir()
    scenes = next(contents(path)["scenes"] for path in FILES if contents(path)["table"] == name)
    for index, scene in enumerate(scenes):
        text = report.section(f"quality-{name}", tmp_path)
        line = next(line for line in text.splitlines() if line.startswith("| **`cpu`**"))
        assert line.count("not run") == len(scenes) - index and "Sources" not in text
        run = {"table": name, "row": "cpu", "scene": scene, "provenance": "measured", "psnr": 30.0 + index, "ssim": 0.9}
        (tmp_path / "quality" / f"{scene}.json").write_text(json.dumps({**run, "commit": None}), encoding="utf-8")
    text = report.section(f"quality-{name}", tmp_path)
    mean = 30 + (len(scenes) - 1) / 2
    assert "not run |" not in next(line for line in text.splitlines() if line.startswith("| **`cpu`**"))
    assert f"| {mean:.2f} | 0.900 | last | this project |" in text
