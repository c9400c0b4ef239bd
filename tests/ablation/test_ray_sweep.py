"""What becomes of lost, failed and interrupted cells, on a cluster that is faked."""

from __future__ import annotations

import json
import os
import socket
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from helpers.tiny import write_dnerf
from scgs_warp.ablation import cells as ablate
from scgs_warp.ablation import ray_cluster, ray_runner
from scgs_warp.config import presets
from scgs_warp.errors import UserError


@pytest.fixture(scope="module")
def blobs(tmp_path_factory) -> Path:
    return write_dnerf(tmp_path_factory.mktemp("data") / "blobs", 32)


def plan(blobs: Path, output: Path, *values: str, steps: int = 30) -> list[ablate.Cell]:
    small = {"init_points": 300, "motion": {"layers": 3, "width": 32, "skip": 2}}
    base = presets.from_dict(small, "test", presets.with_steps(presets.preset("cpu"), steps))
    return ablate.plan("nodes", base, {"blobs": blobs}, output, values=values)


class TaskError(Exception):
    """As Ray's RayTaskError."""


class LostError(Exception):
    """As Ray's RayError."""


class WorkerCrashedError(LostError):
    """By its name."""


class FakeRay:
    """Runs a task when its result is asked for; ``plays`` says what becomes of each attempt of a cell's value."""

    exceptions = SimpleNamespace(RayTaskError=TaskError, RayError=LostError)

    def __init__(self, **plays: list) -> None:
        self.plays = plays
        self.began: list[tuple[str, int]] = []
        self.cancelled: list[int] = []
        self.orders: list[dict] = []

    def remote(self, **options):
        self.options = options

        def submit(order: dict) -> int:
            self.orders.append(json.loads(json.dumps(order)))
            return len(self.orders) - 1

        return lambda function: SimpleNamespace(remote=submit)

    def wait(self, refs: list[int], num_returns: int, timeout: float):
        return refs[:num_returns], refs[num_returns:]

    def cancel(self, ref: int, force: bool) -> None:
        assert not force
        self.cancelled.append(ref)

    def get(self, ref: int):
        order = self.orders[ref]
        cell = ablate.cell_from_json(order["cell"])
        self.began.append((cell.value, order["attempt"]))
        what = self.plays.get(f"cell{cell.value}", ["trained"])[order["attempt"] - 1]
        folder = Path(cell.folder)
        folder.mkdir(parents=True, exist_ok=True)
        if what == "trained":
            (folder / "metrics.json").write_text(json.dumps({"psnr": 30.0}))
            return {"failure": None, "stopped": False}
        if what == "lost after a checkpoint":
            (folder / "checkpoint.safetensors").write_bytes(b"x")
            os.utime(folder / "checkpoint.safetensors", ns=(ref + 1, ref + 1))
            raise WorkerCrashedError("died")
        if what == "lost":
            raise WorkerCrashedError("died")
        if what == "broken":
            raise TaskError("Traceback:\nModuleNotFoundError: no module\n")
        if what == "interrupt":
            raise KeyboardInterrupt
        return {"failure": what, "stopped": False} if what != "stopped" else {"failure": None, "stopped": True}


def sweep(ray: FakeRay, cells: list[ablate.Cell]) -> tuple[list[str], dict[str, str | None]]:
    """Lines that are shown, and how each cell ended."""
    lines: list[str] = []
    ends: dict[str, str | None] = {}
    running = ray_runner.Sweep(
        ray, {}, 2, False, lines.append, lambda place, cell, failure: ends.update({cell.value: failure})
    )
    running.run([(cell.name, cell) for cell in cells])
    return lines, ends


