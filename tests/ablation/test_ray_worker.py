"""Tasks of a cluster's machines, run in this process."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from helpers.tiny import write_dnerf
from scgs_warp.ablation import cells as ablate
from scgs_warp.ablation import ray_runner, ray_worker
from scgs_warp.config import presets


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
