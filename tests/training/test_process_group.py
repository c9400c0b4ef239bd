"""Several processes train one scene: the bits of one process, and what happens when one of them does not go on."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from helpers.parallel_job import DATA, LONG, PLAIN, TWICE
from helpers.paths import ROOT
from helpers.tiny import tiny_config, tiny_dataset, write_dnerf
from scgs_warp.apps.train import cli
from scgs_warp.evaluation.evaluate import evaluate
from scgs_warp.scene.scene import Scene
from scgs_warp.storage.checkpoint import read
from scgs_warp.training import second_try_config, stepping
from scgs_warp.training.loop import fit

PATHS = {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}"}


def checkpoint_bytes(folder: Path) -> bytes:
    return (folder / "checkpoint.safetensors").read_bytes()


def start(output: Path, *scenarios: str, processes: int = 2) -> list[subprocess.Popen[str]]:
    """The processes of a job, started as torchrun starts them."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(3)]
        for free in sockets:
            free.bind(("127.0.0.1", 0))
        ports = " ".join(str(free.getsockname()[1]) for free in sockets)
    where = {"WORLD_SIZE": processes, "LOCAL_WORLD_SIZE": processes, "MASTER_ADDR": "localhost", "PORTS": ports}
    return [
        subprocess.Popen(
            [sys.executable, str(ROOT / "tests/helpers/parallel_job.py"), str(output), *scenarios],
            env={**os.environ, **PATHS, **{k: str(v) for k, v in where.items()}, "RANK": f"{r}", "LOCAL_RANK": f"{r}"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for r in range(processes)
    ]


def stop_at(step: int, monkeypatch: pytest.MonkeyPatch) -> None:
    original = stepping.training_step

    def stopping(state, frames):
        if state.step == step:
            os.kill(os.getpid(), signal.SIGTERM)
        return original(state, frames)

    monkeypatch.setattr(stepping, "training_step", stopping)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What one process makes of the same batches; ``resumed``: the plain run, stopped after some steps."""
    folder = tmp_path_factory.mktemp("alone")
    for name in ("plain", "rich", "planes"):
        config, data = DATA[name]
        fit(config, data(), output=folder / name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(second_try_config, "LEAST_VISITS", 1)
        fit(TWICE, tiny_dataset(6), output=folder / "twice")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        stop_at(25, patch)
        fit(PLAIN, tiny_dataset(6), output=folder / "resumed")
    return folder


@pytest.fixture(scope="module")
def together(alone: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, str]:
    """The same in two processes, and mishaps; the last one kills the second process. Returns also the first one's exit
    status and standard error."""
    folder = tmp_path_factory.mktemp("together")
    shutil.copytree(alone / "resumed", folder / "resumed")
    names = ["plain", "rich", "planes", "twice", "resumed", "uneven", "nudged", "stopped", "hung", "killed"]
    processes = start(folder, *names)
    said = [process.communicate(timeout=300) for process in processes]
    assert processes[1].returncode == -signal.SIGKILL, said
    return folder, processes[0].returncode, said[0][1]


@pytest.mark.parametrize("name", ["plain", "rich", "planes", "twice", "resumed"])
def test_the_bits_are_those_of_one_process(name, alone, together):
    """Among them frames that cannot be learnt from, frames of another size, and a checkpoint of one process."""
    folder = together[0]
    expected = alone / ("plain" if name == "resumed" else name)
    assert checkpoint_bytes(folder / name) == checkpoint_bytes(expected)
    logs = [(run / "log.jsonl").read_text().splitlines() for run in (folder / name, expected)]
    kept = [[{k: v for k, v in json.loads(line).items() if k != "seconds"} for line in log] for log in logs]
    assert kept[0] == kept[1]
    assert any("note" in line and "motion is kept" in line["note"] for line in kept[0]) == (name == "twice")
    assert name != "rich" or 10 < len([line for line in kept[0] if "dropped" in line]) < 40


def test_more_views_change_the_result(alone, tmp_path):
    fit(tiny_config(40, batch=1), tiny_dataset(6), output=tmp_path / "one")
    one, two = read(tmp_path / "one")[0], read(alone / "plain")[0]
    assert not torch.equal(one["gaussians.means"], two["gaussians.means"])


def test_a_batch_that_cannot_be_shared_is_refused(together):
    for rank in range(2):
        said = json.loads((together[0] / f"{rank}.json").read_text())["uneven"]
        assert said.startswith("batch is 3, which 2 processes cannot share evenly; give --batch a multiple of 2")


def test_replicas_that_differ_stop_the_job(together):
    for rank in range(2):
        said = json.loads((together[0] / f"{rank}.json").read_text())["nudged"]
        assert said.startswith("step 10: the processes no longer hold the same scene")


def test_one_is_asked_to_stop_and_all_do(together, alone):
    folder = together[0]
    for rank in range(2):
        assert json.loads((folder / f"{rank}.json").read_text())["stopped"] == "interrupted"
    assert read(folder / "stopped")[1]["step"] == 21
    fit(PLAIN, tiny_dataset(6), output=folder / "stopped", resume=True)
    assert checkpoint_bytes(folder / "stopped") == checkpoint_bytes(alone / "plain")


def test_one_is_killed_and_one_process_goes_on(together, alone):
    """Nothing is lost: the first process saves the last whole step."""
    folder, status, error = together
    assert status == 2 and error.count("\n") == 1, error
    assert "another process of this job has ended" in error and "step 23 is saved" in error
    assert "--resume" in error
    assert read(folder / "killed")[1]["step"] == 23
    fit(PLAIN, tiny_dataset(6), output=folder / "killed", resume=True)
    assert checkpoint_bytes(folder / "killed") == checkpoint_bytes(alone / "plain")


def test_one_hangs_and_the_other_does_not_wait_for_ever(together, alone):
    folder = together[0]
    waited, slept = (json.loads((folder / f"{rank}.json").read_text())["hung"] for rank in (1, 0))
    assert "was silent for 6 seconds" in waited and "reached step 7" in waited
    assert "step 7 is saved" in slept
    fit(PLAIN, tiny_dataset(6), output=folder / "hung", resume=True)
    assert checkpoint_bytes(folder / "hung") == checkpoint_bytes(alone / "plain")


TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
SMALL = ["--steps", "24", "--nodes", "8", "--set", "init_points=200", "--set", "motion.width=32", "--threads", "1"]


def test_torchrun_trains(tmp_path):
    """As the user does it: one view for each process and step, one voice, one run folder."""
    data = write_dnerf(tmp_path / "data", 32)
    command = [*TORCHRUN, "apps/train.py", "--data", str(data), "--output", str(tmp_path / "run"), "--device", "cpu"]
    environ = {**os.environ, **PATHS}
    done = subprocess.run(
        [*command, *SMALL], env=environ, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.count("metrics.json, contact_sheet.png") == 1 and "2 processes: this one waited" in done.stdout
    assert json.loads((tmp_path / "run/config.json").read_text())["batch"] == 2
    assert json.loads((tmp_path / "run/metrics.json").read_text())["step"] == 24


def processes_below(pid: int) -> list[int]:
    """Children of a process."""
    found = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(word) for word in found.read_text().split()]


@pytest.mark.slow
def test_torchrun_and_a_killed_worker(tmp_path):
    """The job ends with a clear line; one process continues it to the bits of an undisturbed run."""
    data = write_dnerf(tmp_path / "data", 32)
    options = ["--data", str(data), "--device", "cpu", *SMALL, "--steps", "400", "--batch", "2"]
    command = [*TORCHRUN, "apps/train.py", *options, "--output", str(tmp_path / "cut")]
    running = subprocess.Popen(command, env={**os.environ, **PATHS}, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    log = tmp_path / "cut/log.jsonl"
    while not (log.is_file() and log.stat().st_size):
        assert running.poll() is None
        time.sleep(0.05)
    os.kill(processes_below(running.pid)[1], signal.SIGKILL)
    _, said = running.communicate(timeout=60)
    assert running.returncode != 0
    lines = [line for line in said.splitlines() if line.startswith("error")]
    assert len(lines) == 1 and "another process of this job has ended" in lines[0] and "is saved" in lines[0], said
    assert 50 <= read(tmp_path / "cut")[1]["step"] < 400
    assert cli([*options, "--output", str(tmp_path / "cut"), "--resume"]) == 0
    assert cli([*options, "--output", str(tmp_path / "whole")]) == 0
    assert checkpoint_bytes(tmp_path / "cut") == checkpoint_bytes(tmp_path / "whole")


@pytest.mark.slow
def test_two_processes_hold_one_scene_and_train_as_one_does(tmp_path):
    for process in start(tmp_path, "long"):
        _, error = process.communicate(timeout=600)
        assert process.returncode == 0, error
    replicas = [(tmp_path / f"{rank}.long").read_bytes() for rank in range(2)]
    assert replicas[0] == replicas[1]
    scene = fit(LONG, tiny_dataset(), output=tmp_path / "alone")
    assert checkpoint_bytes(tmp_path / "alone") == checkpoint_bytes(tmp_path / "long")
    scores = [evaluate(made, tiny_dataset(4, split="test"))["psnr"] for made in (scene, Scene.load(tmp_path / "long"))]
    assert abs(scores[0] - scores[1]) < 0.1 and scores[0] > 20.0, scores
