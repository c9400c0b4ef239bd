"""The tables of the pages are what the committed results give."""

from __future__ import annotations

import json
import re
import shutil
import subprocess

import pytest

from helpers.paths import ROOT
from helpers.scripts import benchmark_script
from scgs_warp.apps import bench as app
from scgs_warp.benchmark import roofline

pytestmark = pytest.mark.usefixtures("all_threads")

TINY = ["--gaussians", "120", "--nodes", "12", "--size", "48", "--seconds", "0", "--device", "cpu"]
COMMIT = "2bd452c63deb78b3d9949913ba18313470cbd8f8"


@pytest.fixture
def report():
    return benchmark_script("report")


def results_with(tmp_path, *runs):
    """A folder of results that holds ``runs`` as its only scores."""
    (tmp_path / "quality").mkdir()
    for index, run in enumerate(runs):
        (tmp_path / "quality" / f"{index}.json").write_text(json.dumps(run), encoding="utf-8")
    return tmp_path


def test_the_pages_show_what_the_results_give(report):
    assert report.main(["--check"]) == 0


@pytest.mark.parametrize(
    "name",
    ["quality-published", "quality-published-nerf-ds", "frame-cpu", "speed-overview", "speed-ratios", "page-precision"],
)
def test_a_changed_figure_is_found(report, tmp_path, capsys, name):
    copies = []
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        copies.append(tmp_path / path.name)
        shutil.copy(path, copies[-1])
    options = ["--check", "--pages", *map(str, copies)]
    assert report.main(options) == 0
    figure = rf"(<!-- table: {name} -->.*?\| )(\d+)(\.\d)"
    for page in copies:
        text = page.read_text(encoding="utf-8")
        wrong = re.sub(figure, lambda match: f"{match[1]}{int(match[2]) + 1}{match[3]}", text, flags=re.DOTALL)
        if wrong != text:
            break
    page.write_text(wrong, encoding="utf-8")
    assert report.main(options) == 1 and page.name in capsys.readouterr().err
    assert page.read_text(encoding="utf-8") == wrong


