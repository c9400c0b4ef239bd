"""Ablations: cells are resumed and never mixed, tables say what the cells say, mistakes get one line and status 2."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from helpers.cells import options
from helpers.tiny import write_dnerf
from scgs_warp.ablation import cells as ablate
from scgs_warp.ablation import local_runner
from scgs_warp.apps import ablate as app
from scgs_warp.config import presets
from scgs_warp.training import run as finish


@pytest.fixture(scope="module")
def blobs(tmp_path_factory) -> Path:
    return write_dnerf(tmp_path_factory.mktemp("data") / "blobs", 32)


@pytest.fixture(scope="module")
def trained(blobs, tmp_path_factory) -> Path:
    """Two cells of nodes."""
    output = tmp_path_factory.mktemp("ablations") / "nodes"
    assert app.cli(["nodes", *options(blobs, output, "--values", "16,8")]) == 0
    return output


@pytest.fixture
def copied(trained, tmp_path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "nodes"))


def test_values_are_sorted_and_unique():
    assert ablate.parse_values("nodes", ["512", "64", "512"]) == ("64", "512")
    assert ablate.parse_values("motion", ["control-points", "static"]) == ("static", "control-points")


def test_cells_differ_in_what_is_varied_alone(blobs, tmp_path):
    base = presets.with_steps(presets.preset("cpu"), 1_000)
    for name in ablate.ABLATIONS:
        cells = ablate.plan(name, base, {"blobs": blobs}, tmp_path, seeds=(0, 3))
        expected = [value for value in ablate.VALUES[name] if (name, value) != ("arap", "per-gaussian")]
        assert [cell.value for cell in cells] == 2 * expected, "without true motion there is no baseline to compare"
        for cell in cells:
            assert cell.settings["steps"] == 1_000
            differs = ablate.first_difference(cell.settings, cells[0].settings, ("seed", *ablate.VARIED[name]))
            assert differs is None
        assert len({json.dumps(cell.settings) for cell in cells}) == len(cells), "but in that they do"
        assert len({cell.folder for cell in cells}) == len(cells)


def test_a_cell_says_where_progressive_has_no_effect(blobs, tmp_path, capsys):
    arguments = options(blobs, tmp_path / "motion", "--values", "static,control-points", "--progressive")
    assert app.cli(["motion", *arguments]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if "--progressive" in line]
    assert said == ["blobs/static: --progressive has no effect with --motion static, which has no stage 1"]


def test_arap_off_is_off_in_both_stages(blobs, tmp_path):
    base = presets.preset("cpu")
    on, off = ablate.plan("arap", base, {"blobs": blobs}, tmp_path)
    assert on.settings["loss"]["arap"] == base.loss.arap > 0 and on.settings["pretrain"]["arap_weight"] > 0
    assert off.settings["loss"]["arap"] == 0 == off.settings["pretrain"]["arap_weight"]
    assert on.settings["motion"] == off.settings["motion"]


def test_known_motion_asks_for_the_baseline(blobs, tmp_path):
    known = Path(shutil.copytree(blobs, tmp_path / "known"))
    (known / "ground_truth.npz").write_bytes(b"")
    cells = ablate.plan("arap", presets.preset("cpu"), {"known": known}, tmp_path / "out")
    assert [cell.value for cell in cells] == ["on", "off", "per-gaussian"]
    assert cells[2].settings["motion"]["model"] == "per-gaussian"


def test_a_cell_is_plain_data(blobs, tmp_path):
    cell = ablate.plan("nodes", presets.preset("cpu"), {"blobs": blobs}, tmp_path)[0]
    assert ablate.cell_from_json(ablate.cell_to_json(cell)) == cell
    assert Path(cell.folder).is_absolute() and Path(cell.settings["data"]["folder"]).is_absolute()


def test_cells_are_run_directories(trained):
    for value, count in (("8", 8), ("16", 16)):
        folder = trained / "blobs" / value
        metrics = json.loads((folder / "metrics.json").read_text())
        assert metrics["step"] == 30 and metrics["motion"] == "control-points" and metrics["images"] == 3
        assert json.loads((folder / "config.json").read_text())["motion"]["nodes"] == count
        assert (folder / "checkpoint.safetensors").is_file()
    report = json.loads((trained / "nodes.json").read_text())
    assert report["values"] == ["8", "16"] and report["settings"]["steps"] == 30
    assert [row["control_points"]["mean"] for row in report["tables"][0]["rows"]] == [8, 16]


def test_finished_cells_are_taken_as_they_are(blobs, copied, capsys):
    before = {path: path.stat().st_mtime_ns for path in copied.glob("blobs/*/*.*")}
    assert app.cli(["nodes", *options(blobs, copied, "--values", "8")]) == 0
    assert {path: path.stat().st_mtime_ns for path in copied.glob("blobs/*/*.*")} == before
    out = capsys.readouterr().out
    assert "[1/1] blobs/8: done before" in out and "| 16 " in out, "the table has all cells that are there"


def test_a_cell_without_metrics_is_resumed(blobs, copied, capsys):
    path = copied / "blobs/8/metrics.json"
    before = json.loads(path.read_text())
    path.unlink()
    assert app.cli(["nodes", *options(blobs, copied, "--values", "8,16")]) == 0
    after = json.loads(path.read_text())
    assert {key: after[key] for key in ("psnr", "ssim", "step", "seconds")} == {
        key: before[key] for key in ("psnr", "ssim", "step", "seconds")
    }
    assert "[2/2] blobs/16: done before" in capsys.readouterr().out


def test_a_cell_stopped_before_its_pictures_gets_them(blobs, copied, monkeypatch):
    folder = copied / "blobs/8"
    for name in ("metrics.json", "contact_sheet.png", "curves.png"):
        (folder / name).unlink()

    def stopped(log: Path, output: Path) -> None:
        raise KeyboardInterrupt

    arguments = ["nodes", *options(blobs, copied, "--values", "8")]
    monkeypatch.setattr(finish, "curves", stopped)
    assert app.cli(arguments) == 130
    monkeypatch.undo()
    assert app.cli(arguments) == 0
    assert all((folder / name).is_file() for name in ("metrics.json", "contact_sheet.png", "curves.png"))


@pytest.mark.parametrize(
    ("change", "field"),
    [(["--downscale", "2"], "data.downscale"), (["--set", "loss.ssim=0.3"], "loss.ssim"), (["--steps", "40"], "steps")],
)
def test_changed_settings_are_refused(change, field, blobs, copied, capsys):
    assert app.cli(["nodes", *options(blobs, copied, "--values", "8", *change)]) == 2
    line = capsys.readouterr().err.strip()
    assert "\n" not in line and "blobs/8: made with " in line
    assert field in line


def test_other_data_of_the_same_name_are_refused(blobs, copied, tmp_path, capsys):
    other = Path(shutil.copytree(blobs, tmp_path / "elsewhere" / "blobs"))
    assert app.cli(["nodes", *options(other, copied, "--values", "8")]) == 2
    assert "data.folder" in capsys.readouterr().err


def test_what_changes_no_bit_may_change(blobs, copied):
    assert app.cli(["nodes", *options(blobs, copied, "--values", "8", "--set", "evaluate_every=7")]) == 0


@pytest.mark.parametrize("more", [["--values", "8"], ["--table-only"]])
@pytest.mark.parametrize(("section", "field"), [("loss", "arap_neighbors"), (None, "half_size"), (None, "motion")])
def test_a_cell_of_another_version_is_refused(section, field, more, blobs, copied, capsys):
    """Today's default is not what that version did; nor may the cell stand in a table beside others."""
    path = copied / "blobs/8/config.json"
    settings = json.loads(path.read_text())
    del (settings[section] if section else settings)[field]
    path.write_text(json.dumps(settings))
    assert app.cli(["nodes", *options(blobs, copied, *more)]) == 2
    line = capsys.readouterr().err.strip()
    assert "\n" not in line and "blobs/8: made by another version, which had no " in line
    assert field in line and "remove the folder" in line
    shutil.rmtree(copied / "blobs/8")
    assert app.cli(["nodes", *options(blobs, copied, *more)]) == 0


