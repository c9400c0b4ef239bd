"""The long parts of ``gpu_check``, which later calls continue: tests, training, and the compilation of gsplat."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from helpers.scripts import benchmark_script

check, session, gsplat, training, tested = (
    benchmark_script(f"gpu_{name}") for name in ("check", "session", "gsplat", "training", "tests")
)
NotRun, Unfinished = session.NotRun, session.Unfinished


class Part:
    """Calls of one part; what it saves is what it begins with when it runs again."""

    def __init__(self, device: str, work: Path) -> None:
        self.saved: list[dict] = []
        self.call = session.Call(session.setting(device, True), 0.0, work, None, {}, self.saved.append)

    def __call__(self, name: str, until: Callable[[], bool] = lambda: False) -> dict:
        """Run a part; the time is over as soon as ``until`` returns True."""
        self.call.left = lambda: 0.0 if until() else 1e6  # type: ignore[method-assign]
        try:
            return check.PARTS[name].run(self.call)
        finally:
            if self.saved:
                self.call.earlier = self.saved[-1]


# Tests

BODIES = {
    "good": "pass",
    "bad": "assert 1 == 2, 'a reason'",
    "absent": "pytest.skip('no')",
    "dies": "os.abort()",
    "broken": "raise RuntimeError('CUDA error: an illegal memory access was encountered')",
    "after": "pass",
    "endless": "time.sleep(0 if os.path.exists('fast') else 60)",
}


@pytest.fixture
def suite(tmp_path, monkeypatch):
    """Make a project with some of the tests; its log has a line for every test that begins."""
    root = tmp_path / "project"
    (root / "tests").mkdir(parents=True)
    monkeypatch.setattr(tested, "ROOT", root)
    monkeypatch.setattr(tested, "QUICK", ["tests"])

    def make(*names: str) -> Path:
        lines = ["import os, time, pytest"]
        for name in names:
            lines += [f"def test_{name}():", f"    print({name!r}, file=open('began', 'a'))", f"    {BODIES[name]}"]
        (root / "tests" / "test_some.py").write_text("\n".join(lines))
        return root / "began"

    return make


def test_what_has_passed_is_not_repeated(suite, tmp_path):
    part, began = Part("cpu", tmp_path), suite("good", "bad", "absent", "endless")
    with pytest.raises(Unfinished, match="2 of 4 tests have passed, 1 have failed"):
        part("tests", until=lambda: began.exists() and "endless" in began.read_text())
    first = part.saved[-1]
    assert first["total"] == 4 and first["skipped"] == 1 and len(first["fine"]) == 2
    assert "a reason" in first["failures"]["tests/test_some.py::test_bad"]
    (began.parent / "fast").touch()
    report = part("tests")
    assert (
        not report["passed"] and report["total"] == 4 and list(report["failures"]) == ["tests/test_some.py::test_bad"]
    )
    assert began.read_text().split() == ["good", "bad", "absent", "endless", "bad", "endless"]


def test_a_process_that_dies_fails_one_test(suite, tmp_path):
    began = suite("good", "dies", "broken", "after")
    report = Part("cpu", tmp_path)("tests")
    names = [name.rpartition("_")[2] for name in report["failures"]]
    assert not report["passed"] and names == ["dies", "broken"] and report["total"] == 4
    assert "status -6" in report["failures"]["tests/test_some.py::test_dies"]
    assert began.read_text().split() == ["good", "dies", "broken", "after"]
    assert [name.rpartition("_")[2] for name in report["fine"]] == ["good", "after"]


def test_all_tests_pass(suite, tmp_path):
    suite("good", "absent")
    report = Part("cpu", tmp_path)("tests")
    assert report["passed"] and report["skipped"] == 1 and report["failures"] == {} and "fine" not in report


def test_tests_that_cannot_be_collected_are_a_failure(suite, tmp_path):
    began = suite("good")
    (began.parent / "tests" / "test_wrong.py").write_text("import nothing_of_this_name")
    report = Part("cpu", tmp_path)("tests")
    assert not report["passed"] and "nothing_of_this_name" in report["failures"]["process 0"]


def test_no_tests_are_a_failure(suite, tmp_path):
    suite()
    assert not Part("cpu", tmp_path)("tests")["passed"]


def test_shares_and_selection(suite, tmp_path, monkeypatch):
    """Two processes run every test once; those that a machine without a GPU runs are left out."""
    began = suite()
    body = "import pytest\n@pytest.mark.parametrize('device', ['cpu', 'cuda'])\n"
    body += "def test_one(device):\n    print(__name__ + device, file=open('began', 'a'))\n"
    names = [f"test_{letter}.py" for letter in "abcdefgh"]
    for name in [*names, "test_gpu_check.py", "test_x_emulated.py"]:
        (began.parent / "tests" / name).write_text(body)
    monkeypatch.setattr(tested, "QUICK", [])
    monkeypatch.setattr(tested.environment, "available_threads", lambda: 2 * tested.CORES_OF_ONE)
    part = Part("cpu", tmp_path)
    part.call.setting = part.call.setting._replace(quick=False)
    report = part("tests")
    assert report["passed"] and report["processes"] == 2 and report["total"] == len(names)
    assert sorted(word[-10:] for word in began.read_text().split()) == [f"test_{name}cuda" for name in "abcdefgh"]


# Training

TRAIN = """
import json, pathlib, signal, sys, time
words = sys.argv[1:]
folder = pathlib.Path(words[words.index("--output") + 1])
folder.mkdir(parents=True, exist_ok=True)
print(*words[words.index("--preset"):], file=open("runs", "a"))
log, config = folder / "log.jsonl", folder / "config.json"
if config.exists() != ("--resume" in words):
    sys.exit("a run is there, or not")
