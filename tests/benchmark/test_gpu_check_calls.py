"""Calls of ``gpu_check``: the order of the parts, the deadline, and parts that hang or die. The parts are pretended."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from helpers.scripts import benchmark_script

calls, session = benchmark_script("gpu_calls"), benchmark_script("gpu_session")
Part, Record = session.Part, session.Record
ABOUT = {"commit": "a" * 40, "code": None, "gpu": "H", "device": "cpu", "quick": False}
CHILD = """
import json, os, sys, time
words = sys.argv[1:]
name, record = words[words.index("--inside") + 1], words[words.index("--output") + 1]
def put(state, **rest):
    content = json.load(open(record))
    content["parts"][name] = {"state": state, "seconds": 0.0, **rest}
    json.dump(content, open(record + ".new", "w"))
    os.replace(record + ".new", record)
    open(record + ".order", "a").write(name + " ")
put("unfinished", reason="it was cut off", saved=7)
if name.startswith("long") or name == "hangs":
    time.sleep(60)
if name == "dies":
    print("a last word", file=sys.stderr, flush=True)
    os.abort()
if name == "silent":
    sys.exit(0)
put("not run", reason="not here") if name == "absent" else put("failed" if name == "bad" else "passed")
"""


class Calls:
    """Calls on one record with parts that are only names and estimates."""

    def __init__(self, folder: Path) -> None:
        self.record = Record.open(folder / "report.json", ABOUT, print)
        self.reason: list[str | None] = [None]
        """Why timed parts are blocked; the last one stays."""

    def run(self, parts: dict, seconds: float) -> dict[str, str]:
        """Return the states after a call."""

        def blocked() -> str | None:
            return self.reason.pop(0) if len(self.reason) > 1 else self.reason[0]

        made = {name: part if isinstance(part, Part) else Part(print, part) for name, part in parts.items()}
        options = ["--output", str(self.record.path)]
        calls.run_parts(
            calls.Plan(made, self.record, False, time.time() + seconds, options, self.record.path.parent, blocked)
        )
        content = json.loads(self.record.path.read_text(encoding="utf-8"))
        return {name: part["state"] for name, part in content["parts"].items()}

    @property
    def order(self) -> list[str]:
        """The parts that ran, in order."""
        names = self.record.path.with_name("report.json.order").read_text().split()
        return [name for index, name in enumerate(names) if index == 0 or names[index - 1] != name]


@pytest.fixture
def made(tmp_path, monkeypatch) -> Calls:
    script = tmp_path / "child.py"
    script.write_text(CHILD)
    monkeypatch.setattr(calls, "SCRIPT", script)
    return Calls(tmp_path)


def test_parts_run_in_order_and_once(made, capsys):
    states = made.run({"good": 1.0, "bad": 1.0, "absent": 1.0, "dies": 1.0, "silent": 1.0, "last": 1.0}, 100.0)
    assert made.order == ["good", "bad", "absent", "dies", "silent", "last"]
    expected = {"good": "passed", "bad": "failed", "absent": "not run", "dies": "failed", "silent": "failed"}
    assert states == {**expected, "last": "passed"}
    dead = made.record.part("dies")
    assert "SIGABRT" in dead["reason"] and "a last word" in dead["messages"] and dead["saved"] == 7
    assert "status 0" in made.record.part("silent")["reason"]
    shown = capsys.readouterr().out
    assert (
        "[2/6] bad: about 0:01; all that is left about 0:05, 1:" in shown
        and "absent: not run (0.0 s): not here" in shown
    )
    made.run({"good": 1.0, "bad": 1.0, "absent": 1.0, "last": 1.0}, 100.0)
    assert made.order[6:] == ["absent"], "only what is neither passed nor failed runs again"


def test_no_part_begins_that_cannot_end(made):
    states = made.run({"first": 1.0, "longest": 50.0, "short": 1.0}, 30.0)
    assert made.order == ["first", "short"] and states["longest"] == "not run"
    assert "about 0:50" in made.record.part("longest")["reason"]


def test_a_part_that_can_continue_begins(made):
    states = made.run({"first": 1.0, "goes on": Part(print, 500.0, continues=True)}, 100.0)
    assert states == {"first": "passed", "goes on": "passed"}
    states = made.run({"too late": Part(print, 500.0, continues=True)}, calls.STARTS_WITH - 1)
    assert states["too late"] == "passed", "nothing else ran in this call"
    states = made.run({"first again": 1.0, "later": Part(print, 500.0, continues=True)}, calls.STARTS_WITH - 1)
    assert states["later"] == "not run"


def test_the_deadline_cuts_a_part_and_corrects_its_estimate(made):
    began = time.time()
    states = made.run({"long": 0.5, "next": 0.1}, 1.5)
    assert time.time() - began < 5.0
    assert states == {"long": "unfinished", "next": "not run"}
    row = made.record.part("long")
    assert row["reason"].startswith("it was cut off by the end of the call") and row["saved"] == 7
    assert 2.0 < made.record.content["estimates"]["long"] < 10.0
    made.run({"long": 0.5, "next": 0.1}, 2.0)
    assert made.order == ["long", "next"], "what takes longer than this call waits"
    made.run({"long": 0.5}, 1.0)
    assert made.order == ["long", "next", "long"], "but for a call with nothing else to do"


def test_a_part_that_hangs_is_stopped(made, monkeypatch):
    monkeypatch.setattr(calls, "HANGS_AFTER", (4.0, 0.5))
    states = made.run({"hangs": 0.1, "next": 0.1}, 100.0)
    assert states == {"hangs": "failed", "next": "passed"} and "it hangs" in made.record.part("hangs")["reason"]


def test_timed_parts_wait_for_a_build(made, monkeypatch, capsys):
    timed = Part(print, 1.0, timed=True)
    made.reason = ["a build"] * 4 + [None]
    states = made.run({"fast": timed, "calm": 1.0}, 100.0)
    assert made.order == ["calm", "fast"] and set(states.values()) == {"passed"}
    assert capsys.readouterr().out.count("waiting: a build") == 1
    made.reason = ["a build"]
    assert made.run({"faster": timed}, 2.5)["faster"] == "not run"
    assert made.record.part("faster")["reason"] == "a build"


def test_durations_are_remembered(made):
    made.run({"good": 33.0, "bad": 33.0, "absent": 33.0}, 100.0)
    known = made.record.content["estimates"]
    assert known.keys() == {"good", "bad"} and all(0 <= seconds < 10 for seconds in known.values())
