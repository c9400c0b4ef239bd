"""Each of the sixty mistakes of a newcomer gets its answer. ``hour.py`` replays them as processes of their own."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import pytest

from newcomer import places
from newcomer.judge import Answer, fingerprints, judge
from newcomer.mistakes import MISTAKES, Mistake
from scgs_warp.apps import __main__ as console

NOT_YET: set[str] = set()
"""Mistakes whose answer is still to be mended."""


def words(command: str) -> list[str]:
    """Split a command of the list into words."""
    return shlex.split(command.format(tiny=places.TINY))


def run(arguments: list[str], capfd: pytest.CaptureFixture[str]) -> Answer:
    """Run a command in this process, which is faster than in one of its own."""
    capfd.readouterr()
    try:
        status = console.main(arguments)
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    said = capfd.readouterr()
    return Answer(status, said.out, said.err)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working folder with data and a finished run."""
    place = tmp_path_factory.mktemp("newcomer") / "place"
    places.write_data(place)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        command = "train --data data/blobs --output runs/blobs {tiny} --steps 60"
        assert console.main(words(command)) == 0
    return place


def test_there_are_sixty():
    assert len({mistake.name for mistake in MISTAKES}) == len(MISTAKES) == 60


def cases() -> list:
    """Return a parameter for every mistake."""
    mend = [pytest.mark.xfail(reason="still to be mended")]
    return [pytest.param(m, id=m.name, marks=mend if m.name in NOT_YET else ()) for m in MISTAKES]


@pytest.mark.parametrize("mistake", cases())
def test_the_answer(mistake: Mistake, template: Path, tmp_path: Path, monkeypatch, capfd):
    place = tmp_path / "place"
    shutil.copytree(template, place)
    places.settle(place)
    getattr(places, mistake.given)(place)
    monkeypatch.chdir(place)
    before = fingerprints(place)
    answer = run(words(mistake.command), capfd)
    assert judge(mistake, answer, before, fingerprints(place)) == [], answer
