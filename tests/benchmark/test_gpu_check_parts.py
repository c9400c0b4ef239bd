"""Parts of ``gpu_check``: each runs small on every device, and each can fail; those that call programs meet fakes."""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path

import pytest
import torch
import torch.distributed as dist

from helpers.scripts import benchmark_script
from scgs_warp.scene.frame_graph import FrameGraph
from scgs_warp.training.recorded_update import RecordedUpdate

check, session, sanitizer, agreement, speed = (
    benchmark_script(f"gpu_{name}") for name in ("check", "session", "sanitizer", "agreement", "speed")
)
NotRun, Unfinished = session.NotRun, session.Unfinished


class Part:
    """A call of one part."""

    def __init__(self, device: str, work: Path) -> None:
        self.saved: list[dict] = []
        self.call = session.Call(session.setting(device, True), time.time() + 1e6, work, None, {}, self.saved.append)

    def __call__(self, name: str, seconds: float = 1e6) -> dict:
        """Run a part; what it saves is what it begins with when it runs again."""
        self.call.deadline = time.time() + seconds
        try:
            return check.PARTS[name].run(self.call)
        finally:
            if self.saved:
                self.call.earlier = self.saved[-1]


@pytest.fixture
def part(tmp_path) -> Part:
    return Part("cpu", tmp_path)


@pytest.fixture
def on_gpu(tmp_path) -> Part:
    return Part("cuda", tmp_path)


@pytest.fixture
def portable(monkeypatch):
    """Let the pretended device composite with the portable form, as in all tests of training."""
    if device := sys.modules.get("pretended_cuda.warp_device"):
        monkeypatch.setattr(device, "native_bodies", False)


def test_agreement(device, tmp_path):
    report = Part(device, tmp_path)("agreement")
    assert report["passed"] and {"sharpness 0.0", "sharpness 0.5", "control-points", "hexplane"} < report.keys()
    names = {"means", "quats", "scales", "opacities", "sh_dc", "sh_rest"}
    assert report["sharpness 0.5"]["gradients"].keys() == names


def test_agreement_can_fail(part, monkeypatch):
    inner = agreement.composite

    def wrong(splats, colors, tiles, form):
        image, alpha = inner(splats, colors, tiles, form=form)
        return (image * 1.001 if form == "auto" else image), alpha

    monkeypatch.setattr(agreement, "composite", wrong)
    report = part("agreement")
    assert not report["passed"] and not report["sharpness 0.5"]["passed"] and report["control-points"]["passed"]


def test_bits(device, tmp_path, portable):
    report = Part(device, tmp_path)("bits")
    assert report["passed"], report
    moving = report["frames of control-points"]
    assert {"frame 4", "room grew", "recorded"} < moving["checks"].keys() and all(moving["checks"].values())
    steps = report["steps"]
    assert all(steps["checks"].values()) and ("recorded" in steps["checks"]) == (device == "cuda")


def test_a_frame_that_lacks_splats_is_noticed(part, monkeypatch):
    monkeypatch.setattr(FrameGraph, "finish", lambda self, pending: pending.image)
    report = agreement.frames_of("static", part.call.setting)
    assert not report["passed"] and not report["checks"]["frame 4"] and not report["checks"]["room grew"]


def test_two_runs_that_differ_are_noticed(part, monkeypatch):
    results = iter(range(100))
    monkeypatch.setattr(agreement, "drawn", lambda *args: [torch.full((2,), float(next(results)))])
    monkeypatch.setattr(agreement, "frames_of", lambda *args: {"passed": True})
    monkeypatch.setattr(agreement, "steps_of", lambda *args: {"passed": True})
    assert not part("bits")["passed"]


def test_a_recorded_step_that_differs_is_noticed(device, tmp_path, portable, monkeypatch):
    if device == "cpu":
        pytest.skip("there are no recorded steps on a CPU")
    inner = RecordedUpdate.numbers
    monkeypatch.setattr(RecordedUpdate, "numbers", lambda self, view: inner(self, view) * (1 + 1e-6))
    report = agreement.steps_of(Part(device, tmp_path).call.setting)
    assert report["checks"] == {"two runs": True, "recorded and plain": False, "recorded": True}
    assert not report["passed"]


def test_a_run_that_differs_is_noticed(part, monkeypatch):
    fit, runs = agreement.loop.fit, iter(range(3))

    def another(config, *args, **rest):
        fit(dataclasses.replace(config, seed=int(next(runs) == 1)), *args, **rest)

    monkeypatch.setattr(agreement.loop, "fit", another)
    report = agreement.steps_of(part.call.setting)
    assert not report["passed"] and report["checks"] == {"two runs": False, "recorded and plain": False}


@pytest.mark.parametrize("name", ["frame", "step", "forms", "raster", "crowded"])
def test_parts_run_small(name, device, tmp_path, portable):
    report = Part(device, tmp_path)(name)
    assert report["passed"]
    if name == "frame":
        assert len(report["table_s2"]) == len(report["rows"]) == 4 and 0 < report["motion_share"]
        assert report["goals"]["frames a second"]["least"] == 1500.0
    elif name == "step":
        assert {"step", "step/arap"} <= {row["name"] for row in report["rows"]}
        row = report["in_turns"]["step/arap"]
        assert row["ratio"] > 0 and (row.get("recordings", 0) > 0) == (device == "cuda")
    elif name == "forms":
        assert report["tiny/cuda" if device == "cuda" else "tiny/cpu"]["both"]["ms_median"] > 0
    elif name == "raster":
        assert report["small"]["both"]["ms_median"] > 0 and report["small"]["pairs"] > 100


