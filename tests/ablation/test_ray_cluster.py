"""Sweeps on a cluster, without one: how cells are shared out, what happens when workers are lost, what machines say."""

from __future__ import annotations

import json
import os
import shutil
import socket
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from helpers.cells import options
from helpers.tiny import write_dnerf
from scgs_warp.ablation import cells as ablate
from scgs_warp.ablation import ray_cluster, ray_runner, ray_worker
from scgs_warp.ablation.ray_cluster import Machine
from scgs_warp.apps import ablate as app
from scgs_warp.config import presets
from scgs_warp.errors import UserError


def machine(cpus: float, gpus: float = 0.0) -> Machine:
    return Machine(f"id{cpus}", f"host{cpus}", cpus, gpus)


# How cells are shared out.


@pytest.mark.parametrize(
    ("machines", "jobs", "threads", "cuda", "share", "places"),
    [
        ([machine(8)], 1, None, False, 8, 1),
        ([machine(8)], 4, None, False, 2, 4),
        ([machine(8)], 16, None, False, 1, 8),
        ([machine(8)], 2, 4, False, 2, 4),
        ([machine(4), machine(16)], 1, None, False, 4, 5),
        ([machine(4), machine(16)], 1, 8, False, 4, 5),
        ([machine(2), machine(2)], 2, None, False, 1, 4),
        ([machine(16, 4)], 1, None, True, 4, 4),
        ([machine(16, 4), machine(8, 1)], 1, None, True, 4, 5),
    ],
)
def test_cells_fill_the_machines(machines, jobs, threads, cuda, share, places):
    found = ray_cluster.threads_of_a_cell(machines, jobs, threads, cuda)
    assert (found, ray_cluster.cells_at_a_time(machines, found, cuda)) == (share, places)
    assert all(found <= each.cpus for each in machines), "every machine can take a cell"


def test_machines_without_room_are_left_out():
    head, one, two = machine(0), machine(4), machine(8, 1)
    assert ray_cluster.usable_machines([head, one, two], cuda=False) == [one, two]
    assert ray_cluster.usable_machines([head, one, two], cuda=True) == [two]
    with pytest.raises(UserError, match="none of the cluster's 2 machines has a GPU"):
        ray_cluster.usable_machines([head, one], cuda=True)


# What a worker says.


@pytest.fixture(scope="module")
def blobs(tmp_path_factory) -> Path:
    return write_dnerf(tmp_path_factory.mktemp("data") / "blobs", 32)


def plan(blobs: Path, output: Path, *values: str, steps: int = 30) -> list[ablate.Cell]:
    small = {"init_points": 300, "motion": {"layers": 3, "width": 32, "skip": 2}}
    base = presets.from_dict(small, "test", presets.with_steps(presets.preset("cpu"), steps))
    return ablate.plan("nodes", base, {"blobs": blobs}, output, values=values)


def asked(question: dict) -> dict:
    """As a machine of a cluster is: with plain data. Another open file is as good as another process to a lock."""
    return ray_worker.inspect_machine(json.loads(json.dumps(question)))


def test_a_machine_that_sees_all_has_no_problem(blobs, tmp_path):
    with ray_runner.token_file(tmp_path / "out") as (file, token):
        question = {"token_file": str(file), "token": token, "weights": None}
        question["data"] = {str(blobs): ray_worker.fingerprint(blobs)}
        answer = asked(question)
        assert answer["problem"] is None and answer["host"] and answer["processor"]
        assert ray_worker.identity_difference(answer["identity"], ray_worker.identity()) is None
    assert not (tmp_path / "out").exists(), "looking leaves nothing behind"


@pytest.mark.parametrize("wrong", ["folder", "locks", "data", "no data", "weights"])
def test_a_machine_says_what_is_wrong(wrong, blobs, tmp_path):
    other = Path(shutil.copytree(blobs, tmp_path / "other"))
    (other / "transforms_test.json").write_text("{}")
    with ray_runner.token_file(tmp_path / "out") as (file, token):
        question = {"token_file": str(file), "token": token, "weights": None}
        question["data"] = {str(blobs): ray_worker.fingerprint(blobs)}
        if wrong == "folder":
            question["token"] = "another"
        elif wrong == "locks":  # the file with the same text, but nobody's lock: as a file system without locks has it
            question["token_file"] = str(shutil.copy(file, tmp_path / "unlocked"))
        elif wrong == "data":
            question["data"] = {str(other): ray_worker.fingerprint(blobs)}
        elif wrong == "no data":
            question["data"] = {str(tmp_path / "nowhere"): "0"}
        else:
            question["weights"] = str(tmp_path / "nowhere.pth")
        problem = asked(question)["problem"]
    said = {
        "folder": "one folder for all",
        "locks": "two could train one cell",
        "data": "another --data",
        "no data": "cannot read --data",
        "weights": "--lpips-weights",
    }
    assert problem is not None and said[wrong] in problem and "\n" not in problem


