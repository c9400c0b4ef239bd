"""Frames of a camera that moves a little from frame to frame, as one held by hand."""

from __future__ import annotations

from pathlib import Path

import torch

from helpers.scenes import look_at
from scgs_warp.data import Dataset
from scgs_warp.types import Camera, Frame


def handheld(
    frames: int = 40, step: float = 1.0, exposure: float = 0.0, alpha: bool = False, views: int = 1
) -> Dataset:
    """A camera that moves by ``step`` degrees a frame around a grey scene, its exposure going up and down."""
    K = torch.tensor([[40.0, 0, 16], [0, 40.0, 12], [0, 0, 1]])
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    made = []
    for index in range(frames):
        angle = torch.deg2rad(torch.tensor(step * index, dtype=torch.float64))
        eye = torch.stack([4 * angle.cos(), 4 * angle.sin(), 0.5 * torch.ones_like(angle)])
        camera = Camera(look_at(eye, torch.zeros(3, dtype=torch.float64), up).float(), K, 32, 24)
        image = torch.full((24, 32, 3), 0.5 * (1 + exposure * (index % 2)))
        mask = torch.ones(24, 32, dtype=torch.bool)
        covered = torch.ones(24, 32) if alpha else None
        made.append(Frame(camera, (index // views) / max((frames - 1) // views, 1), image, covered, mask, f"{index}"))
    return Dataset(made, folder=Path("handheld"), split="train")
