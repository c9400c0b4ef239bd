"""How much memory may be taken, who asks, and what is said when there is too little."""

from __future__ import annotations

import itertools
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from helpers.fake_scene import FakeScene, install
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.apps import cli, view
from scgs_warp.data import ImageCache, cache
from scgs_warp.errors import UserError
from scgs_warp.gaussians import gaussians_from_points
from scgs_warp.runtime import memory
from scgs_warp.runtime.memory import GIB, NotEnoughMemory
from scgs_warp.scene.scene import Scene
from scgs_warp.training import density_control
from scgs_warp.training import view as training_view
from scgs_warp.training.loop import fit
from scgs_warp.visualization import video

linux = pytest.mark.skipif(memory.status("VmRSS") is None, reason="the system does not say what is resident")


@pytest.fixture(autouse=True)
def unlimited(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv(memory.LIMIT_VARIABLE, raising=False)
    memory.set_limit(None)
    yield
    memory.set_limit(None)


def allow(monkeypatch: pytest.MonkeyPatch, free: float) -> None:
    """As if this many bytes were free."""
    monkeypatch.setattr(memory, "free_on_host", lambda: iter([free / memory.USABLE_SHARE]))
    memory.forget_readings()


def test_the_variable_or_the_caller_sets_the_limit(monkeypatch: pytest.MonkeyPatch):
    assert memory.limit() is None
    memory.set_limit(1.5)
    assert memory.limit() == 3 * GIB // 2
    for wrong in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(UserError, match="greater than 0"):
            memory.set_limit(wrong)
    monkeypatch.setenv(memory.LIMIT_VARIABLE, "2")
    memory.set_limit_from_environment()
    assert memory.limit() == 2 * GIB
    monkeypatch.setenv(memory.LIMIT_VARIABLE, "much")
    with pytest.raises(UserError, match="SCGS_MEMORY_GIB=much"):
        memory.set_limit_from_environment()


def test_the_app_option_sets_it_for_processes_of_its_own_too(monkeypatch: pytest.MonkeyPatch, all_threads: None):
    import os

    monkeypatch.setenv(memory.LIMIT_VARIABLE, "7")
    cli.prepare("cpu", None, 2.5)
    assert memory.limit() == 5 * GIB // 2 and os.environ[memory.LIMIT_VARIABLE] == "2.5"
    for wrong in (0.0, math.nan, -3.0):
        with pytest.raises(UserError, match="--memory-gib"):
            cli.prepare("cpu", None, wrong)


@linux
def test_what_is_resident_counts_against_the_limit():
    used = memory.status("VmRSS")
    assert used is not None
    memory.set_limit(used / GIB + 1.0)
    assert 0.5 * GIB < memory.room() < memory.USABLE_SHARE * 1.3 * GIB
    block = torch.ones(GIB // 16)
    assert memory.room() < 0.9 * memory.USABLE_SHARE * GIB
    del block
    assert memory.room() > 0.5 * GIB, "what was freed may be taken again"
    memory.set_limit(1e-3)
    assert memory.room() == 0 and not memory.fits(1)


@linux
def test_the_process_own_limits_count():
    code = (
        "import resource, scgs_warp.runtime.memory as m; used = m.status('VmSize');"
        "resource.setrlimit(resource.RLIMIT_AS, (used + 2**29, used + 2**29)); print(m.room())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert 2**28 < int(done.stdout) < 2**29


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/a/b", {"a/b": ("500", "200", "inactive_file 50"), "a": ("max", "300", "")}, [350]),
        ("0::/a/b", {"a/b": ("max", "200", ""), "a": ("400", "300", "anon 3\ninactive_file 10")}, [110]),
        ("0::/gone", {"": ("900", "100", "inactive_file 7")}, [807]),
        ("0::/", {}, []),
        ("4:cpu,memory:/x\n0::/", {"memory/x": ("70", "30", "total_inactive_file 5")}, [45]),
        ("4:cpu:/x", {"memory/x": ("70", "30", "")}, []),
        ("nonsense", {}, []),
    ],
)
def test_what_control_groups_leave(tmp_path: Path, own: str, files: dict, expected: list[int]):
    for folder, texts in files.items():
        names = ("memory.max", "memory.current", "memory.stat")
        if folder.startswith("memory"):
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "memory.stat")
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        for name, text in zip(names, texts, strict=True):
            (tmp_path / folder / name).write_text(text)
    (tmp_path / "own").write_text(own)
    assert list(memory.free_in_groups(str(tmp_path), str(tmp_path / "own"))) == expected
    assert list(memory.free_in_groups(str(tmp_path), str(tmp_path / "none"))) == []


def test_a_small_need_costs_no_reading(monkeypatch: pytest.MonkeyPatch):
    readings = []

    def free():
        readings.append(1)
        yield 1000 / memory.USABLE_SHARE

    monkeypatch.setattr(memory, "free_on_host", free)
    memory.forget_readings()
    assert memory.fits(200) and memory.fits(200) and memory.fits(249) and len(readings) == 1
    assert memory.fits(300) and len(readings) == 2
    assert not memory.fits(1001) and len(readings) == 4, "once more after freed memory was handed back"
    later = memory.time.monotonic() + 10.0
    monkeypatch.setattr(memory.time, "monotonic", lambda: later)
    assert memory.fits(200) and len(readings) == 5


