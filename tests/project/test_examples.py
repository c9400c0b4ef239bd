"""Every script in examples/ runs with tiny settings and writes valid results."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import tyro
from PIL import Image as Picture

import scgs_warp
from helpers.paths import ROOT
from scgs_warp.data import load

SCRIPTS = sorted((ROOT / "examples").glob("*.py"))
TRAIN = "01_train_builtin.py"
QUICK: dict[str, list[str]] = {
    TRAIN: ["--size", "64", "--steps", "60"],
    "02_render_at_time.py": ["--size", "48", "--times", "0", "1"],
    "03_slow_motion.py": ["--size", "32", "--fps", "4", "--output", "slow"],
    "04_edit_a_pose.py": ["--size", "64"],
    "05_rasterization_like_gsplat.py": ["--size", "64", "--count", "2000"],
    "06_optimise_an_image.py": ["--size", "48", "--count", "300", "--steps", "60"],
    "07_follow_points.py": ["--points", "20", "--moments", "5"],
    "08_your_own_images.py": ["--frames", "5", "--size", "48"],
}
"""Arguments with which a script takes about a second."""


def module_of(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A working directory with the run that the first example makes."""
    folder = tmp_path_factory.mktemp("examples")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        tyro.cli(module_of(ROOT / "examples" / TRAIN).main, args=QUICK[TRAIN])
    return folder


def pixels(path: Path) -> np.ndarray:
    """[H, W, C] in [0, 1]."""
    return np.asarray(Picture.open(path), np.float64) / 255.0


def trained(place: Path, said: str) -> None:
    assert scgs_warp.Scene.load(place / "runs/example").step == 60


def moments(place: Path, said: str) -> None:
    strip = pixels(place / "moments.png")
    assert strip.shape == (96, 96, 3)
    colors, depths = strip[:48], strip[48:]
    assert colors.std() > 0.05 and depths.max() > 0.3, "something is seen"
    assert np.abs(colors[:, :48] - colors[:, 48:]).max() > 0.02, "it moves"
    assert not (depths.max(axis=2) > 0)[colors.min(axis=2) > 0.999].any(), "nothing is far away where nothing is"


def slow(place: Path, said: str) -> None:
    assert len(list((place / "slow").glob("frame_*.png"))) == 20
    assert "0.47 is the moment" in said


def edited(place: Path, said: str) -> None:
    before, after = np.split(pixels(place / "edited.png"), 2, axis=1)
    changed = np.abs(before - after).max(axis=2) > 0.05
    assert 0.005 < changed.mean() < 0.5, "a part of the picture changes"
    assert len(json.loads((place / "edit.json").read_text())["handles"]) == 1


def ball(place: Path, said: str) -> None:
    views = pixels(place / "ball.png")
    assert views.shape == (64, 128, 3) and views[0, 0].max() == 0.0
    left, right = views[28:36, 28:36].mean(axis=(0, 1)), views[28:36, 92:100].mean(axis=(0, 1))
    assert left[0] > left[1] + 0.1 and right[1] > right[0] + 0.1, "the colour is the direction: red x, green y"
    norms = [float(number) for number in re.findall(r"norm (\S+)", said)]
    assert len(norms) == 4 and min(norms) > 0.0
    nearest, farthest = map(float, re.findall(r"depth (\S+) to (\S+)", said)[0])
    assert 1.8 < nearest < 2.4 and nearest < farthest < 4.4


def fitted(place: Path, said: str) -> None:
    scores = [float(number) for number in re.findall(r"PSNR (\S+) dB", said)]
    assert scores[-1] > scores[0] + 4.0
    truth, found = np.split(pixels(place / "fitted.png"), 2, axis=1)
    assert -10 * np.log10(((truth - found) ** 2).mean()) > scores[0] + 4.0


def followed(place: Path, said: str) -> None:
    found = np.load(place / "tracks.npz")
    assert found["tracks"].shape == (5, 20, 3) and found["times"].tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert np.isfinite(found["tracks"]).all() and np.abs(np.diff(found["tracks"], axis=0)).max() > 1e-3
    assert (place / "tracks.png").is_file()


def own(place: Path, said: str) -> None:
    """Written images equal the views that the scene renders."""
    scene = scgs_warp.Scene.load(place / "runs/example")
    data = load(place / "data/mine", "train")
    assert len(data) == 5 and len(load(place / "data/mine", "test")) == 1
    for frame in data:
        image = scene.render(frame.camera, frame.time).rgb.clamp(0.0, 1.0)
        assert float((image - frame.image).abs().max()) < 0.02


CHECKS: dict[str, Callable[[Path, str], Any]] = dict(
    zip(QUICK, (trained, moments, slow, edited, ball, fitted, followed, own))
)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_example(script, place, monkeypatch, capsys):
    assert script.name in QUICK, f"{script.name}: give it quick arguments, and a check, here"
    monkeypatch.chdir(place)
    if script.name != TRAIN:
        tyro.cli(module_of(script).main, args=QUICK[script.name])
    CHECKS[script.name](place, capsys.readouterr().out)


def test_they_are_numbered_short_and_explained():
    assert [script.name[:2] for script in SCRIPTS] == [f"{i:02d}" for i in range(1, len(SCRIPTS) + 1)]
    for script in SCRIPTS:
        text = script.read_text(encoding="utf-8")
        assert text.count("\n") <= 75, f"{script.name} is long"
        module = module_of(script)
        assert f"python examples/{script.name}" in (module.__doc__ or ""), f"{script.name}: how is it run?"


def test_as_a_user_runs_it(tmp_path):
    command = [sys.executable, str(ROOT / "examples/05_rasterization_like_gsplat.py"), "--size", "32", "--count", "100"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "gradient of means" in done.stdout and (tmp_path / "ball.png").is_file()