def test_the_code_is_the_same_wherever_it_is_installed(tmp_path, monkeypatch):
    """A clone has the kernels beside the package, an installed wheel in it; another line is another code."""

    def package(name: str, kernels: str, line: str = "x = 1\n") -> tuple[Path, Path]:
        root = tmp_path / name / "scgs_warp"
        beside = tmp_path / name / kernels
        for folder in (root, beside, root / "apps"):
            folder.mkdir(parents=True, exist_ok=True)
        (root / "train.py").write_bytes(line.encode())
        (beside / "skinning.py").write_text("y = 2\n")
        (root / "apps" / "ablate.py").write_text(name)
        return root, beside

    def hash_of(places: tuple[Path, Path]) -> str:
        found = dict(zip(("scgs_warp", "scgs_warp.kernels"), places))
        specs = {name: SimpleNamespace(submodule_search_locations=[str(path)]) for name, path in found.items()}
        monkeypatch.setattr(ray_worker.importlib.util, "find_spec", specs.get)
        return ray_worker.source_hash()

    clone = hash_of(package("clone", "kernels"))
    assert clone == hash_of(package("wheel", "scgs_warp/kernels"))
    assert clone == hash_of(package("windows", "kernels", "x = 1\r\n"))
    assert clone != hash_of(package("changed", "kernels", "x = 2\n"))
    monkeypatch.undo()
    assert len(ray_worker.source_hash()) == 64


def order(cell: ablate.Cell, **more) -> dict:
    usual = {"cell": ablate.cell_to_json(cell), "threads": 1, "identity": ray_worker.identity()}
    return {**usual, "sweep": "s", "attempt": 1, "wait": 0.0, "memory": None, "siblings": 1, **more}


def test_a_worker_trains_a_cell(blobs, tmp_path, all_threads):
    cell = plan(blobs, tmp_path, "8")[0]
    assert ray_worker.train_cell(json.loads(json.dumps(order(cell)))) == {"failure": None, "stopped": False}
    folder = Path(cell.folder)
    assert json.loads((folder / "metrics.json").read_text())["step"] == 30
    assert json.loads((folder / "worker.json").read_text())["pid"] == os.getpid()
    assert "training 30/30" in (folder / "train.log").read_text()
    assert ray_runner.steps_done(folder) == 30


def test_a_worker_says_why_it_failed(blobs, tmp_path, all_threads):
    broken = Path(shutil.copytree(blobs, tmp_path / "broken"))
    (broken / "train/train_002.png").write_bytes(b"not a picture")
    answer = ray_worker.train_cell(order(plan(broken, tmp_path, "8")[0]))
    assert "train_002.png" in answer["failure"] and not answer["stopped"]


def test_another_version_trains_nothing(blobs, tmp_path, all_threads):
    cell = plan(blobs, tmp_path, "8")[0]
    answer = ray_worker.train_cell(order(cell, identity={**ray_worker.identity(), "torch": "1.0"}))
    assert "has torch " in answer["failure"] and "not 1.0" in answer["failure"]
    assert not Path(cell.folder).exists()


def test_a_stopped_worker_is_no_failure(blobs, tmp_path, monkeypatch, all_threads):
    def stopped(cell):
        raise KeyboardInterrupt

    monkeypatch.setattr(ray_worker, "attempt", stopped)
    assert ray_worker.train_cell(order(plan(blobs, tmp_path, "8")[0])) == {"failure": None, "stopped": True}


@pytest.mark.skipif(os.name != "posix", reason="Windows has no such locks")
def test_a_lost_workers_lock_is_waited_for(blobs, tmp_path, monkeypatch, all_threads):
    """The one that lost it may not be gone yet; the first attempt of a sweep is refused at once, as anywhere."""
    import fcntl

    cell = plan(blobs, tmp_path, "8")[0]
    folder = Path(cell.folder)
    folder.mkdir(parents=True)
    with open(folder / ".lock", "w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert "another trainer" in ray_worker.train_cell(order(cell))["failure"]
        clock = SimpleNamespace(monotonic=time.monotonic, sleep=lambda seconds: fcntl.flock(held, fcntl.LOCK_UN))
        monkeypatch.setattr(ray_worker, "time", clock)
        assert ray_worker.train_cell(order(cell, attempt=2, wait=30.0)) == {"failure": None, "stopped": False}
    assert "waiting for the lock" in (folder / "train.log").read_text()


# What happens to tasks, by a cluster of our own making.


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
    monkeypatch.setattr(ray_runner, "appears", lambda path: False)
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


# Mistakes.


@pytest.fixture
def installed(monkeypatch):
    """As if Ray were there: what follows is refused before it is imported."""
    monkeypatch.setattr(ray_cluster.importlib.util, "find_spec", lambda name: object())


@pytest.mark.parametrize("address", ["here", "ray://host", "http://host:1", "host:port", "host:123456"])
def test_addresses_that_are_none(address, installed, blobs, tmp_path, capsys):
    assert app.cli(["nodes", *options(blobs, tmp_path / "out", "--values", "8", "--ray", address)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and "--ray '" in lines[0] and "ray://HOST:PORT" in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_nobody_listens(scheme, installed, blobs, tmp_path, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and does not listen
        address = f"{scheme}127.0.0.1:{taken.getsockname()[1]}"
        assert app.cli(["nodes", *options(blobs, tmp_path / "out", "--values", "8", "--ray", address)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and f"--ray {address}: no connection" in lines[0] and "ray start --head" in lines[0]
    assert not (tmp_path / "out").exists()


def test_without_ray(monkeypatch, blobs, tmp_path, capsys):
    monkeypatch.setattr(ray_cluster.importlib.util, "find_spec", lambda name: None)
    assert app.cli(["nodes", *options(blobs, tmp_path / "out", "--values", "8", "--ray", "local")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and "scgs-warp[cluster]" in lines[0]


def test_what_ray_says_becomes_one_line():
    text = "Traceback (most recent call last):\n  File ...\nRuntimeError: Version mismatch: 2.9 and 2.60\n\n"
    assert ray_cluster.last_error_line(text) == "Version mismatch: 2.9 and 2.60"
    assert ray_cluster.last_error_line("") == "Ray gave no reason"