(folder / "begun").write_text(json.dumps({"steps": 1000}))
(folder / "begun").rename(config)
if pathlib.Path("broken").exists():
    sys.exit("no images")
rows = [json.loads(line) for line in log.open()] if log.exists() else []
step, seconds = (rows[-1]["step"], rows[-1]["seconds"]) if rows else (0, 0.0)
asked = []
signal.signal(signal.SIGINT, lambda *rest: asked.append(1))
while step < 1000:
    time.sleep(0.02)
    step, seconds = step + 50, seconds + float(open("pace").read())
    print(json.dumps({"step": step, "seconds": seconds}), file=log.open("a"), flush=True)
    if asked:
        sys.exit(130)
(folder / "written").write_text(json.dumps({"psnr": 31.0, "ssim": 0.9, "seconds": seconds, "gaussians": 7}))
(folder / "written").rename(folder / "metrics.json")
"""


@pytest.fixture
def trainer(tmp_path, monkeypatch):
    """Replace the app; the file ``pace`` has the seconds that it claims for 50 steps."""
    root = tmp_path / "project"
    (root / "apps").mkdir(parents=True)
    (root / "apps" / "train.py").write_text(TRAIN)
    (root / "apps" / "synthesize.py").write_text(
        "import pathlib, sys\nfolder = pathlib.Path(sys.argv[2])\nfolder.mkdir()\n"
        "(folder / 'transforms_test.json').touch()\nprint('made', file=open('runs', 'a'))\n"
    )
    monkeypatch.setattr(training, "ROOT", root)
    monkeypatch.setattr(training, "LOOKS_EVERY", 0.02)
    monkeypatch.setattr(training, "SAVES_EVERY", 0.0)

    def pace(seconds: float) -> Path:
        (root / "pace").write_text(str(seconds))
        return root / "runs"

    return pace


@pytest.fixture
def judged(tmp_path) -> Part:
    part = Part("cuda", tmp_path)
    part.call.setting = session.setting("cuda", False, judged=True)
    return part


def test_a_run_in_time(trainer, judged):
    runs = trainer(10.0)
    report = judged("best")
    assert (
        report["passed"] and report["finished"] and report["psnr"] == 31.0 and report["steps"] == report["of"] == 1000
    )
    assert report["seconds_in_all"] == 200.0 and report["goals"]["seconds of training"]["met"]
    assert [line.split()[0] for line in runs.read_text().splitlines()] == ["made", "--preset"]
    assert "best" in runs.read_text() and "cuda" in runs.read_text() and report["data"] == "built-in"


def test_a_run_that_misses_its_goal_is_stopped_and_extrapolated(trainer, judged):
    trainer(30.0)
    report = judged("best")
    assert not report["passed"] and not report["finished"] and "psnr" not in report
    assert 300 <= report["seconds_of_training"] < 600 and 500 <= report["steps"] < 1000
    assert report["seconds_in_all"] == pytest.approx(600.0) and not report["goals"]["seconds of training"]["met"]


def test_the_paper_preset_is_stopped_early(trainer, judged):
    trainer(10.0)
    report = judged("paper")
    assert report["passed"] and not report["finished"] and report["steps"] < 1000
    assert report["seconds_of_training"] >= training.PAPER_SECONDS and report["seconds_in_all"] == pytest.approx(200.0)


def test_a_run_is_resumed_by_the_next_call(trainer, judged):
    runs = trainer(10.0)
    with pytest.raises(Unfinished, match=r"of 1,000 steps after"):
        judged("best", until=(judged.call.work / "best" / "log.jsonl").exists)
    before = judged.saved[-1]["steps"]
    assert 0 < before < 1000
    report = judged("best")
    assert report["passed"] and report["seconds_in_all"] == 200.0, "no step is repeated, no second lost"
    assert [line.endswith("--resume") for line in runs.read_text().splitlines()[1:]] == [False, True]


def test_a_run_of_another_commit_is_not_resumed(trainer, judged):
    runs = trainer(10.0)
    judged("best")
    judged.call.earlier = {}
    assert judged("best")["finished"] and "--resume" not in runs.read_text()


def test_a_run_that_fails(trainer, judged):
    runs = trainer(10.0)
    (runs.parent / "broken").touch()
    with pytest.raises(RuntimeError, match=r"status 1: .*no images"):
        judged("best")


# gsplat

RASTERIZATION = """
import scgs_warp, time
def rasterization(*args, **rest):
    time.sleep({slow})
    image, *more = scgs_warp.rasterization(*args, **rest)
    return image {change}, *more
