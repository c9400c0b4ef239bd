"""The tables and pictures of ablations say what the cells say."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from PIL import Image as Picture

from helpers.cells import craft
from helpers.tiny import write_dnerf
from scgs_warp.ablation import cells as ablate
from scgs_warp.ablation import table
from scgs_warp.ablation.markdown import markdown
from scgs_warp.config import presets
from scgs_warp.errors import UserError


def test_means_spreads_and_gaps(tmp_path):
    for scene, base in (("hook", 30.0), ("figure", 40.0)):
        for seed in (0, 1):
            craft(tmp_path, "nodes", "64", seed, scene, psnr=base + seed, control_points=66)
    craft(tmp_path, "nodes", "128", 0, "hook", psnr=33.0)
    report = table.build("nodes", tmp_path)
    mean, figure, hook = report["tables"]
    assert mean["rows"][0]["psnr"] == {"mean": 35.5, "std": pytest.approx(0.5**0.5), "count": 4}
    assert mean["rows"][1]["psnr"] is None, "a mean over fewer scenes would be another figure"
    assert hook["name"] == "hook" and hook["rows"][1]["psnr"] == {"mean": 33.0, "std": None, "count": 1}
    assert hook["rows"][0]["to_best"] == pytest.approx(-2.5) and hook["rows"][1]["to_best"] == 0
    assert figure["rows"][1]["psnr"] is None
    assert mean["rows"][0]["published"]["psnr"] == 42.65 and mean["rows"][0]["published"]["control_points"] == 67
    text = markdown(report)
    assert "12,000 steps in every cell" in text and "35.50 ± 0.71" in text and "LPIPS" in text
    assert "per_image" not in json.dumps(report)


def test_missing_cells_are_dashes(tmp_path):
    blobs = write_dnerf(tmp_path / "data/blobs", 32)
    cells = ablate.plan("motion", presets.preset("cpu"), {"blobs": blobs}, tmp_path)
    text = markdown(table.build("motion", tmp_path, cells))
    rows = [line for line in text.splitlines() if line.startswith("| control-points")]
    assert len(rows) == 1 and rows[0].split("|")[4].strip() == "-"
    assert "4 of 4 cells are missing" in text


def test_leads_beside_the_published(tmp_path):
    for value, psnr in (("static", 20.0), ("hexplane", 30.0), ("control-points", 38.0)):
        craft(tmp_path, "motion", value, psnr=psnr)
    rows = {row["value"]: row for row in table.build("motion", tmp_path)["tables"][0]["rows"]}
    assert rows["static"]["lead"] == 18.0 and rows["hexplane"]["lead"] == 8.0
    assert rows["control-points"]["lead"] is None
    assert rows["hexplane"]["published"]["lead"] == pytest.approx(39.87 - 30.99)
    assert rows["hexplane"]["published_mean"]["lead"] == pytest.approx(43.31 - 34.01)


@pytest.mark.parametrize("model", list(table.PUBLISHED_PSNR))
def test_published_means_are_those_of_the_published_scenes(model):
    known = dict(table.PUBLISHED_PSNR[model])
    mean = known.pop("mean")
    assert len(known) == 7
    assert sum(known.values()) / 7 == pytest.approx(mean, abs=0.01)


def test_motion_error_beside_the_baseline(tmp_path):
    for value, epe, jitter in (("on", 1.0, 0.1), ("off", 1.5, 0.3), ("per-gaussian", 4.0, 0.5)):
        craft(tmp_path, "arap", value, scene="figure", psnr=33.0, epe=epe, jitter=jitter)
    report = table.build("arap", tmp_path)
    rows = {row["value"]: row for row in report["tables"][0]["rows"]}
    assert rows["on"]["epe_share"] == 0.25 and rows["on"]["jitter_share"] == pytest.approx(0.2)
    assert rows["off"]["epe_share"] == 0.375 and rows["per-gaussian"]["epe_share"] is None
    assert "EPE [%]" in markdown(report) and "per-gaussian (baseline)" in markdown(report)


def test_unequal_cells_make_no_table(tmp_path):
    craft(tmp_path, "nodes", "64", psnr=30.0)
    craft(tmp_path, "nodes", "128", psnr=31.0, steps=6_000)
    with pytest.raises(UserError, match=r"hook/(64|128): made with steps = "):
        table.build("nodes", tmp_path)


def test_ablations_share_a_folder(tmp_path):
    craft(tmp_path, "nodes", "64", psnr=30.0)
    craft(tmp_path, "motion", "static", psnr=20.0)
    craft(tmp_path, "arap", "off", psnr=29.0)
    craft(tmp_path, "zoo", "zoo", psnr=28.0)
    assert [table.build(name, tmp_path)["values"] for name in ablate.ABLATIONS] == [
        ("64",),
        ("static",),
        ("off",),
        ("zoo",),
    ]


@pytest.mark.parametrize("name", ablate.ABLATIONS)
@pytest.mark.parametrize("there", ["all", "one", "none"])
def test_pictures(name, there, tmp_path):
    """Drawn whatever is there; more cells, more ink."""
    values = ablate.VALUES[name]
    for value in {"all": values, "one": values[-1:], "none": ()}[there]:
        for scene in ("hook", "jumpingjacks"):
            craft(tmp_path, name, value, scene=scene, psnr=30.0 + len(value), epe=1.0, jitter=0.1, control_points=64)
    cells = []
    blobs = write_dnerf(tmp_path / "data/blobs", 32)
    if there == "none":
        cells = ablate.plan(name, presets.with_steps(presets.preset("cpu"), 12_000), {"blobs": blobs}, tmp_path)
    paths = table.write(table.build(name, tmp_path, cells), tmp_path)
    assert [path.name for path in paths] == [f"{name}.json", f"{name}.md", f"{name}.png"]
    pixels = np.asarray(Picture.open(io.BytesIO(paths[2].read_bytes())).convert("RGB"))
    ink = (pixels.astype(int).max(2) - pixels.min(2) > 60).mean()
    assert 300 < pixels.shape[0] < 700 and 400 < pixels.shape[1] < 2500
    assert ink > {"all": 0.004, "one": 0.0005, "none": 0.0}[there], "coloured curves or bars"