def test_a_field_that_changes_no_bit_may_be_missing(blobs, copied):
    path = copied / "blobs/8/config.json"
    settings = json.loads(path.read_text())
    del settings["evaluate_every"]
    path.write_text(json.dumps(settings))
    assert app.cli(["nodes", *options(blobs, copied, "--values", "8")]) == 0


def test_lpips_is_measured_afterwards(blobs, copied, tmp_path, monkeypatch):
    class Distance:
        def __init__(self, weights: Path, device: str) -> None:
            assert Path(weights) == tmp_path / "vgg"

        def __call__(self, image, truth) -> float:
            return 0.25

    monkeypatch.setattr("scgs_warp.evaluation.image_metrics.LPIPS", Distance)
    path = copied / "blobs/8/metrics.json"
    before = json.loads(path.read_text())
    weights = ["--lpips-weights", str(tmp_path / "vgg")]
    assert app.cli(["nodes", *options(blobs, copied, "--values", "8", *weights)]) == 0
    after = json.loads(path.read_text())
    assert after["lpips"] == 0.25 and after["psnr"] == before["psnr"] and after["seconds"] == before["seconds"]


def test_ctrl_c_keeps_what_is_done(blobs, tmp_path, monkeypatch, capsys):
    real = local_runner.attempt

    def attempt(cell):
        if cell.value == "16":
            raise KeyboardInterrupt
        return real(cell)

    monkeypatch.setattr(local_runner, "attempt", attempt)
    output = tmp_path / "out"
    assert app.cli(["nodes", *options(blobs, output, "--values", "8,16")]) == 130
    text = (output / "nodes.md").read_text()
    assert "1 of 2 cells are missing" in text
    assert [line.split("|")[4].strip() == "-" for line in text.splitlines() if line.startswith(("| 8", "| 16"))] == [
        False,
        True,
    ]