"""


@pytest.fixture
def peer(tmp_path, monkeypatch):
    """Install a gsplat 1.6.0 that draws as this project does."""
    folder = tmp_path / "site"
    (folder / "gsplat-1.6.0.dist-info").mkdir(parents=True)
    (folder / "gsplat-1.6.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: gsplat\nVersion: 1.6.0\n")
    (folder / "gsplat").mkdir()
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("PYTHONPATH", str(folder), prepend=":")
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "extensions"))
    for name in [name for name in sys.modules if name.partition(".")[0] == "gsplat"]:
        monkeypatch.delitem(sys.modules, name)

    def make(compiled: bool, slow: float = 0.0, change: str = "") -> None:
        text = RASTERIZATION.format(slow=slow, change=change)
        (folder / "gsplat" / "__init__.py").write_text(text)
        if compiled:
            (folder / "gsplat" / "csrc.py").touch()

    return make


@pytest.fixture
def portable(monkeypatch):
    """Let the pretended device composite with the portable form."""
    if device := sys.modules.get("pretended_cuda.warp_device"):
        monkeypatch.setattr(device, "native_bodies", False)


def note(**content) -> None:
    gsplat.note().parent.mkdir(parents=True, exist_ok=True)
    gsplat.note().write_text(json.dumps(content))


def test_gsplat_beside_ours(peer, device, tmp_path, portable):
    """It is measured on a GPU only; here that is pretended."""
    part = Part(device, tmp_path)
    peer(compiled=True)
    if device == "cpu":
        with pytest.raises(NotRun, match="CUDA only"):
            part("gsplat")
        return
    part.call.earlier = {"versions": {"1.5.3": {"rows": 5}}}
    report = part("gsplat")
    assert report["passed"] and report["version"] == "1.6.0" and report["versions"]["1.5.3"] == {"rows": 5}
    assert len(report["goals"]) == 4 and all(goal["least"] == 1.5 for goal in report["goals"].values())
    row = report["versions"]["1.6.0"]["rows"]["small"]
    assert row["images"]["passed"] and row["ratio"].keys() == {"forward", "both"}


def test_a_gsplat_that_draws_something_else_is_a_failure(peer, device, tmp_path, portable):
    if device == "cpu":
        pytest.skip("gsplat composites on CUDA only")
    peer(compiled=True, change="* 1.01")
    assert not Part(device, tmp_path)("gsplat")["passed"]


def test_no_gsplat(tmp_path, monkeypatch):
    monkeypatch.setattr(gsplat, "version", lambda: None)
    with pytest.raises(NotRun, match="not installed: pip install"):
        Part("cuda", tmp_path)("gsplat")
    assert gsplat.building() is None and "not installed" in gsplat.start_build()


def test_a_gsplat_that_is_not_compiled(peer, tmp_path):
    peer(compiled=False)
    part = Part("cuda", tmp_path)
    with pytest.raises(NotRun, match="--build-gsplat"):
        part("gsplat")
    note(state="failed", error="no nvcc", began=0.0)
    with pytest.raises(NotRun, match="cannot be compiled: no nvcc"):
        part("gsplat")
    note(state="building", began=0.0)
    with pytest.raises(NotRun, match="its process has died"):
        part("gsplat")
    assert gsplat.building() is None
    peer(compiled=True)
    assert "already" in gsplat.start_build()


def test_gsplat_is_compiled_in_the_background(peer, device, tmp_path):
    """Without a GPU this fails, which is noted."""
    peer(compiled=False)
    assert "in the background" in gsplat.start_build()
    reason = gsplat.building()
    assert reason is not None and "is being compiled, for 0:0" in reason
    with pytest.raises(NotRun, match="is being compiled"):
        Part("cuda", tmp_path)("gsplat")
    assert "already" in gsplat.start_build(), "never twice"
    deadline = time.time() + 120
    while gsplat.building():
        assert time.time() < deadline
        time.sleep(0.1)
    build = json.loads(gsplat.note().read_text())
    assert build["state"] == ("built" if device == "cuda" else "failed"), gsplat.note().with_suffix(".log").read_text()
    assert build["seconds"] >= 0
