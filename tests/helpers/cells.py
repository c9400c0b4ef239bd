"""Cells of ablations, as training leaves them, and the options of small ones."""

from __future__ import annotations

import json
from pathlib import Path

from scgs_warp.ablation import cells
from scgs_warp.config import presets

SMALL = ["--set", "motion.layers=3", "--set", "motion.width=32", "--set", "motion.skip=2", "--set", "init_points=300",
         "--device", "cpu"]  # fmt: skip


def options(blobs: Path, output: Path, *more: str, steps: int = 30) -> list[str]:
    return ["--data", str(blobs), "--output", str(output), "--steps", str(steps), *SMALL, *more]


def craft(output: Path, name: str, value: str, seed: int = 0, scene: str = "hook", steps: int = 12_000, **metrics):
    """A cell's folder as training leaves it."""
    folder = output / scene / cells.cell_folder(value, seed)
    folder.mkdir(parents=True)
    made = cells.settings_of_cell(presets.with_steps(presets.preset("cpu"), steps), name, value, seed)
    settings = presets.to_dict(made)
    settings["data"]["folder"] = f"/data/{scene}"
    (folder / "config.json").write_text(json.dumps(settings))
    usual = {"ssim": 0.99, "lpips": None, "seconds": 60.0, "gaussians": 1000, "control_points": 10, "device": "cpu"}
    (folder / "metrics.json").write_text(json.dumps({**usual, **metrics, "per_image": [{"psnr": 1.0}]}))
