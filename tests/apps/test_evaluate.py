"""apps/evaluate.py as a user runs it."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np

from helpers.app_runs import run_app


def test_evaluate(trained, tmp_path):
    path = tmp_path / "metrics.json"
    done = run_app("evaluate", "--run", str(trained), "--json", str(path), "--device", "cpu")
    assert done.returncode == 0, done.stderr
    assert json.loads(path.read_text())["psnr"] == json.loads((trained / "metrics.json").read_text())["psnr"]


def test_other_images_of_the_same_names_are_noted(dnerf, trained, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(dnerf, other)
    where = "--run", str(trained), "--json", str(tmp_path / "m.json"), "--data", str(other), "--device", "cpu"
    assert "are not those" not in run_app("evaluate", *where).stdout
    for path in (other / "test").glob("*.png"):
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.ascontiguousarray(pixels[::-1]))
    done = run_app("evaluate", *where)
    assert done.returncode == 0, done.stderr
    assert (
        f"{other}: its test images are not those with which {trained} was trained; scoring them anyway" in done.stdout
    )


def test_a_folder_without_a_run(tmp_path):
    done = run_app("evaluate", "--run", str(tmp_path))
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, done.stderr


def test_the_mean_of_two_runs(trained, other_seed, tmp_path):
    path = tmp_path / "metrics.json"
    done = run_app("evaluate", "--run", str(trained), "--also", str(other_seed), "--json", str(path), "--device", "cpu")
    assert done.returncode == 0, done.stderr
    metrics, alone = json.loads(path.read_text()), json.loads((trained / "metrics.json").read_text())
    assert metrics["psnr"] != alone["psnr"] and metrics["gaussians"] > alone["gaussians"]
    assert metrics["runs"] == [str(trained), str(other_seed)] and metrics["seconds"] > alone["seconds"]
    assert (trained / "evaluation/test-mean/contact_sheet.png").is_file()


def test_another_background_shows_what_lies_beside_the_subject(trained, tmp_path):
    alone = json.loads((trained / "metrics.json").read_text())
    done = run_app("evaluate", "--run", str(trained), "--background", "white", "--device", "cpu")
    assert done.returncode == 0 and "are not those" not in done.stdout, done.stderr
    folder = trained / "evaluation/test-white"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["background"] == "white" and metrics["psnr"] != alone["psnr"]
    for name in ("renders", "truth"):
        corner = cv2.imread(str(min((folder / name).glob("*.png"))))[0, 0]
        assert (corner == 255).all(), name


def test_a_background_of_filled_images_is_refused(dnerf, trained, tmp_path):
    filled = tmp_path / "filled"
    shutil.copytree(dnerf, filled)
    for path in filled.glob("*/*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path)))
    where = "--run", str(trained), "--data", str(filled), "--background", "white", "--device", "cpu"
    done = run_app("evaluate", *where)
    line = f"error: --background white: the images of {filled} have no alpha; leave it out"
    assert done.returncode == 2 and line in done.stderr, done.stderr


def test_a_run_that_cannot_be_written_is_scored_alone(trained, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(trained, run, ignore=shutil.ignore_patterns("evaluation"))
    (run / "evaluation").write_text("a file, in which nobody can make a folder")
    done = run_app("evaluate", "--run", str(run), "--device", "cpu")
    assert done.returncode == 2, done.stdout
    assert f"{run / 'evaluation/test'}: cannot be written; give --json FILE for the scores alone" in done.stderr
    path = tmp_path / "metrics.json"
    done = run_app("evaluate", "--run", str(run), "--json", str(path), "--device", "cpu")
    assert done.returncode == 0 and "so that no renders are kept" in done.stdout, done.stderr
    assert json.loads(path.read_text())["psnr"] == json.loads((trained / "metrics.json").read_text())["psnr"]


def test_a_file_without_which_the_run_cannot_be_opened_is_not_overwritten(tmp_path):
    (tmp_path / "config.json").write_text("kept")
    done = run_app("evaluate", "--run", str(tmp_path), "--json", str(tmp_path / "config.json"))
    line = f"error: --json {tmp_path}/config.json: would be overwritten, and the run needs it; give another name\n"
    assert (done.returncode, done.stderr) == (2, line)


def test_a_folder_in_place_of_the_file_for_metrics_is_refused_before_the_run_is_read(tmp_path):
    done = run_app("evaluate", "--run", str(tmp_path / "missing"), "--json", str(tmp_path))
    line = f"error: --json {tmp_path}: is a folder; name a file, as {tmp_path / 'metrics.json'}\n"
    assert (done.returncode, done.stderr) == (2, line)