@pytest.mark.parametrize("how", ["lost", "stopped"])
def test_a_lost_cell_is_begun_again(how, blobs, tmp_path, capsys):
    ray = FakeRay(cell16=[how, "trained"])
    lines, ends = sweep(ray, plan(blobs, tmp_path, "8", "16", "32"))
    assert ends == {"8": None, "16": None, "32": None}
    assert sorted(ray.began) == [("16", 1), ("16", 2), ("32", 1), ("8", 1)]
    waits = {(ablate.cell_from_json(o["cell"]).value, o["attempt"]): o["wait"] for o in ray.orders}
    assert waits[("16", 1)] == 0 < waits[("16", 2)], "only a lost one's lock is waited for"
    assert len(lines) == 1 and "blobs/16: its worker was " in lines[0] and "elsewhere" in lines[0]
    assert ray.options == {"num_cpus": 2, "num_gpus": 0, "max_calls": 1, "max_retries": 0}
    assert "steps of all cells 90/90 (100 %)" in capsys.readouterr().out


def test_a_gpu_for_each_cell(blobs, tmp_path):
    ray = FakeRay()
    ray_runner.Sweep(ray, {}, 4, True, print, lambda *end: None).run([("1", plan(blobs, tmp_path, "8")[0])])
    assert ray.options["num_gpus"] == 1 and ray.options["num_cpus"] == 4


def test_a_cell_that_kills_its_workers_fails(blobs, tmp_path):
    ray = FakeRay(cell8=["lost"] * 10)
    _, ends = sweep(ray, plan(blobs, tmp_path, "8", "16"))
    assert ends["8"] is not None and "its worker was killed, 3 times without a step forward" in ends["8"]
    assert ends["16"] is None and len(ray.orders) == 4


def test_a_cell_that_comes_further_may_be_lost_often(blobs, tmp_path):
    ray = FakeRay(cell8=["lost after a checkpoint"] * 7 + ["lost", "trained"])
    _, ends = sweep(ray, plan(blobs, tmp_path, "8"))
    assert ends == {"8": None}


def test_failures_stop_no_other(blobs, tmp_path):
    ray = FakeRay(cell8=["train_002.png: not a picture"], cell16=["broken"])
    _, ends = sweep(ray, plan(blobs, tmp_path, "8", "16", "32"))
    assert ends == {"8": "train_002.png: not a picture", "16": "ModuleNotFoundError: no module", "32": None}


def test_results_that_are_not_seen_are_a_failure(blobs, tmp_path, monkeypatch):
    monkeypatch.setattr(ray_runner, "VISIBLE_SECONDS", 0.0)
    monkeypatch.setattr(FakeRay, "get", lambda self, ref: {"failure": None, "stopped": False})
    _, ends = sweep(FakeRay(), plan(blobs, tmp_path, "8"))
    assert ends["8"] is not None and "is the folder shared?" in ends["8"]


def test_a_lost_cluster_ends_the_sweep(blobs, tmp_path, monkeypatch):
    monkeypatch.setattr(ray_cluster, "PULSE_SECONDS", 0.0)
    monkeypatch.setattr(ray_cluster, "GONE_SECONDS", 0.3)
    monkeypatch.setattr(FakeRay, "wait", lambda self, refs, num_returns, timeout: ([], refs))
    with socket.create_server(("127.0.0.1", 0)) as gcs:
        place = f"127.0.0.1:{gcs.getsockname()[1]}"
        ray = FakeRay()
        ray.get_runtime_context = lambda: SimpleNamespace(gcs_address=place)
        head = ray_cluster.HeadMonitor(ray, "auto")
        until = time.monotonic() + 0.6
        while time.monotonic() < until:
            head.check()  # it answers
            gcs.accept()[0].close()
    running = ray_runner.Sweep(ray, {}, 1, False, print, lambda *end: None, head.check)
    with pytest.raises(UserError, match="head of the cluster is gone"):
        running.run([(cell.name, cell) for cell in plan(blobs, tmp_path, "8", "16")])
    assert ray.cancelled == [0, 1]


def test_an_interrupt_cancels_what_is_left(blobs, tmp_path):
    ray = FakeRay(cell8=["interrupt"])
    with pytest.raises(KeyboardInterrupt):
        sweep(ray, plan(blobs, tmp_path, "8", "16", "32"))
    assert ray.cancelled == [1, 2]
