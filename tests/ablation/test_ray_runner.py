"""Sweeps on a real Ray cluster of this machine: workers and machines are killed, the results are a local run's."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from helpers.cells import options
from helpers.paths import ROOT
from helpers.tiny import write_dnerf
from scgs_warp.ablation import ray_cluster
from scgs_warp.apps import ablate as app

pytestmark = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed (extra: cluster)")
OFTEN = ["--set", "checkpoint_seconds=0.05", "--threads", "2"]
STEPS = 60


@pytest.fixture(scope="module", autouse=True)
def environment_of_ray() -> Iterator[None]:
    """Clusters of these tests ask for no token, and listen on loopback alone."""
    before = dict(os.environ)
    os.environ.update({"RAY_AUTH_MODE": "disabled", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"})
    yield
    os.environ.clear()
    os.environ.update(before)


@pytest.fixture(scope="module")
def blobs(tmp_path_factory) -> Path:
    return write_dnerf(tmp_path_factory.mktemp("data") / "blobs", 32)


def worker_of(folder: Path) -> dict:
    """Which process trains the cell; empty while none does."""
    try:
        return json.loads((folder / "worker.json").read_text())
    except (OSError, ValueError):
        return {}


class Watcher(threading.Thread):
    """Waits for a cell in the middle of its training, with a checkpoint younger than a line of its log; acts once."""

    def __init__(self, output: Path, act: Callable[[dict], None]) -> None:
        super().__init__(daemon=True)
        self.output, self.act = output, act
        self.folder: Path | None = None
        self.log: list[str] = []
        """Lines that the checkpoint covers."""
        self.give_up = threading.Event()
        self.start()

    def run(self) -> None:
        while not self.give_up.wait(0.02):
            for log in self.output.glob("blobs/*/log.jsonl"):
                folder = log.parent
                if (folder / "metrics.json").exists() or not self._covered(folder, log):
                    continue
                self.folder = folder
                self.act(worker_of(folder))
                return

    def _covered(self, folder: Path, log: Path) -> bool:
        self.log = log.read_text().splitlines()
        checkpoint = folder / "checkpoint.safetensors"
        return bool(self.log) and checkpoint.exists() and checkpoint.stat().st_mtime > log.stat().st_mtime

    def result(self) -> Path:
        """The folder of the cell that was acted upon."""
        self.give_up.set()
        self.join(10)
        assert self.folder is not None, "no cell was found in the middle of its training"
        return self.folder


def without_times(text: str) -> str:
    """A table but for its last column, the seconds; JSON but for seconds and provenance."""
    text = re.sub(r'"(?:date|commit)": "[^"]*"', "", text)
    text = re.sub(r'"seconds": (?:\{[^}]*\}|[\d.]+)', "", text)
    return "\n".join(line.rpartition("|")[0].rpartition("|")[0] if "|" in line else line for line in text.splitlines())


def same_results(one: Path, other: Path) -> None:
    """Tables but for the times, and checkpoints to the bit."""
    for name in ("nodes.md", "nodes.json"):
        assert without_times((one / name).read_text()) == without_times((other / name).read_text())
    cells = sorted(path.relative_to(one) for path in one.glob("blobs/*/checkpoint.safetensors"))
    assert cells == sorted(path.relative_to(other) for path in other.glob("blobs/*/checkpoint.safetensors"))
    for cell in cells:
        assert (one / cell).read_bytes() == (other / cell).read_bytes(), cell


def went_on(watcher: Watcher, victim: dict) -> None:
    """The cell whose worker was killed was continued by another, not begun again."""
    folder = watcher.result()
    now = worker_of(folder)
    assert now["attempt"] == victim["attempt"] + 1 and now["pid"] != victim["pid"]
    assert (folder / "log.jsonl").read_text().splitlines()[: len(watcher.log)] == watcher.log


def test_six_cells_outlive_a_worker(blobs, tmp_path, capsys):
    """Two workers, one killed in the middle of a cell: all six are trained, to the same bits as without a cluster."""
    rows = ["--values", "8,16,32", "--seeds", "0,1", *OFTEN]
    local, output = tmp_path / "local", tmp_path / "ray"
    assert app.cli(["nodes", *options(blobs, local, *rows, steps=STEPS)]) == 0
    capsys.readouterr()
    victim: dict = {}

    def kill(worker: dict) -> None:
        victim.update(worker)
        os.kill(worker["pid"], signal.SIGKILL)

    watcher = Watcher(output, kill)
    assert app.cli(["nodes", *options(blobs, output, *rows, "--ray", "local", "--jobs", "2", steps=STEPS)]) == 0
    went_on(watcher, victim)
    same_results(local, output)
    shown = capsys.readouterr()
    assert "Ray cluster of 1 machine: 2 cells at a time, each with 1 thread" in shown.out
    assert shown.out.count("its worker was killed; it goes on elsewhere") == 1
    assert f"steps of all cells {6 * STEPS}/{6 * STEPS}" in shown.out and "cells 6/6" in shown.out
    assert "raylet" not in shown.out + shown.err, "Ray's own chatter stays out"
    workers = {worker_of(path.parent)["pid"] for path in output.glob("blobs/*/worker.json")}
    assert len(workers) == 6, "a process for each cell"


@pytest.fixture(scope="module")
def cluster(environment_of_ray) -> Iterator:
    """A head without processors and two machines with one each, as Ray plays them on one."""
    from ray.cluster_utils import Cluster

    ray_cluster.prepare()
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    yield made
    made.shutdown()


@pytest.mark.slow
def test_cells_outlive_a_machine(blobs, tmp_path, cluster, capsys):
    """A whole machine goes; what it did is done by the other one. A cell that cannot be trained stops no other."""
    rows = ["--values", "8,16,32", *OFTEN]
    local, output = tmp_path / "local", tmp_path / "ray"
    assert app.cli(["nodes", *options(blobs, local, *rows, steps=STEPS)]) == 0
    machines = [cluster.add_node(num_cpus=1) for _ in range(2)]
    victim: dict = {}

    def kill(worker: dict) -> None:
        victim.update(worker)
        parent = int(Path(f"/proc/{worker['pid']}/stat").read_text().rpartition(")")[2].split()[1])
        for machine in machines:
            if any(process.process.pid == parent for process in machine.all_processes["raylet"]):
                cluster.remove_node(machine, allow_graceful=False)

    watcher = Watcher(output, kill)
    arguments = ["nodes", *options(blobs, output, *rows, "--ray", cluster.address, steps=STEPS)]
    assert app.cli(arguments) == 0
    went_on(watcher, victim)
    same_results(local, output)
    out = capsys.readouterr().out
    assert "Ray cluster of 2 machines: 2 cells at a time" in out and "it goes on elsewhere" in out


@pytest.mark.slow
def test_stopped_and_resumed(blobs, tmp_path):
    """Ctrl-C: cells save and end, the status is 130; the same command goes on from there without a cluster."""
    output = tmp_path / "out"
    arguments = ["nodes", *options(blobs, output, "--values", "8,16,32", "--threads", "2", steps=1_000)]
    command = [sys.executable, str(ROOT / "apps/ablate.py"), *arguments, "--ray", "local", "--jobs", "2"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    logs = [output / "blobs" / value / "log.jsonl" for value in ("8", "16")]
    while not all(log.is_file() and log.stat().st_size > 300 for log in logs):
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=180)
    assert process.returncode == 130, errors
    assert errors.strip().splitlines()[-1] == "interrupted" and "Traceback" not in errors
    assert "stopping: cells that run save their checkpoints" in out
    before = {log: log.read_text().splitlines() for log in logs}
    for log in logs:
        assert (log.parent / "checkpoint.safetensors").is_file() and not (log.parent / "metrics.json").is_file()
    assert not (output / "blobs/32/checkpoint.safetensors").exists(), "what waited was not begun"
    assert app.cli(["nodes", *options(blobs, output, "--values", "8", "--threads", "2", steps=1_000)]) == 0
    assert logs[0].read_text().splitlines()[: len(before[logs[0]])] == before[logs[0]], "continued, not begun again"


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_something_else_listens(scheme, blobs, tmp_path, capsys, monkeypatch):
    """Ray itself would wait for minutes."""
    monkeypatch.setattr(ray_cluster, "ANSWER_SECONDS", 8.0)
    with socket.create_server(("127.0.0.1", 0)) as server:  # takes connections, and says nothing
        address = f"{scheme}127.0.0.1:{server.getsockname()[1]}"
        began = time.monotonic()
        assert app.cli(["nodes", *options(blobs, tmp_path / "out", "--values", "8", "--ray", address)]) == 2
        assert time.monotonic() - began < 60
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and f"--ray {address}: no Ray cluster answered within 8 s" in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_lost_head_ends_the_sweep(blobs, tmp_path, cluster):
    """One line and status 2, before Ray ends the process without either; the cell that ran has saved."""
    cluster.add_node(num_cpus=1)
    output = tmp_path / "out"
    arguments = ["nodes", *options(blobs, output, "--values", "8,16", "--threads", "1", steps=5_000)]
    command = [sys.executable, str(ROOT / "apps/ablate.py"), *arguments, "--ray", cluster.address]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    log = output / "blobs/8/log.jsonl"
    while not (log.is_file() and log.stat().st_size > 300):
        assert process.poll() is None
        time.sleep(0.05)
    cluster.head_node.kill_gcs_server()
    _, errors = process.communicate(timeout=120)
    lines = errors.strip().splitlines()
    assert process.returncode == 2 and len(lines) == 1, errors
    assert "the head of the cluster is gone" in lines[0]
    assert (output / "blobs/8/checkpoint.safetensors").is_file()
