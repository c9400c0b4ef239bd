"""Parts of ``gpu_check`` for robustness: poisoned inputs, a crowded screen, a process group."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from unittest import mock

import torch
from gpu_session import ROOT, Call, NotRun, Report

from scgs_warp.apps import train
from scgs_warp.rendering.render import draw
from scgs_warp.runtime import memory
from scgs_warp.runtime.torchrun import ProcessRank
from scgs_warp.types import Camera, Gaussians

FUZZ_SECONDS = 240.0
TRAINING = "--downscale 2 --steps 60 --nodes 40 --max-gaussians 2000 --batch 2 --threads 1".split()
"""Options of a run that takes seconds, with two views per step."""


def run(command: list[str], seconds: float) -> None:
    """Run a command; raise a RuntimeError with the end of its output if it fails."""
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=seconds)
    if done.returncode != 0:
        raise RuntimeError(f"status {done.returncode}: {(done.stderr or done.stdout)[-800:]}")


def fuzz(call: Call) -> Report:
    """Run the fuzzing campaign: poisoned inputs of every op."""
    cases, summary = 40 if call.setting.quick else 2000, call.work / "fuzz.json"
    command = [sys.executable, "tests/fuzz/campaign.py", "--cases", str(cases), "--device", call.setting.device]
    run([*command, "--seed", "50000", "--summary", str(summary)], FUZZ_SECONDS)
    return {"passed": True, "cases": cases, "summary": json.loads(summary.read_text(encoding="utf-8"))}


def crowded(call: Call) -> Report:
    """Draw, in bands that need little memory, Gaussians that all fill the screen."""
    device = call.setting.device
    count, width, height, gib = (1000, 320, 240, 4.0) if call.setting.quick else (1_000_000, 1920, 1080, 4.0)
    g = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=g) * 0.05 + torch.tensor([0.0, 0.0, 4.0])
    quats, scales = torch.randn(count, 4, generator=g), 6.0 + torch.rand(count, 3, generator=g)
    opacities, colors = 0.02 + 0.05 * torch.rand(count, generator=g), torch.randn(count, 3, generator=g)
    rest = torch.zeros(count, 0, 3)
    K = torch.tensor([[width * 0.8, 0.0, width / 2], [0.0, width * 0.8, height / 2], [0.0, 0.0, 1.0]])
    means, quats, scales, opacities, colors, rest = (
        x.to(device) for x in (means, quats, scales, opacities, colors, rest)
    )
    gaussians = Gaussians(means, quats, scales, opacities, colors, rest)
    camera = Camera(torch.eye(4), K, width, height).to(device)
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    memory.set_limit(gib)
    try:
        with torch.no_grad():
            image, alpha = draw(gaussians, camera)
        peak = torch.cuda.max_memory_allocated() / memory.GIB if device == "cuda" else None
        sound = bool(torch.isfinite(image).all()) and float(alpha.min()) > 0.9
        return {"passed": sound and (peak is None or peak < gib), "peak_gib": peak, "allowed_gib": gib}
    finally:
        memory.set_limit(None)


@contextlib.contextmanager
def _team_of_one() -> Iterator[None]:
    """Let the training app believe that ``torchrun`` started it as the only process of a group."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    rank = {"RANK": "0", "WORLD_SIZE": "1", "LOCAL_RANK": "0", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    with mock.patch.dict(os.environ, rank), mock.patch.object(train, "process_rank", lambda: ProcessRank(0, 1)):
        yield


def share(call: Call) -> Report:
    """Compare the checkpoint of a process group of one process (NCCL on a GPU) with that of a plain run.

    ``torchrun`` with one process would train without a group, so this process makes the group itself.

    Raises:
        NotRun: this torch has no NCCL.
    """
    if call.setting.device == "cuda" and not torch.distributed.is_nccl_available():
        raise NotRun("this torch has no NCCL")
    data, alone, team = (call.work / f"share-{name}" for name in ("scene", "alone", "team"))
    for folder in (data, alone, team):
        shutil.rmtree(folder, ignore_errors=True)
    size = ["--size", "96", "--train", "8", "--test", "2"]
    run([sys.executable, "apps/synthesize.py", "--output", str(data), *size], 240.0)
    options = ["--data", str(data), "--preset", "quick", "--device", call.setting.device, *TRAINING]
    run([sys.executable, "apps/train.py", *options, "--output", str(alone)], 300.0)
    with _team_of_one():
        train.main([*options, "--output", str(team)])
    name = "checkpoint.safetensors"
    same = (alone / name).read_bytes() == (team / name).read_bytes()
    return {"passed": same, "same_bits": same}
