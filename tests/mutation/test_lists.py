"""The lists of mutants belong to the present code, and the runner judges what it sees."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from mutation.mutants import LISTS, Mutant, read_all, read_list
from mutation.run import judge, mutated, read_results, write_results

from helpers.paths import ROOT

MUTANTS = read_all()
AREAS = {
    "kernels": "kernels/",
    "ops": "scgs_warp/ops/",
    "training": "scgs_warp/training/",
    "data": "scgs_warp/data/",
    "evaluation": "scgs_warp/evaluation/",
    "edit": "scgs_warp/edit/",
    "export": "scgs_warp/export/",
    "security": "scgs_warp/storage/",
}


def test_there_are_enough_of_every_area():
    assert len(MUTANTS) >= 250
    counts = {area: sum(m.file.startswith(folder) for m in MUTANTS) for area, folder in AREAS.items()}
    assert all(counts.values()), counts


@pytest.mark.parametrize("file", sorted({m.file for m in MUTANTS}))
def test_each_mutant_changes_one_place_of_the_code(file):
    """Where the code has moved on, the mutant moves with it, or the like mutant takes its place."""
    text = (ROOT / file).read_text(encoding="utf-8")
    for mutant in (m for m in MUTANTS if m.file == file):
        assert mutant.apply(text) != text
        assert 1 <= mutant.line(text) <= text.count("\n") + 1


def test_each_mutant_has_a_name_and_tests_of_its_own():
    assert [name for name, count in Counter(m.name for m in MUTANTS).items() if count > 1] == []
    missing = {path for m in MUTANTS for path in m.tests if not (ROOT / path).is_file()}
    assert missing == set() and all(m.tests for m in MUTANTS)


def test_a_list_is_read_like_a_patch(tmp_path: Path):
    lines = ["# about", "", "== a.py", "tests: t.py u.py", "# why", "-x = 1", "-y = 2", "+x = 2", "-z", "+w"]
    lines += ["= the same", "", "== b.py", "tests: v.py", "-gone"]
    (tmp_path / "a.txt").write_text("\n".join(lines))
    first, second, third = read_list(tmp_path / "a.txt")
    assert first == Mutant("a.py", "x = 1\ny = 2", "x = 2", ("t.py", "u.py"))
    assert second == Mutant("a.py", "z", "w", ("t.py", "u.py"), "the same")
    assert third == Mutant("b.py", "gone", "", ("v.py",))
    assert first.apply("w = 0\nx = 1\ny = 2\n") == "w = 0\nx = 2\n" and first.line("w = 0\nx = 1\ny = 2\n") == 2
    with pytest.raises(ValueError, match="occurs 2 times"):
        second.apply("z z")
    (tmp_path / "a.txt").write_text("what")
    with pytest.raises(ValueError, match="begins with none of"):
        read_list(tmp_path / "a.txt")


def test_a_mutant_is_undone(tmp_path: Path):
    (tmp_path / "a.py").write_text("x = 1\n")
    with pytest.raises(KeyboardInterrupt), mutated(tmp_path, Mutant("a.py", "1", "2", ())) as line:
        assert line == 1 and (tmp_path / "a.py").read_text() == "x = 2\n"
        raise KeyboardInterrupt
    assert (tmp_path / "a.py").read_text() == "x = 1\n"


@pytest.mark.parametrize(
    ("ended", "number", "log", "verdict"),
    [
        ("status", 0, "2 passed", ("survived", "")),
        ("status", 1, "FAILED t.py::test_a - assert 1\n1 failed", ("killed", "t.py::test_a")),
        ("status", 2, "ERROR t.py\nInterrupted: 1 error during collection", ("killed", "t.py")),
        ("status", 4, "file not found", ("unknown", "status 4")),
        ("signal", 11, "", ("killed", "signal 11")),
        ("time", 0, "", ("killed", "time")),
    ],
)
def test_verdicts(ended, number, log, verdict):
    assert judge(ended, number, log) == verdict


def test_results_of_other_mutants_are_kept(tmp_path: Path):
    rows = {m.name: {"mutant": m.name, "verdict": "killed"} for m in MUTANTS[:2]}
    write_results(tmp_path / "a.json", rows | {"gone.py#0": {"mutant": "gone.py#0", "verdict": "survived"}})
    found = read_results(tmp_path / "a.json")
    assert found == rows and read_results(tmp_path / "b.json") == {}
    assert LISTS.is_dir()