def test_whatever_goes_wrong_comes_back_as_one_line(tmp_path):
    cell = ablate.Cell("nodes", "hook", "64", 0, str(tmp_path / "cell"), {})

    def run(cell):
        raise RuntimeError("out of memory\nin a kernel")

    assert ablate.attempt(cell, run) == "RuntimeError: out of memory"
    assert "Traceback" in (tmp_path / "cell" / "error.txt").read_text()
    assert ablate.attempt(cell, lambda cell: tmp_path) is None
    assert not (tmp_path / "cell" / "error.txt").exists()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["nodes", "--values", "64,many"], "--values 'many'"),
        (["nodes", "--values", "2"], "--values 2: needs at least"),
        (["nodes", "--values", "9999999"], "--values 9999999: choose at most"),
        (["motion", "--values", "fluid"], "--values 'fluid'"),
        (["arap", "--values", "half"], "on, off, per-gaussian"),
        (["nodes", "--nodes", "64"], "--nodes 64"),
        (["motion", "--set", "motion.model=static"], "--set motion.model"),
        (["arap", "--set", "loss.arap=0", "--set", "pretrain.arap_weight=0"], "arap"),
        (["nodes", "--set", "motion.speed=1"], "motion.speed"),
        (["nodes", "--seeds", "1,x"], "--seeds 'x'"),
        (["nodes", "--jobs", "0"], "--jobs 0"),
        (["nodes", "--table-only"], "--table-only"),
        (["nodes", "--data", "nowhere"], "nowhere"),
        (["nodes", "--lpips-weights", "nowhere.pth"], "nowhere.pth"),
    ],
)
def test_mistakes_get_one_line_and_status_2(arguments, named, blobs, tmp_path, capsys):
    name, *more = arguments
    assert app.cli([name, *options(blobs, tmp_path / "out", *more)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and named in lines[0]
    assert not (tmp_path / "out").exists(), "nothing is begun"


def test_two_data_sets_of_one_name(blobs, tmp_path, capsys):
    assert app.cli(["nodes", "--data", str(blobs), str(blobs), "--output", str(tmp_path), "--device", "cpu"]) == 2
    assert "another 'blobs'" in capsys.readouterr().err


def test_damaged_metrics_are_named(blobs, copied, capsys):
    (copied / "blobs/8/metrics.json").write_text("{")
    assert app.cli(["nodes", *options(blobs, copied, "--values", "8")]) == 2
    assert "blobs/8/metrics.json: damaged" in capsys.readouterr().err
