"""The script for machines with a GPU: the record of its calls, its command line, and its rules."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from helpers.paths import ROOT
from helpers.scripts import benchmark_script
from scgs_warp.errors import UserError

check, session, rules = (benchmark_script(name) for name in ("gpu_check", "gpu_session", "gpu_rules"))
Record, Part, NotRun, Unfinished = session.Record, session.Part, session.NotRun, session.Unfinished
ABOUT = {"commit": "a" * 40, "code": None, "gpu": "H", "device": "cpu", "quick": True}
SCRIPT = ROOT / "benchmarks" / "gpu_check.py"


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def record(tmp_path: Path, said: list[str]):
    return Record.open(tmp_path / "report.json", ABOUT, said.append)


def written(record) -> dict:
    return json.loads(record.path.read_text(encoding="utf-8"))


def attempt(record, function) -> dict:
    """Run a part and return what stands in the file."""
    call = session.Call(session.setting("cpu", True), 1e12, record.path.parent, None, {}, lambda report: None)
    session.run_part("one", Part(function, 1.0), record, call)
    return written(record)["parts"]["one"]


def test_outcomes(record):
    goals = {"speed": rules.at_least(2.0, 1.5)}
    row = attempt(record, lambda call: {"passed": True, "figure": 3, "goals": goals})
    assert row["state"] == "passed" and row["figure"] == 3 and "reason" not in row and row["seconds"] >= 0
    assert written(record)["goals"] == {"one: speed": {"figure": 2.0, "least": 1.5, "met": True}}
    row = attempt(record, lambda call: {"passed": False, "figure": 4})
    assert row["state"] == "failed" and row["figure"] == 4 and written(record)["goals"] == {}


def test_what_breaks_leaves_its_trace(record):
    row = attempt(record, lambda call: {"passed": 1 / 0})
    assert row["state"] == "failed" and row["reason"] == "ZeroDivisionError: division by zero"
    assert "test_gpu_check.py" in row["trace"]


def test_progress_is_kept_by_what_stops_in_the_middle(record):
    seen = []

    def first(call):
        seen.append(call.earlier)
        call.save({"done": [1, 2]})
        seen.append(written(record)["parts"]["one"])
        time.sleep(0.11)
        raise Unfinished("2 of 3")

    def second(call):
        seen.append(call.earlier)
        raise NotRun("not today")

    row = attempt(record, first)
    assert seen[0] == {} and seen[1]["state"] == "unfinished" and seen[1]["reason"] == session.CUT
    assert row["done"] == [1, 2] and (row["state"], row["reason"]) == ("unfinished", "2 of 3")
    again = attempt(record, second)
    assert seen[2]["done"] == [1, 2] and again["done"] == [1, 2] and again["state"] == "not run"
    assert again["seconds"] >= row["seconds"] >= 0.1, "the seconds of all calls add up"


def test_a_record_is_continued(record, said):
    record.put("one", "passed", {"figure": 1})
    record.note_seconds("one", 12.34)
    record.write()
    again = Record.open(record.path, ABOUT, said.append)
    assert again.state("one") == "passed" and not said
    assert again.estimate("one", Part(print, 90.0), True) == 12.3
    assert again.estimate("two", Part(print, 90.0), False) == 90.0
    assert again.estimate("two", Part(print, 90.0), True) == 15.0, "quick parts are short"


@pytest.mark.parametrize(
    ("change", "kept"),
    [({"commit": "b" * 40}, True), ({"code": "x"}, True), ({"gpu": "A"}, False), ({"quick": False}, False)],
)
def test_another_commit_or_gpu_begins_anew(record, said, change, kept):
    record.put("one", "passed", {"figure": 1})
    record.note_seconds("one", 12.0)
    record.write()
    content = record.path.read_text(encoding="utf-8")
    new = Record.open(record.path, {**ABOUT, **change}, said.append)
    aside = record.path.with_name("report-aaaaaaa-1.json")
    assert aside.read_text(encoding="utf-8") == content, "nothing is lost"
    assert new.state("one") is None and written(new)["parts"] == {}
    assert new.content["estimates"] == ({"one": 12.0} if kept else {}), "another GPU takes another time"
    assert len(said) == 1 and next(iter(change)) in said[0] and aside.name in said[0]
    Record.open(record.path, ABOUT, said.append)
    Record.open(record.path, {**ABOUT, **change}, said.append)
    assert record.path.with_name("report-aaaaaaa-2.json").exists()


def test_code_without_a_commit_is_described_by_its_hash(monkeypatch, tmp_path):
    assert session.identity("a" * 40, None, "cpu", True)["code"] is None
    (tmp_path / "kernels").mkdir()
    source = tmp_path / "kernels" / "one.py"
    source.write_text("a = 1")
    monkeypatch.setattr(session, "ROOT", tmp_path)
    codes = [session.identity(commit, None, "cpu", True)["code"] for commit in (None, "a-dirty")]
    source.write_text("a = 2")
    codes.append(session.identity(None, None, "cpu", True)["code"])
    assert codes[0] == codes[1] != codes[2]


@pytest.mark.parametrize(
    "content",
    ["{", "[]", "{}", '{"parts": []}', '{"parts": {"one": {"state": "fine"}}, "estimates": {}}', '{"parts": {}}'],
)
def test_a_damaged_record_is_refused_and_left_as_it_is(tmp_path, content):
    path = tmp_path / "report.json"
    path.write_text(content)
    with pytest.raises(UserError, match=r"report\.json: .*restore"):
        Record.open(path, ABOUT, print)
    assert path.read_text() == content and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("states", "status"),
    [
        (["passed", "passed"], 0),
        (["passed", "failed"], 1),
        (["failed", "not run"], 1),
        (["passed", "not run"], 3),
        (["passed", "unfinished"], 3),
        (["passed", None], 3),
    ],
)
def test_exit_status(record, states, status):
    for name, state in zip("ab", states):
        if state is not None:
            record.put(name, state, {})
    assert record.conclude(["a", "b"]) == status
    assert written(record)["state"] == {0: "passed", 1: "failed", 3: "unfinished"}[status]


def main(*words: str | Path) -> int:
    return check.main(["--device", "cpu", "--quick", *map(str, words)])


def test_mistakes_in_a_call(tmp_path, capsys, monkeypatch):
    mistakes = {"no such part": ("--parts", "agreement,nonsense"), "no such folder": ("--data", tmp_path / "nowhere")}
    mistakes["again: no such"] = ("--again", "again")
    for said, words in mistakes.items():
        assert main(*words) == 2
        error = capsys.readouterr().err
        assert said in error and len(error.splitlines()) == 1
    (tmp_path / "bad.json").write_text("{")
    assert main("--output", tmp_path / "bad.json", "--work", tmp_path) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1 and (tmp_path / "bad.json").read_text() == "{"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert check.main(["--device", "cuda"]) == 2 and "finds no GPU" in capsys.readouterr().err


def test_only_a_gpu_writes_the_file_of_measured_figures(tmp_path, monkeypatch):
    monkeypatch.setattr(check, "ROOT", tmp_path)

    def place(gpu: str | None, *words: str) -> str:
        options = check.options_of(["--device", "cpu" if gpu is None else "cuda", *words])
        return check.places(options, gpu)[0].relative_to(tmp_path).as_posix()

    assert place("NVIDIA H200") == "benchmarks/results/gpu_check_cuda.json"
    assert place("NVIDIA H200", "--quick") == "runs/gpu_check_cuda_quick.json"
    assert place("pretended") == "runs/gpu_check_pretended.json"
    assert place(None) == "runs/gpu_check_cpu.json"
    assert not (ROOT / "benchmarks" / "results" / "gpu_check_cuda.json").exists() or json.loads(
        (ROOT / "benchmarks" / "results" / "gpu_check_cuda.json").read_text(encoding="utf-8")
    )["gpu"] not in (None, "pretended")
    for gpu, words in (("pretended", ()), ("NVIDIA H200", ("--quick",)), (None, ())):
        with pytest.raises(UserError, match="only figures of a real GPU"):
            place(gpu, *words, "--output", str(tmp_path / "gpu_check_cuda.json"))


def test_parts_stand_in_order_of_worth():
    first = ("agreement", "bits", "sanitizer", "tests", "frame", "step", "gsplat", "paper", "best")
    assert tuple(check.PARTS)[: len(first)] == first
    assert sum(part.seconds for part in check.PARTS.values()) <= 25 * 60
    assert check.options_of(["--device", "cpu"]).parts == [name for name in check.PARTS if name not in check.NEED_A_GPU]


def test_goals():
    assert (rules.FRAMES_A_SECOND, rules.GSPLAT_RATIO, rules.TRAINING_SECONDS) == (1500.0, 1.5, 300.0)
    assert rules.at_least(1500.0, 1500.0)["met"] and not rules.at_least(float("nan"), 1.0)["met"]
    assert rules.at_most(0.1, 0.15)["met"] and not rules.at_most(0.2, 0.15)["met"]


def test_its_rules_can_fail():
    image = torch.rand(4, 50, 50)
    assert rules.compare_images(image, image)["passed"]
    flipped = image.clone()
    flipped[0, 3, 3] += 1 / 255
    assert rules.compare_images(image, flipped)["passed"]
    flipped[0, 3, 3] += 0.1
    assert not rules.compare_images(image, flipped)["passed"]
    assert not rules.compare_images(image, image + 2e-4)["passed"]
    assert not rules.compare_images(image, torch.full_like(image, float("nan")))["passed"]
    gradient = torch.rand(200, 3) + 0.1
    assert rules.compare_gradients(gradient, gradient)["passed"]
    assert not rules.compare_gradients(gradient, 1.1 * gradient)["passed"]


def test_functions_are_timed_in_turns(monkeypatch):
    order = []
    functions = {"a": lambda: order.append("a"), "b": lambda: (order.append("b"), time.sleep(2e-3))}
    times = rules.alternate(functions, "cpu", 5)
    assert order == ["a", "b"] * (5 + rules.WARM_UP)
    assert times["b"]["ms_median"] >= 2.0 > times["a"]["ms_median"]


def test_a_killed_call_is_continued(tmp_path, device):
    """The process of the part that runs ends with the call; the next call begins this part again."""
    output, work = tmp_path / "report.json", tmp_path / "work"
    command = [sys.executable, str(SCRIPT), "--device", device, "--quick", "--parts", "agreement", "--commit", "abc"]
    command += ["--output", str(output), "--work", str(work)]
    call = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    row: dict = {}
    try:
        while not row:
            assert call.poll() is None
            time.sleep(0.01)
            row = (
                json.loads(output.read_text(encoding="utf-8"))["parts"].get("agreement", {}) if output.exists() else {}
            )
        children = [path for path in Path("/proc").iterdir() if path.name.isdigit() and _belongs(path, work)]
    finally:
        call.kill()
        call.wait()
    assert (row["state"], row["reason"]) == ("unfinished", session.CUT)
    assert children, "the part has a process"
    deadline = time.time() + 10
    while any(_belongs(child, work) for child in children):
        assert time.time() < deadline, "the process of the part goes on"
        time.sleep(0.05)
    result = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    after = json.loads(output.read_text(encoding="utf-8"))
    assert after["state"] == "passed" and after["parts"]["agreement"]["control-points"]["passed"]
    assert after["gpu"] == (torch.cuda.get_device_name() if device == "cuda" else None)


def _belongs(process: Path, work: Path) -> bool:
    try:
        words = (process / "cmdline").read_bytes()
    except OSError:
        return False
    return str(work).encode() in words and b"--inside" in words
