"""The zoo: one row for each subject, made on first use, and the comparison with another table."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from helpers.cells import SMALL, craft, options
from helpers.tiny import write_dnerf
from scgs_warp.ablation import table, zoo
from scgs_warp.ablation.markdown import markdown
from scgs_warp.apps import ablate as app
from scgs_warp.data.synthetic.zoo import SUBJECTS
from scgs_warp.errors import UserError


def craft_zoo(output: Path, scores: dict[str, tuple[float, float]], **more) -> Path:
    """Finished cells with the given PSNR of the mean and of the worst image."""
    for scene, (mean, worst) in scores.items():
        rest = {"psnr_median": mean + 0.5, "psnr_worst_time": 0.25, "missing": 0.0123, **more}
        craft(output, "zoo", "zoo", scene=scene, psnr=mean, psnr_worst=worst, **rest)
    return output


def cells_of(text: str, row: str) -> dict[str, str]:
    """The cells of one row of a Markdown table, by their headings."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return dict(zip(lines[0], next(line for line in lines if line[0] == row)))


def test_rows_are_subjects_in_the_order_of_the_zoo(tmp_path):
    craft_zoo(tmp_path, {"hook": (36.0, 30.0), "balls": (30.0, 24.0), "rods": (24.0, 21.0)})
    report = table.build("zoo", tmp_path)
    (made,) = report["tables"]
    assert [row["value"] for row in made["rows"]] == ["rods", "balls", "hook", "mean"]
    assert made["rows"][3]["psnr"]["mean"] == 30.0 and made["rows"][3]["psnr_worst"]["mean"] == 25.0
    text = markdown(report)
    row = cells_of(text, "balls")
    assert (row["PSNR"], row["median"], row["worst (at t)"], row["missing [%]"]) == (
        "30.00",
        "30.50",
        "24.00 (0.25)",
        "1.23",
    )
    assert {"SSIM", "Gaussians", "control points", "seconds"} <= row.keys()
    assert "LPIPS" not in row and "rods [%]" not in row and "loses" not in text
    assert cells_of(text, "mean")["worst (at t)"] == "25.00"


def test_seeds_give_deviations_and_the_time_of_the_worst(tmp_path):
    for seed, (worst, time) in enumerate(((25.0, 0.5), (24.0, 1.0))):
        craft(tmp_path, "zoo", "zoo", seed, "fan", psnr=30.0 + seed, psnr_worst=worst, psnr_worst_time=time)
    (row,) = table.build("zoo", tmp_path)["tables"][0]["rows"]
    assert row["psnr"]["mean"] == 30.5 and row["psnr_worst_time"] == 1.0
    assert cells_of(markdown(table.build("zoo", tmp_path)), "fan")["worst (at t)"] == "24.50 ± 0.71 (1.00)"


def test_rods_have_a_column_where_they_were_measured(tmp_path):
    craft_zoo(tmp_path, {"balls": (30.0, 24.0)})
    craft_zoo(tmp_path, {"rods": (24.0, 21.0)}, rods_within=0.875)
    text = markdown(table.build("zoo", tmp_path))
    assert [cells_of(text, row)["rods [%]"] for row in ("rods", "balls", "mean")] == ["87.5", "-", "-"]


def test_what_is_not_covered_is_listed(tmp_path):
    region = {"share": 0.02, "pixels": 86.0, "x": 120.0, "y": 31.0}
    worst = {"name": "r_019", "time": 1.0, "missing": 0.041, "region": region, "images": 1}
    craft_zoo(tmp_path, {"fan": (24.0, 21.0)}, missing_worst=worst, split="test", images=20)
    craft_zoo(tmp_path, {"balls": (30.0, 24.0)})
    lines = [line for line in markdown(table.build("zoo", tmp_path)).splitlines() if line.startswith("- ")]
    assert lines == [
        "- fan, seed 0: not covered: test/r_019 (t = 1.00) misses 4.1 % of the subject, largest at x 120, y 31 (86 px)"
    ]


def test_other_settings_and_versions_are_compared(tmp_path):
    """The other folder is an old one, of which only the table is read; a loss of more than 0.2 dB is marked."""
    before, after = tmp_path / "before", tmp_path / "after"
    craft_zoo(before, {"rods": (24.0, 21.0), "balls": (30.0, 24.0), "fan": (28.0, 22.0)}, steps=3_000)
    table.write(table.build("zoo", before), before)
    for config in before.glob("*/*/config.json"):
        config.write_text("{}")
    craft_zoo(after, {"rods": (23.7, 21.1), "balls": (30.3, 23.7), "fan": (27.9, 21.9), "cloth": (33.0, 31.0)})
    report = table.build("zoo", after, compare=before)
    rows = {row["value"]: row for row in report["tables"][0]["rows"]}
    assert rows["rods"]["psnr_change"] == pytest.approx(-0.3) and rows["rods"]["loses"] == ["psnr"]
    assert rows["balls"]["worst_change"] == pytest.approx(-0.3) and rows["balls"]["loses"] == ["psnr_worst"]
    assert rows["fan"]["loses"] == [] and rows["cloth"]["psnr_change"] is None
    assert rows["mean"]["psnr_change"] == pytest.approx(-0.1 / 3), "over the subjects that both have"
    text = markdown(report)
    assert [cells_of(text, row)["loses > 0.2 dB"] for row in ("rods", "balls", "fan")] == ["PSNR", "worst", ""]
    assert cells_of(text, "rods")["change: PSNR"] == "-0.30" and cells_of(text, "cloth")["change: PSNR"] == "-"
    assert "Compared with before (preset cpu, steps 3000)." in text
    written = table.write(report, after)
    assert json.loads(written[0].read_text())["compared"]["folder"] == "before"


