"""Sweeps on a cluster, without one: how cells are shared out, what happens when workers are lost, what machines say."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from helpers.cells import options
from helpers.tiny import write_dnerf
from scgs_warp.ablation import ray_cluster
from scgs_warp.ablation.ray_cluster import Machine
from scgs_warp.apps import ablate as app
from scgs_warp.errors import UserError


@pytest.fixture(scope="module")
def blobs(tmp_path_factory) -> Path:
    return write_dnerf(tmp_path_factory.mktemp("data") / "blobs", 32)


def machine(cpus: float, gpus: float = 0.0) -> Machine:
    return Machine(f"id{cpus}", f"host{cpus}", cpus, gpus)


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
