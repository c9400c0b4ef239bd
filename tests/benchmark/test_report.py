"""The scripts beside the benchmarks: tables come from the JSON files, and OpenSplat's side is fed what ours is."""

from __future__ import annotations

import importlib.util
import json
import sys

import pytest
import torch

from helpers.paths import ROOT
from scgs_warp.apps import bench as app
from scgs_warp.benchmark import roofline
from scgs_warp.errors import UserError
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.compositing import composite
from scgs_warp.types import Splats

pytestmark = pytest.mark.usefixtures("all_threads")

TINY = ["--gaussians", "120", "--nodes", "12", "--size", "48", "--seconds", "0", "--device", "cpu"]


def script(name: str):
    spec = importlib.util.spec_from_file_location(f"benchmarks_{name}", ROOT / "benchmarks" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def page_of(names) -> str:
    return "# Page\n\n" + "\n".join(f"<!-- begin {name} -->\nold\n<!-- end {name} -->\n" for name in names) + "end\n"


def test_the_page_is_what_the_results_give():
    assert script("report").main(["--check"]) == 0


def test_every_table_from_tiny_results(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(roofline, "BLOCKS", 2)
    report = script("report")
    commands = {
        "frame-cpu": ["frame", *TINY, "--motion", "control-points,static", "--threads", "1"],
        "raster-cpu": ["raster", *TINY],
        "step-cpu": ["step", *TINY, "--threads", "1"],
        "edit-cpu": ["edit", *TINY, "--threads", "1"],
        "table-s2-cpu": ["frame", *TINY, "--table-s2", "--threads", "1"],
        "scaling-cpu": ["scaling", *TINY, "--sweeps", "nodes:6/12", "--figures", str(tmp_path / "figures")],
    }
    for name, arguments in commands.items():
        assert app.cli([*arguments, "--json", str(tmp_path / f"{name}.json")]) == 0
    capsys.readouterr()
    page = tmp_path / "page.md"
    page.write_text(page_of(report.TABLES), encoding="utf-8")
    options = ["--results", str(tmp_path), "--page", str(page)]
    assert report.main([*options, "--check"]) == 1
    assert "old" in page.read_text(encoding="utf-8")
    assert report.main(options) == 0 and report.main([*options, "--check"]) == 0
    text = page.read_text(encoding="utf-8")
    assert "old" not in text and text.endswith("end\n")
    assert text.count("Not measured yet") == 2 and "1000000 --size 1920x1080" in text
    first = json.loads((tmp_path / "frame-cpu.json").read_text(encoding="utf-8"))["rows"][0]
    assert f"| **frame** | {first['ms_median']:,.1f} | {first['ms_min']:,.1f} |" in text
    for said in (
        "frame/skin",
        "**raster/both**",
        "**step/arap**",
        "edit/drag/solve",
        "(network and skinning)",
        "| hexplane | 1 |",
    ):
        assert said in text
    for said in ("GFLOP/s", "MiB more", "| nodes | pairs |", "of the frames/s of `static`"):
        assert said in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len(lines) > 40 and all(line.endswith("|") for line in lines)


def test_a_page_without_a_marker(tmp_path):
    report = script("report")
    with pytest.raises(ValueError, match="raster-cpu"):
        report.fill(page_of(name for name in report.TABLES if name != "raster-cpu"), tmp_path)


def test_two_threads_that_were_none_are_said():
    rows = [{"share": None, "device": "cpu", "threads": n, "two_thread_scaling": 1.5} for n in (1, 2)]
    report = script("report")
    assert "quote the one-thread column" in report.scaling_line(rows)
    assert "quote" not in report.scaling_line(rows[:1]) and report.scaling_line([{**rows[0], "device": "cuda"}]) == ""


class Stand:
    """OpenSplat's two functions, done with our own code: what is fed to it, and in which units, shows here."""

    def __init__(self, brighter: float = 1.0) -> None:
        self.brighter = brighter

    def forward(self, width, height, xys, conics, colors, opacities, background, cov2d, depths):
        inverse = torch.linalg.inv(cov2d)
        packed = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
        ratio = (conics / packed)[:, 0].median()
        assert torch.allclose(conics, ratio * packed, rtol=1e-2, atol=1e-5)
        leaves = [value.clone().requires_grad_() for value in (xys, conics, colors, opacities)]
        means, shapes, tints, opaque = leaves
        radii = torch.full((len(xys), 2), 99, dtype=torch.int32)
        splats = Splats(means + 0.5, shapes, depths, opaque[:, 0], radii, width, height)
        image, alpha = composite(splats, tints, bin_splats(splats), background)
        image = (self.brighter * image).permute(1, 2, 0)
        return image.detach(), 1 - alpha.detach(), (image, leaves)

    def backward(self, width, height, *arguments):
        lists, v_image, v_alpha = arguments[-3:]
        assert v_image.shape == (height, width, 3) and v_alpha.shape == (height, width) and len(arguments) == 11
        return torch.autograd.grad(lists[0], lists[1], v_image, retain_graph=True)


def test_both_sides_get_the_same_splats():
    opensplat = script("opensplat")
    found = opensplat.compare(Stand(), 150, (60, 50), 0.0)
    assert found["pictures"]["as_it_is"]["largest"] < 1e-4 and (found["width"], found["height"]) == (60, 50)
    assert max(found["gradients_relative"].values()) < 1e-3
    median = {name: row["ms_median"] for name, row in found["rows"].items()}
    assert found["ratios"]["forward"] == pytest.approx(median["opensplat/forward"] / median["scgs_warp/forward"])
    report = {"machine": {"gpu": None, "processor": "x", "cores": 2, "torch": "2", "warp": "1"}, "date": "2026-01-01"}
    text = script("report").opensplat({**report, "opensplat": "abc", "flags": "-O3", **found})
    assert f"| {found['ratios']['both']:,.1f} |" in text and "within 1e-4" in text
    with pytest.raises(UserError, match="OpenSplat"):
        opensplat.compare(Stand(1.1), 150, (60, 50), 0.0)


def test_a_folder_that_is_no_checkout(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["opensplat.py", str(tmp_path)])
    assert script("opensplat").main() == 2
    assert "give a checkout" in capsys.readouterr().err