@pytest.mark.parametrize(
    "content",
    [
        None,
        "{",
        "[]",
        '{"settings": {}, "tables": []}',
        '{"settings": {}, "tables": 1}',
        '{"settings": {}, "tables": [{"rows": [{"value": "rods", "psnr": 3}]}]}',
    ],
)
def test_a_folder_without_a_table_of_the_zoo_cannot_be_compared(tmp_path, content):
    if content is not None:
        (tmp_path / "zoo.json").write_text(content)
    with pytest.raises(UserError, match=r"zoo\.json"):
        zoo.read_table(tmp_path)


def test_subjects_are_chosen_in_the_order_of_the_zoo():
    assert zoo.parse_subjects([]) == tuple(SUBJECTS)
    assert zoo.parse_subjects(["balls", "rods", "balls"]) == ("rods", "balls")
    with pytest.raises(UserError, match="--values 'ball': zoo takes some of robot, rods,"):
        zoo.parse_subjects(["ball"])


@pytest.fixture
def small(tmp_path, monkeypatch) -> Path:
    """Tiny data sets of the subjects, in a folder of the test."""
    for name, value in {"DATA": tmp_path / "data", "SIZE": 24, "TRAIN": 6, "TEST": 2}.items():
        monkeypatch.setattr(zoo, name, value)
    return tmp_path


@pytest.mark.parametrize(("more", "steps"), [([], zoo.STEPS), (["--steps", "70"], 70), (["--preset", "quick"], 7_000)])
def test_the_usual_schedule_gives_way_to_options(small, monkeypatch, more, steps):
    """Subjects are as large as they were made, whatever --downscale says of the other data."""
    blobs, planned = write_dnerf(small / "blobs", 32), []
    monkeypatch.setattr(app, "train", lambda options, cells: planned.extend(cells) or {})
    monkeypatch.setattr(zoo, "make_subjects", lambda folders, device: None)
    arguments = ["zoo", "--output", str(small / "out"), "--data", str(blobs), "--downscale", "2", "--device", "cpu"]
    assert app.cli([*arguments, "--values", "still,rods", "--seeds", "0,1", *more]) == 0
    assert sorted({cell.scene for cell in planned}) == ["blobs", "rods", "still"] and len(planned) == 6
    assert {cell.settings["steps"] for cell in planned} == {steps}
    assert {cell.scene: cell.settings["data"]["downscale"] for cell in planned} == {"rods": 1, "still": 1, "blobs": 2}


def test_subjects_are_made_on_first_use_and_trained(small, capsys):
    arguments = ["zoo", "--output", str(small / "out"), "--steps", "30", "--values", "touch", *SMALL]
    assert app.cli(arguments) == 0
    (folder,) = small.glob("data/*/touch")
    assert len(list((folder / "train").iterdir())) == 6 and str(folder.parent.name).startswith("zoo-24-v")
    first = capsys.readouterr()
    assert "making touch 8/8" in first.out + first.err and "| touch " in first.out
    metrics = json.loads((small / "out/touch/zoo/metrics.json").read_text())
    assert metrics["images"] == 2 and metrics["missing"] is not None
    assert app.cli([*arguments, "--compare", str(small / "out")]) == 0
    again = capsys.readouterr()
    assert "making" not in again.out + again.err and "touch/zoo: done before" in again.out
    assert "+0.00" in again.out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["zoo", "--values", "ball"], "--values 'ball'"),
        (["zoo", "--compare", "nowhere"], "--compare nowhere: holds no zoo.json"),
        (["nodes", "--compare", "nowhere"], "--compare nowhere: is for zoo"),
        (["zoo", "--data", "nowhere"], "--data nowhere"),
    ],
)
def test_mistakes_get_one_line_and_status_2(arguments, named, small, capsys):
    assert app.cli([*arguments, "--output", str(small / "out"), "--device", "cpu"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and named in lines[0]
    assert not (small / "out").exists() and not (small / "data").exists(), "nothing is begun"


def test_a_folder_with_the_name_of_a_subject_is_refused(small, capsys):
    blobs = write_dnerf(small / "rods", 32)
    assert app.cli(["zoo", *options(blobs, small / "out")]) == 2
    assert "there is a subject 'rods'" in capsys.readouterr().err
