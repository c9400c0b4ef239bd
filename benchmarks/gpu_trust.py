"""Parts of ``gpu_check.py`` for robustness: poisoned inputs, a crowded screen, steps shared by processes."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch

from scgs_warp.rendering.render import draw
from scgs_warp.runtime import memory
from scgs_warp.types import Camera, Gaussians

ROOT = Path(__file__).resolve().parent.parent
FUZZ_SECONDS = 240.0
TRAINING = "--downscale 2 --steps 60 --nodes 40 --max-gaussians 2000 --batch 2 --threads 1".split()
"""Options of a run that takes seconds, with two views per step."""


def run(command: list[str], seconds: float) -> None:
    """Run a command; raise a RuntimeError with the end of its output if it fails."""
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=seconds)
    if done.returncode != 0:
        raise RuntimeError(f"status {done.returncode}: {(done.stderr or done.stdout)[-800:]}")


def fuzz(device: str, quick: bool) -> dict[str, Any]:
    """Run the fuzzing campaign: poisoned inputs of every op."""
    cases = 40 if quick else 2000
    with tempfile.TemporaryDirectory() as folder:
        summary = Path(folder) / "summary.json"
        command = [sys.executable, "tests/fuzz/campaign.py", "--cases", str(cases), "--device", device]
        run([*command, "--seed", "50000", "--summary", str(summary)], FUZZ_SECONDS)
        return {"passed": True, "cases": cases, "summary": json.loads(summary.read_text())}


def crowded(device: str, quick: bool) -> dict[str, Any]:
    """Draw, in bands that need little memory, Gaussians that all fill the screen."""
    count, width, height, gib = (1000, 320, 240, 4.0) if quick else (1_000_000, 1920, 1080, 4.0)
    g = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=g) * 0.05 + torch.tensor([0.0, 0.0, 4.0])
    quats, scales = torch.randn(count, 4, generator=g), 6.0 + torch.rand(count, 3, generator=g)
    opacities, colors = 0.02 + 0.05 * torch.rand(count, generator=g), torch.randn(count, 3, generator=g)
    fields = (means, quats, scales, opacities, colors, torch.zeros(count, 0, 3))
    K = torch.tensor([[width * 0.8, 0.0, width / 2], [0.0, width * 0.8, height / 2], [0.0, 0.0, 1.0]])
    gaussians, camera = Gaussians(*(x.to(device) for x in fields)), Camera(torch.eye(4), K, width, height).to(device)
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


def share(device: str) -> dict[str, Any]:
    """Compare the checkpoint of ``torchrun`` with one process (NCCL on a GPU) with that of a plain run."""
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "figure"
        size = ["--size", "96", "--train", "8", "--test", "2"]
        run([sys.executable, "apps/synthesize.py", "--output", str(data), *size], 240.0)
        alone, team = Path(folder) / "alone", Path(folder) / "team"
        options = ["--data", str(data), "--preset", "quick", "--device", device, *TRAINING]
        run([sys.executable, "apps/train.py", *options, "--output", str(alone)], 300.0)
        torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "1"]
        run([*torchrun, "apps/train.py", *options, "--output", str(team)], 300.0)
        name = "checkpoint.safetensors"
        same = (alone / name).read_bytes() == (team / name).read_bytes()
        return {"passed": same, "same_bits": same}