def test_a_refusal_gives_both_figures_and_the_remedy(monkeypatch: pytest.MonkeyPatch):
    allow(monkeypatch, 3 * GIB)
    memory.require(2 * GIB, "cpu", "a thing", "make it smaller")
    with pytest.raises(NotEnoughMemory) as caught:
        memory.require(5 * GIB, "cpu", "a thing", "make it smaller")
    assert str(caught.value) == (
        "a thing needs 5.00 GiB of memory, 3.00 GiB may be taken; make it smaller, or allow more (--memory-gib)"
    )
    memory.set_limit(4)
    allow(monkeypatch, 3 * 2**20)
    with pytest.raises(NotEnoughMemory, match=r"3\.0 MiB of the 4\.00 GiB allowed may be taken"):
        memory.require(5 * GIB, "cpu", "a thing", "make it smaller")


def test_images_take_half_of_what_is_free_at_most(monkeypatch: pytest.MonkeyPatch):
    allow(monkeypatch, 100 * 2**20)
    assert abs(ImageCache(2048).budget - cache.MEMORY_SHARE * 100 * 2**20) <= 1
    assert ImageCache(3).budget == 3 * 2**20


def test_films_that_do_not_fit_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys):
    install(monkeypatch, FakeScene())
    arguments = ["--run", str(tmp_path), "--output", str(tmp_path / "film.mp4"), "--frames", "2"]
    assert view.cli([*arguments, "--size", "100000"]) == 2
    said = capsys.readouterr().err
    assert "--size 100000: give 16 to 8192 pixels; a frame of 100000 x 100000 would take 596.0 GiB" in said
    allow(monkeypatch, 2**20)
    assert view.cli([*arguments, "--size", "256"]) == 2
    said = capsys.readouterr().err
    assert "film.mp4: a frame of 256 x" in said and "1.0 MiB may be taken; give a smaller --size" in said
    assert len(said.splitlines()) == 1 and list(tmp_path.iterdir()) == []


def test_all_frames_of_a_gif_are_planned(monkeypatch: pytest.MonkeyPatch):
    allow(monkeypatch, 100 * 2**20)
    video.require_memory("a.mp4", 512, 512, 10_000, "cpu")
    video.require_memory("a.gif", 512, 512, 10, "cpu")
    with pytest.raises(NotEnoughMemory, match=r"a GIF of 10000 frames of 512 x 512.*write an \.mp4"):
        video.require_memory("a.gif", 512, 512, 10_000, "cpu")


def test_gaussians_grow_as_far_as_memory_allows(monkeypatch: pytest.MonkeyPatch):
    gaussians = gaussians_from_points(torch.rand(1000, 3), None, sh_degree=3, hyper_columns=0)
    allow(monkeypatch, 10 * GIB)
    assert density_control.affordable_count(gaussians, 10**9) == 10**9  # twice as many fit: more is for later to ask
    allow(monkeypatch, 2**20)
    most = density_control.affordable_count(gaussians, 10**9)
    assert 1000 + 2**20 // 4000 < most < 1000 + 2**20 // 1500
    assert density_control.affordable_count(gaussians, 1100) == 1100
    allow(monkeypatch, 0)
    assert density_control.affordable_count(gaussians, 10**9) == 1000


def test_training_says_that_memory_ends_growth(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys):
    asked = []

    def most(gaussians, wanted: int) -> int:
        asked.append(len(gaussians))
        return len(gaussians)

    monkeypatch.setattr(density_control, "affordable_count", most)
    fit(tiny_config(60, motion={"model": "static"}), tiny_dataset(6, 32), output=tmp_path / "run")
    assert len(asked) > 1 and all(later <= first for first, later in itertools.pairwise(asked))
    said = capsys.readouterr()
    assert (said.err + said.out).count("they grow no further") == 1
    assert (tmp_path / "run/log.jsonl").read_text().count("they grow no further") == 1


def test_training_that_runs_out_of_memory_can_be_resumed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """To the same bits."""
    config, data = tiny_config(30, motion={"model": "static"}), tiny_dataset(6, 32)
    fit(config, data, output=tmp_path / "whole")
    original, steps = training_view.draw, []

    def draw(*args, **options):
        steps.append(1)
        if len(steps) == 20:
            raise NotEnoughMemory("an image of 32 x 32 needs more")
        return original(*args, **options)

    monkeypatch.setattr(training_view, "draw", draw)
    with pytest.raises(NotEnoughMemory):
        fit(config, data, output=tmp_path / "run")
    monkeypatch.setattr(training_view, "draw", original)
    assert Scene.load(tmp_path / "run").step < 30
    fit(config, data, output=tmp_path / "run", resume=True)
    files = [(tmp_path / name / "checkpoint.safetensors").read_bytes() for name in ("whole", "run")]
    assert files[0] == files[1]


def test_a_system_that_says_nothing(monkeypatch):
    """As on macOS and Windows: what is asked for is granted."""
    monkeypatch.setattr(memory, "free_on_host", lambda: iter([math.inf]))
    assert memory.measure("cpu") > 2**50 and memory.fits(2**40)


@pytest.mark.skipif(not Path("/proc/meminfo").is_file(), reason="the system says nothing")
def test_processes_of_a_job_share_the_machine(monkeypatch):
    for name in (memory.SIBLINGS_VARIABLE, "LOCAL_WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(memory, "free_in_groups", lambda: iter([]))
    alone = min(memory.free_on_host())
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "8")
    assert memory.siblings() == 8 and min(memory.free_on_host()) < alone / 6
    monkeypatch.setenv(memory.SIBLINGS_VARIABLE, "nonsense")
    assert memory.siblings() == 8
