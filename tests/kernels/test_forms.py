"""The table of forms in ``kernels/__init__.py`` names every form, and files and tests that exist."""

from __future__ import annotations

import importlib
import re

import pytest
import warp as wp

import scgs_warp.kernels

from helpers.paths import ROOT, TESTS  # isort: skip

COLUMNS = ("portable", "cpu", "cuda", "compared in")
FOLDERS = {"portable": "", "cpu": "cpu/", "cuda": "cuda/"}
RENAMED = (
    *("adam", "compositing", "correctives", "harmonics", "neighbors"),
    *("posing", "projection", "shading", "silhouette", "skinning", "ssim"),
)
"""Stages whose forms have the same names for the same kernels."""


def table() -> dict[str, dict[str, list[str]]]:
    """Return the files in each column, by stage; a row without a stage continues the one above."""
    lines = (scgs_warp.kernels.__doc__ or "").splitlines()
    rules = [number for number, line in enumerate(lines) if line.startswith("====")]
    starts = [match.start() for match in re.finditer("=+", lines[rules[0]])]
    stages: dict[str, dict[str, list[str]]] = {}
    stage = ""
    for line in lines[rules[1] + 1 : rules[2]]:
        name, *cells = (line[start:end].strip() for start, end in zip(starts, [*starts[1:], None]))
        stage = name or stage
        row = stages.setdefault(stage, {column: [] for column in COLUMNS})
        for column, cell in zip(COLUMNS, cells, strict=True):
            row[column] += [cell] if cell else []
    return stages


def test_every_form_stands_in_the_table():
    for form in ("cpu", "cuda"):
        files = (ROOT / "kernels" / form).glob("*.py")
        forms = {path.stem for path in files if "@wp.kernel" in path.read_text(encoding="utf-8")}
        assert forms == {name for row in table().values() for name in row[form]}


def test_files_and_tests_of_the_table_exist():
    for stage, row in table().items():
        for form, folder in FOLDERS.items():
            for name in row[form]:
                assert name == "torch" or (ROOT / "kernels" / folder / f"{name}.py").is_file(), (stage, form, name)
        assert row["compared in"], f"{stage}: no test compares its forms"
        for name in row["compared in"]:
            assert (TESTS / f"{name}.py").is_file(), (stage, name)


def test_what_runs_on_cuda_has_a_portable_form():
    assert all(row["portable"] for row in table().values() if row["cuda"])


def kernels_of(module: str) -> set[str]:
    loaded = importlib.import_module(f"scgs_warp.kernels.{module}")
    return {value.key for value in vars(loaded).values() if isinstance(value, wp.Kernel)}


@pytest.mark.parametrize("stage", RENAMED)
def test_a_kernel_has_one_name_in_all_forms(stage: str):
    portable = kernels_of(stage)
    for form in ("cpu", "cuda"):
        if stage in table()[stage][form]:
            assert portable & kernels_of(f"{form}.{stage}"), f"{form}/{stage}.py shares no name with {stage}.py"
