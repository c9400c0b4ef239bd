"""Processor shares of containers, and results that do not depend on the number of threads."""

from __future__ import annotations

import gc
import math
import os
import subprocess
import sys
import threading

import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.apps import cli
from scgs_warp.errors import UserError
from scgs_warp.gaussians import GaussianParameters
from scgs_warp.motion.network import encode
from scgs_warp.runtime import environment
from scgs_warp.scene.from_gaussians import open_gaussians
from scgs_warp.scene.scene import Scene
from scgs_warp.training.loop import fit


def test_devices_that_are_not_there_are_named(tmp_path, monkeypatch):
    """In Python, too, where torch would only assert."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for load in (Scene.load, open_gaussians):
        with pytest.raises(UserError, match="device is 'cuda', but torch finds no CUDA GPU here; choose cpu"):
            load(tmp_path, "cuda")
        with pytest.raises(UserError, match="device is 'gpu'; choose cpu or cuda"):
            load(tmp_path, "gpu")
    with pytest.raises(UserError, match="finds no CUDA GPU"):
        fit(tiny_config(20), tiny_dataset(2), output=tmp_path / "run", device="cuda")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "files, expected",
    [
        ({"cpu.max": "200000 100000\n"}, 2.0),
        ({"cpu.max": "50000 100000\n"}, 0.5),
        ({"cpu.max": "max 100000\n"}, math.inf),
        ({"cpu.max": "nonsense"}, math.inf),
        ({"cpu.max": ""}, math.inf),
        ({"cpu/cpu.cfs_quota_us": "300000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 3.0),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, math.inf),
        ({}, math.inf),
    ],
)
def test_share_of_a_container(tmp_path, files, expected):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert environment.container_quota(str(tmp_path)) == expected


def test_threads_follow_affinity_and_share(monkeypatch):
    monkeypatch.setattr(environment.os, "sched_getaffinity", lambda process: set(range(64)), raising=False)
    for quota, threads in ((2.0, 2), (2.5, 3), (0.1, 1), (math.inf, 64), (1000.0, 64)):
        monkeypatch.setattr(environment, "container_quota", lambda quota=quota: quota)
        assert environment.available_threads() == threads


def test_activations_of_many_gaussians_have_the_same_bits_on_any_number_of_threads():
    """Torch's own differ where its threads meet: 100,000 elements are cut at 50,000, which is no multiple of 32."""
    random = torch.Generator().manual_seed(0)
    gaussians = GaussianParameters(
        torch.zeros(100_003, 3), torch.randn(100_003, 3, generator=random), torch.zeros(100_003, 3)
    )
    gaussians.opacity_logits.data.copy_(torch.randn(100_003, generator=random))
    positions = torch.randn(4099, 3, generator=random)
    results = []
    try:
        for threads in (1, 2, 3, 5):
            environment.configure(threads)
            results.append((gaussians.scales(), gaussians.opacities(), encode(positions, 10)))
    finally:
        environment.configure()
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_a_thread_that_began_before_the_settings_flushes_denormals_once_it_trains():
    """The mode belongs to a thread. One that kept denormals would round unlike its helpers."""
    environment.ensure_configured()
    found: list[float] = []

    def work() -> None:
        torch.set_flush_denormal(False)  # as in a thread of a pool that began earlier
        environment.ensure_configured()
        found.append(float(torch.tensor([1e-39]) * 0.5))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [0.0]


def test_apps_start_without_the_compiler_of_torch():
    """Importing it takes as long as all the rest."""
    code = (
        "import sys\n"
        "from scgs_warp.apps import cli\n"
        "cli.prepare('cpu', 1)\n"
        "import scgs_warp.editor.app, scgs_warp.export.run, scgs_warp.training.run, torch\n"
        "assert torch.are_deterministic_algorithms_enabled()\n"
        "assert torch.is_deterministic_algorithms_warn_only_enabled()\n"
        "print([name for name in ('sympy', 'torch._dynamo', 'torch._inductor') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"


def test_an_app_collects_garbage_again_once_its_libraries_are_loaded():
    cli.prepare("cpu", 1)
    try:
        assert gc.isenabled() and gc.get_freeze_count() > 0
        gc.disable()
        with environment.no_collection():
            pass
        assert not gc.isenabled(), "left as it was"
    finally:
        gc.enable()
        environment.configure()


@pytest.mark.parametrize(
    "begins, policy, expected",
    [
        ("import scgs_warp, torch", None, 2),
        ("import torch, scgs_warp", None, 1),
        ("import importlib, torch, scgs_warp; importlib.reload(scgs_warp)", None, 1),
        ("import torch, scgs_warp", "passive", 2),
    ],
)
def test_torch_that_spins_gets_one_thread(begins, policy, expected):
    """Torch's OpenMP spins between calls if it was loaded before the package could ask it to sleep; kernels use the
    same cores. Torch keeps its threads until several threads share a kernel."""
    code = f"""{begins}
from scgs_warp.ops.shading import tint
from scgs_warp.runtime import environment
torch.set_num_threads(2)
environment._threads = 2
before = torch.get_num_threads()
tint(torch.ones(100_000, 3), torch.zeros(100_000, 3))
print(before, torch.get_num_threads())
environment.configure(2)
print(torch.get_num_threads())
"""
    variables = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    if policy is not None:
        variables["OMP_WAIT_POLICY"] = policy
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, env=variables, check=True)
    assert result.stdout.split() == ["2", str(expected), str(expected)]
