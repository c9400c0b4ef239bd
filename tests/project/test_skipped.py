"""The test run says at its end what it did not test; CI fails where a machine lacks what it should have."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest
from other_processors import program

from helpers import chromium, node_packages, skipped
from helpers.paths import ROOT

pytest_plugins = ["pytester"]

REASONS = [
    "Skipped: no Chromium on the path; install one, or name it in CHROMIUM",
    "Skipped: no Chromium on the path; install one, or name it in CHROMIUM",
    f"Skipped: no node package three; {node_packages.INSTALL}, or name a folder with it in SCGS_NODE",
    "Skipped: SCGS_DATA does not name a folder of data sets",
    "Skipped: could not import 'tensorboard': No module named 'tensorboard'",
    "Skipped: there is a GPU",
]


def test_each_want_is_told_with_its_remedy():
    told = skipped.lines(REASONS)
    assert [line.partition(":")[0] for line in told] == [
        "2 tests for want of chromium",
        "1 test for want of npm",
        "1 test for want of data",
        "1 test for want of packages",
    ]
    assert all(want.remedy for want in skipped.WANTS)


def test_the_reasons_of_the_helpers_are_known(monkeypatch):
    """Whoever changes the words of a helper's reason is reminded here."""
    monkeypatch.delenv("CHROMIUM", raising=False)
    monkeypatch.setattr("shutil.which", lambda _: None)
    with pytest.raises(pytest.skip.Exception) as no_browser, chromium.chromium():
        pass
    with pytest.raises(pytest.skip.Exception) as no_node:
        node_packages.node("-v")
    monkeypatch.setattr(program, "compiler_path", lambda: "clang++")
    reasons = [str(no_browser.value), str(no_node.value), str(program.why_not("neon"))]
    found = [skipped.wanted_by(reason) for reason in reasons]
    assert [want.name for want in found if want is not None] == ["chromium", "npm", "emulator"]


@pytest.mark.parametrize(
    ("needs", "lacking"),
    [("", []), ("clang", []), ("npm chromium", ["npm", "chromium"]), ("data,npm", ["data", "npm"])],
)
def test_needs_are_an_explicit_list(monkeypatch, needs, lacking):
    monkeypatch.setenv(skipped.VARIABLE, needs)
    assert skipped.needed_here(REASONS) == lacking


def test_a_need_that_nobody_knows_is_refused(monkeypatch):
    monkeypatch.setenv(skipped.VARIABLE, "chrome")
    with pytest.raises(ValueError, match="'chrome' is none of chromium, npm"):
        skipped.needed_here([])


@pytest.mark.parametrize(("needs", "status"), [("", 0), ("chromium", 1)])
def test_a_run_that_lacks_what_it_needs_fails(pytester, monkeypatch, needs, status):
    monkeypatch.setenv(skipped.VARIABLE, needs)
    pytester.makeconftest((ROOT / "tests/conftest.py").read_text(encoding="utf-8"))
    pytester.makepyfile(f"import pytest\ndef test_a(): pytest.skip({REASONS[0][9:]!r})")
    done = pytester.runpytest_inprocess()
    assert done.ret == status
    done.stdout.fnmatch_lines(["*not tested here*", "1 test for want of chromium: apt-get install chromium*"])


def run_ci(folder: Path, needs: str) -> subprocess.CompletedProcess:
    """Run ``.ci/run`` on a machine on which nothing can be installed."""
    tools = folder / "bin"
    tools.mkdir()
    for name in ("dirname", "grep", "bash", "id"):
        found = subprocess.run(["which", name], capture_output=True, text=True, check=True).stdout.strip()
        (tools / name).symlink_to(found)
    (folder / "checkout/.ci").mkdir(parents=True)
    (folder / "checkout/.ci/run").write_bytes((ROOT / ".ci/run").read_bytes())
    activate = folder / "venv/bin/activate"
    activate.parent.mkdir(parents=True)
    activate.write_text("pip() { echo pip was reached; exit 7; }\n")
    python = folder / "venv/bin/python"
    python.write_text("")
    python.chmod(0o755)
    environment = {"PATH": str(tools), "CI_VENV": str(folder / "venv"), "CI_NEEDS": needs, "SCGS_DATA": "x"}
    command = [str(tools / "bash"), str(folder / "checkout/.ci/run")]
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60)


@pytest.mark.skipif(os.name != "posix", reason="CI runs on POSIX systems")
@pytest.mark.parametrize(("needs", "lacking"), [("chromium npm", "chromium"), ("npm", "npm"), ("clang", "clang")])
def test_ci_fails_for_want_of_what_the_machine_should_have(tmp_path, needs, lacking):
    done = run_ci(tmp_path, needs)
    assert done.returncode == 1 and "pip was reached" not in done.stdout
    assert done.stderr.strip() == f"error: {lacking} cannot be had here: install it, or leave it out of CI_NEEDS"


@pytest.mark.skipif(os.name != "posix", reason="CI runs on POSIX systems")
def test_ci_goes_on_where_nothing_is_needed(tmp_path):
    done = run_ci(tmp_path, "")
    assert done.returncode == 7, "the installation of the package is reached"
    assert len(re.findall(r"^no (chromium|clang|npm): ", done.stdout, re.M)) == 3
