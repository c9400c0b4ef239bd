"""The Python of the documentation runs, block after block of a page, on runs with the names that it gives."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

import scgs_warp
from helpers.export_runs import moving_run
from helpers.paths import ROOT

PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md"))
    if "```python\n" in path.read_text(encoding="utf-8")
)
RUNS = ("figure-quick", "NAME")


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return moving_run(tmp_path_factory.mktemp("runs") / "run", swing=0.02)


@pytest.mark.parametrize("page", PAGES)
def test_the_python_of_a_page_runs(page, made, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in RUNS:
        shutil.copytree(made, tmp_path / "runs" / name)
    monkeypatch.setattr(scgs_warp, "train", lambda data, preset, **settings: scgs_warp.Scene.load("runs/NAME"))
    names: dict = {}
    for index, block in enumerate(re.findall(r"```python\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)):
        exec(compile(block, f"{page}, block {index + 1} of Python", "exec"), names)
    assert names


def test_pages_with_python_are_found():
    assert {"README.md", "docs/api.md", "docs/editing.md", "docs/formats.md", "docs/page.md"} <= set(PAGES)