def test_goals_are_judged_on_a_gpu_alone():
    report = {"goals": {"speed": {"met": False}}}
    assert speed.met(report, session.setting("cuda", False)) and speed.met(report, session.setting("cuda", True, True))
    assert not speed.met(report, session.setting("cuda", False, True))


@pytest.mark.slow
def test_a_process_group_of_one(part, monkeypatch):
    made, init = [], dist.init_process_group
    monkeypatch.setattr(dist, "init_process_group", lambda *args, **kwargs: (made.append(args), init(*args, **kwargs)))
    assert part("share")["same_bits"]
    assert made == [("gloo",)], "one process would train without a group"


# Sanitizer

FAKE = """#!{python}
import os, sys
tool = sys.argv[2]
print(tool, os.environ.get("PYTORCH_NO_CUDA_MEMORY_CACHING", "-"), file=open({log!r}, "a"))
print("========= COMPUTE-SANITIZER")
{body}
"""
SUMMARIES = """
print("gpu_small: done")
if tool == "memcheck": print("========= ERROR SUMMARY: {memory} errors")
if tool == "racecheck": print("========= RACECHECK SUMMARY: {races} hazards displayed (0 errors, {races} warnings)")
sys.exit({status})
"""


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """Make an executable compute-sanitizer on PATH, and a small program that is done at once."""
    small = tmp_path / "small.py"
    small.write_text("print('gpu_small: done')")
    monkeypatch.setattr(sanitizer, "SMALL", small)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("CUDA_PATH", raising=False)
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "nothing"))
    log = tmp_path / "calls"

    def make(body: str, place: str = "bin") -> Path:
        (tmp_path / place).mkdir(parents=True, exist_ok=True)
        program = tmp_path / place / "compute-sanitizer"
        program.write_text(FAKE.format(python=sys.executable, log=str(log), body=body))
        program.chmod(0o755)
        return log

    return make


def summaries(memory: int = 0, races: int = 0, status: int = 0) -> str:
    return SUMMARIES.format(memory=memory, races=races, status=status)


@pytest.mark.parametrize("place", ["bin", "nothing/bin"])
def test_no_sanitizer_report(fake, on_gpu, place):
    log = fake(summaries(), place)
    report = on_gpu("sanitizer")
    assert report["passed"]
    reports = {name: row["reports"] for name, row in report["checks"].items()}
    assert reports == {"plain": None, "memcheck": 0, "racecheck": 0}
    assert [line.split()[:2] for line in log.read_text().splitlines()] == [["memcheck", "1"], ["racecheck", "-"]]


def test_a_sanitizer_without_a_deadline(fake, on_gpu):
    fake(summaries())
    assert on_gpu("sanitizer", seconds=float("inf"))["passed"]


@pytest.mark.parametrize(
    ("numbers", "bad"),
    [({"memory": 1, "status": 86}, "memcheck"), ({"races": 2}, "racecheck"), ({"status": 1}, "memcheck")],
)
def test_a_sanitizer_report_is_a_failure(fake, on_gpu, numbers, bad):
    fake(summaries(**numbers))
    report = on_gpu("sanitizer")
    assert not report["passed"] and not report["checks"][bad]["passed"]
    assert any("COMPUTE-SANITIZER" in line for line in report["checks"][bad]["report"])


def test_a_sanitizer_without_a_summary_is_a_failure(fake, on_gpu):
    fake("print('gpu_small: done')")
    assert not on_gpu("sanitizer")["passed"]


def test_a_program_that_does_not_end_is_a_failure(fake, on_gpu):
    fake(summaries())
    sanitizer.SMALL.write_text("1 / 0")
    report = on_gpu("sanitizer")
    assert not report["passed"] and "ZeroDivisionError" in report["checks"]["plain"]["end"]
    assert report["checks"].keys() == {"plain"}


def test_no_sanitizer_is_not_a_pass(fake, on_gpu, part):
    with pytest.raises(NotRun, match="no compute-sanitizer"):
        on_gpu("sanitizer")
    fake("print('========= Error: Device not supported. Please refer to the manual'); sys.exit(1)")
    with pytest.raises(NotRun, match="Device not supported"):
        on_gpu("sanitizer")
    with pytest.raises(NotRun, match="GPUs only"):
        part("sanitizer")


def test_the_sanitizer_continues_with_the_check_that_was_cut(fake, on_gpu):
    log = fake("import time\nif tool == 'racecheck': time.sleep(30)\n" + summaries())
    with pytest.raises(Unfinished, match="racecheck"):
        on_gpu("sanitizer", seconds=sanitizer.LEAST + 1.5)
    assert on_gpu.saved[-1]["checks"].keys() == {"plain", "memcheck"}
    fake(summaries())
    assert on_gpu("sanitizer")["passed"]
    tools = [line.split()[0] for line in log.read_text().splitlines()]
    assert tools.count("memcheck") == 1 and tools[-1] == "racecheck"
