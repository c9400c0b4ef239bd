"""The swinging blobs of ``helpers.tiny``, filmed by a camera that moves slowly."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from helpers.scenes import look_at
from helpers.tiny import blobs
from scgs_warp.data.dataset import Dataset
from scgs_warp.rendering.render import render
from scgs_warp.types import Camera, Frame, Gaussians

SIZE = 96


def film_camera(share: float, size: int = SIZE) -> Camera:
    """A camera that moves by 20 degrees in a film."""
    angle = torch.deg2rad(torch.tensor(20.0 * share, dtype=torch.float64))
    eye = torch.stack([4 * angle.sin(), -4 * angle.cos(), angle.new_tensor(1.0)])
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    K = torch.tensor([[1.4 * size, 0, size / 2], [0, 1.4 * size, size / 2], [0, 0, 1]])
    return Camera(look_at(eye, torch.zeros(3, dtype=torch.float64), up).float(), K, size, size)


def film(count: int = 12, size: int = SIZE) -> Dataset:
    """The swinging blobs of ``helpers.tiny``, filmed by a camera that moves slowly; frames without alpha."""
    frames = []
    for index in range(count):
        time = index / (count - 1)
        with torch.no_grad():
            image = render(blobs(time), film_camera(time, size), torch.zeros(3))
        frames.append(Frame(film_camera(time, size), time, image.rgb.clamp(0, 1), None, None, f"{index:03d}"))
    return Dataset(frames, folder=Path("film"), split="train")


def with_depth(data: Dataset, size: int = SIZE, share: float = 1.0) -> Dataset:
    """Give the leading frames of such a film the depth of what covers their pixels."""
    frames = []
    for index, frame in enumerate(data):
        with torch.no_grad():
            image = render(blobs(frame.time), film_camera(frame.time, size), torch.zeros(3))
        depth = torch.where(image.alpha > 0.9, image.depth, 0.0)
        frames.append(dataclasses.replace(frame, depth=depth) if index < share * len(data) else frame)
    return Dataset(frames, folder=data.folder, split="train")


def on_device(gaussians: Gaussians, device: str) -> Gaussians:
    tensors = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    return Gaussians(*(t.to(device) for t in tensors), gaussians.sh_dc.to(device), gaussians.sh_rest.to(device))