def test_every_table_from_tiny_results(report, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(roofline, "BLOCKS", 2)
    commands = {
        "frame-cpu": ["frame", *TINY, "--motion", "control-points,static", "--threads", "1"],
        "playback-cpu": ["frame", *TINY, "--playback", "--threads", "1"],
        "raster-cpu": ["raster", *TINY],
        "step-cpu": ["step", *TINY, "--threads", "1"],
        "edit-cpu": ["edit", *TINY, "--threads", "1"],
        "pull-cpu": ["pull", *TINY, "--threads", "1"],
        "table-s2-cpu": ["frame", *TINY, "--table-s2", "--threads", "1"],
        "scaling-cpu": ["scaling", *TINY, "--sweeps", "nodes:6/12", "--figures", str(tmp_path / "figures")],
    }
    for name, arguments in commands.items():
        assert app.cli([*arguments, "--json", str(tmp_path / f"{name}.json")]) == 0
    capsys.readouterr()
    page = tmp_path / "page.md"
    names = report.table_names(tmp_path)
    text = "".join(f"<!-- table: {name} -->\nold\n<!-- /table -->\n" for name in names)
    page.write_text(f"# Page\n\n{text}end\n", encoding="utf-8")
    options = ["--results", str(tmp_path), "--pages", str(page)]
    assert report.main([*options, "--check"]) == 1
    assert "old" in page.read_text(encoding="utf-8")
    assert report.main(options) == 0 and report.main([*options, "--check"]) == 0
    text = page.read_text(encoding="utf-8")
    assert "\nold\n" not in text and text.endswith("end\n")
    assert text.count("Not measured yet: ") == 3 and "1000000 --size 1920x1080" in text
    result = json.loads((tmp_path / "frame-cpu.json").read_text(encoding="utf-8"))
    first = result["rows"][0]
    assert f"`{result['command']}`" in text and result["command"].startswith(
        "python apps/bench.py frame --gaussians 120"
    )
    assert f"| **frame** | {first['ms_median']:,.1f} | {first['ms_min']:,.1f} |" in text
    for said in (
        "frame/skin",
        "**raster/both**",
        "**step/arap**",
        "edit/drag/solve",
        "pull/drag/kinematics",
        "(network and skinning)",
        "| hexplane | 1 |",
    ):
        assert said in text
    for said in ("GFLOP/s", "MiB more", "| nodes | pairs |", "of the frames/s of `static`"):
        assert said in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len(lines) > 40 and all(line.endswith("|") for line in lines)


def test_every_table_stands_on_a_page_and_every_marker_names_one(report, tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("<!-- table: raster-cpu -->\n<!-- /table -->\n", encoding="utf-8")
    assert report.main(["--check", "--pages", str(page)]) == 1
    said = capsys.readouterr().err
    assert "<!-- table: frame-cpu -->" in said and "raster-cpu" not in said
    with pytest.raises(ValueError, match="no-such-table"):
        report.fill("<!-- table: no-such-table -->\n<!-- /table -->\n", tmp_path)
    with pytest.raises(ValueError, match="for every"):
        report.fill("<!-- table: frame-cpu -->\n", tmp_path)


def test_a_measured_run_replaces_the_reported_one(report, tmp_path):
    shared = {"table": "parts-settling", "commit": COMMIT}
    reported = [
        {"row": "none", "scene": "mutant", "psnr": 40.0},
        {"row": "none", "scene": "standup", "psnr": 41.0},
        {"row": "none", "scene": "mean", "psnr": 40.49},
        {"row": "settle", "scene": "mutant", "psnr": 42.0},
        {"row": "settle", "scene": "standup", "psnr": 43.0},
    ]
    measured = {**shared, "provenance": "measured", "row": "none"}
    results = results_with(tmp_path, {**shared, "provenance": "reported", "runs": reported})
    text = report.section("quality-parts-settling", results)
    assert "| none † | 40.00 | 41.00 | 40.49 |  |" in text and "| settle † | 42.00 | 43.00 | 42.50 | +2.01 |" in text
    assert f"† First reported in commit {COMMIT[:7]}; the repository holds no result file for these values." in text
    for scene, psnr in (("mutant", 40.5), ("standup", 41.5)):
        run = {**measured, "scene": scene, "psnr": psnr}
        (results / "quality" / f"a-{scene}.json").write_text(json.dumps(run), encoding="utf-8")
    text = report.section("quality-parts-settling", results)
    assert "| 40.50 | 41.50 | 41.00 |  |" in text and "| settle † | 42.00 | 43.00 | 42.50 | +1.50 |" in text


def test_repeated_measurements_replace_the_reported_table(report, tmp_path):
    shutil.copytree(report.RESULTS / "reported", tmp_path / "reported")
    tables = benchmark_script("repeatable_tables")
    origin = {"date": "2026-01-01", "commit": COMMIT, "machine": {"gpu": None, "processor": "x", "cores": 2}}
    origin["machine"].update(torch="2", warp="1")
    parts = {"view": 50.0, "exchange": 6.0, "join": 5.0, "step": 90.0}
    rows = [{"name": name, "ms": 1.0, "cpu_ms": time} for name, time in parts.items()]
    drag = {"edit/drag": 14.0, "edit/drag/solve": 6.0, "edit/picture": 40.0}
    edits = [{"name": name, "ms_median": time, "threads": 1, "control_points": 512} for name, time in drag.items()]
    for name in ("sharing-200", "sharing-400", "sharing-800", "sharing-400-300k"):
        assert "†" in report.section("scaling-step", tmp_path)
        for ending in ("", "-alone"):
            result = {**origin, "rows": rows, "peak_mib": 700 + len(ending), "mib_per_step": 15.4}
            (tmp_path / f"{name}{ending}.json").write_text(json.dumps(result), encoding="utf-8")
    for name in ("edit-cpu", "edit-4096-cpu"):
        (tmp_path / f"{name}.json").write_text(json.dumps({**origin, "rows": edits}), encoding="utf-8")
    known = [
        name
        for name, repeatable in tables.REPEATABLE.items()
        if all((tmp_path / f"{result}.json").is_file() for result in repeatable.results)
    ]
    assert {"scaling-step", "scaling-memory", "editing-updates"} <= set(known)
    texts = [report.section(name, tmp_path) for name in known]
    assert all("†" not in text and "x, 2 cores; torch 2" in text for text in texts)
    assert "| 11 ms | 11 ms | 11 ms | 11 ms |" in texts[0] and "| 29 ms |" in texts[0]
    assert "| 706 MiB | 700 MiB |" in texts[1] and "| 512 | 14.0 ms | 6.0 ms | 40.0 ms |" in texts[2]


def test_scores_of_a_run_are_recorded(report, tmp_path, capsys):
    recorder = benchmark_script("record_quality")
    results, run = results_with(tmp_path), tmp_path / "run"
    run.mkdir()
    options = [str(run), "--table", "published", "--row", "cpu", "--scene", "hook", "--results", str(results)]
    assert recorder.main(options) == 2 and "name a run folder" in capsys.readouterr().err
    metrics = {"psnr": 39.5, "ssim": 0.99, "gaussians": 1000, "seconds": 90.0, "device": "cpu", "data": "/home/me/hook"}
    (run / "metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
    assert recorder.main(options) == 2 and "train it again" in capsys.readouterr().err
    machine = {"gpu": None, "processor": "x", "cores": 2}
    origin = {"date": "2026-01-01", "command": "python apps/train.py --data hook", "commit": COMMIT, "machine": machine}
    (run / "metrics.json").write_text(json.dumps({**metrics, "per_image": [1], "provenance": origin}), encoding="utf-8")
    assert recorder.main(options) == 0
    text = (results / "quality" / "published-cpu-hook.json").read_text(encoding="utf-8")
    assert "/home" not in text and "per_image" not in text
    assert json.loads(text)["provenance"] == "measured" and origin.items() <= json.loads(text).items()
    table = report.section("quality-published", results)
    assert "| 39.50 |" in table and "†" not in table
    assert "1 min 30 s" in report.section("quality-published-cost", results)


def test_results_of_older_code_are_marked(report):
    provenance = benchmark_script("provenance")
    found = subprocess.run(["git", "log", "-1", "--format=%H"], cwd=ROOT, capture_output=True, text=True, check=False)
    if found.returncode:
        pytest.skip("not a checkout")
    head = found.stdout.strip()
    first = subprocess.run(
        ["git", "rev-list", "--max-parents=0", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()[0]
    paths = {*provenance.TRAINING, *provenance.EDITING}
    assert all((ROOT / path).exists() for path in paths), "git finds no change of a folder that was moved"
    assert not provenance.changed_since(head, provenance.RENDERING)
    assert provenance.changed_since(f"{head}-dirty", provenance.RENDERING)
    assert provenance.changed_since(first, provenance.RENDERING) or first == head
    assert not provenance.changed_since(None, provenance.RENDERING)
    with pytest.raises(ValueError, match="not in the history"):
        provenance.changed_since(40 * "0", provenance.RENDERING)
    marked = f"| frame {provenance.OLDER} | 1 |\n\n{provenance.older_note([first])}\n<!-- /table -->\n"
    assert provenance.without_older_marks(marked) == "| frame | 1 |\n<!-- /table -->\n"


def test_without_git_nothing_is_marked(report, monkeypatch):
    provenance = benchmark_script("provenance")
    monkeypatch.setattr(subprocess, "run", lambda *args, **kwargs: (_ for _ in ()).throw(FileNotFoundError("git")))
    assert not provenance.changed_since("abcdef", ("kernels",))


def test_rows_of_two_threads_on_a_busy_machine_are_refused():
    rows = [{"share": None, "device": "cpu", "threads": n, "two_thread_scaling": 1.5} for n in (1, 2)]
    tables = benchmark_script("timing_tables")
    assert "quote the one-thread column" in tables.scaling_line(rows)
    assert "quote" not in tables.scaling_line(rows[:1]) and tables.scaling_line([{**rows[0], "device": "cuda"}]) == ""


def test_soaks_are_counted(report, tmp_path):
    tables = benchmark_script("repeatable_tables")
    origin = {"date": "2026-01-01", "commit": COMMIT, "machine": {"gpu": None, "processor": "x", "cores": 2}}
    origin["machine"].update(torch="2", warp="1")
    for part in tables.SOAKS:
        one = {
            "command": f"python benchmarks/chaos.py --minutes 118 --part {part}",
            "rounds": 9,
            "faults": {name: {"kill": 5, "none": 4} if name == part else {} for name in tables.SOAKS},
            "broken": ["live, memory: it hung"] if part == "live" else [],
        }
        (tmp_path / f"chaos-{part}.json").write_text(json.dumps({**origin, **one}), encoding="utf-8")
    text = report.section("trust-soaks", tmp_path)
    assert (
        "| training | 118 min | 9 | 5 | 0 |" in text and "| training with an open page | 118 min | 9 | 5 | 1 |" in text
    )
