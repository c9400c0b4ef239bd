"""A patterned ball that moves before a textured wall, filmed by a camera that walks or by several that stand."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import torch

from helpers.scenes import look_at
from scgs_warp.data.dataset import Dataset
from scgs_warp.rendering.render import render
from scgs_warp.types import Camera, Frame, Gaussians

SIZE = 160
SH_C0 = 0.28209479177387814


def wall() -> Gaussians:
    """A textured wall at y = 2, of small Gaussians in many colours."""
    generator = torch.Generator().manual_seed(3)
    x, z = torch.meshgrid(torch.linspace(-4, 4, 56), torch.linspace(-3, 3, 42), indexing="ij")
    means = torch.stack([x.flatten(), torch.full((x.numel(),), 2.0), z.flatten()], 1)
    means = means + 0.03 * torch.randn(means.shape, generator=generator)
    return _made(means, _pattern(means), 0.09)


def ball(place: torch.Tensor) -> Gaussians:
    """A patterned ball of radius 0.5 about ``place`` [3]."""
    means = torch.randn(700, 3, generator=torch.Generator().manual_seed(5))
    means = 0.5 * means / means.norm(dim=1, keepdim=True)
    return _made(means + place, _pattern(1.7 * means + 1.0), 0.05)


def _pattern(places: torch.Tensor) -> torch.Tensor:
    """Colours [N, 3] that change smoothly in space, never twice the same way."""
    directions = torch.randn(3, 6, 3, generator=torch.Generator().manual_seed(2)) * 3.0
    return (0.5 + 0.12 * torch.einsum("nd,ckd->nck", places, directions).sin().sum(2)).clamp(0.02, 0.98)


def _made(means: torch.Tensor, colors: torch.Tensor, scale: float) -> Gaussians:
    quats = torch.zeros(len(means), 4)
    quats[:, 0] = 1.0
    count = len(means)
    color = (colors - 0.5) / SH_C0
    return Gaussians(
        means, quats, torch.full((count, 3), scale), torch.full((count,), 0.95), color, torch.zeros(count, 0, 3)
    )


def scene(place: torch.Tensor | None) -> Gaussians:
    """The wall, and the ball about ``place`` [3] unless it is None."""
    fields = [dataclasses.asdict(part) for part in ([wall()] if place is None else [wall(), ball(place)])]
    return Gaussians(**{name: torch.cat([part[name] for part in fields]) for name in fields[0] if name != "sharpness"})


def walking_camera(share: float) -> Camera:
    """A camera that walks by 1.6 units and looks at the ball."""
    return _camera([-0.8 + 1.6 * share, -4.0, 0.3])


def standing_camera(degrees: float, height: float = 0.3) -> Camera:
    """A camera that stands 4 units from the origin, ``degrees`` from the front, and looks at it."""
    angle = math.radians(degrees)
    return _camera([4.0 * math.sin(angle), -4.0 * math.cos(angle), height])


def _camera(eye: list[float]) -> Camera:
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    K = torch.tensor([[1.2 * SIZE, 0, SIZE / 2], [0, 1.2 * SIZE, SIZE / 2], [0, 0, 1]])
    place = torch.tensor(eye, dtype=torch.float64)
    return Camera(look_at(place, torch.zeros(3, dtype=torch.float64), up).float(), K, SIZE, SIZE)


def filmed(views: list[tuple[Camera, float]], place_at: Callable[[float], torch.Tensor] | None) -> Dataset:
    """Film wall and ball by cameras at times, with a tenth of the wall as sparse points.

    Args:
        place_at: the ball's place at a time. None: no ball.
    """
    frames = []
    for index, (camera, time) in enumerate(views):
        with torch.no_grad():
            image = render(scene(None if place_at is None else place_at(time)), camera, torch.full((3,), 0.5))
        frames.append(Frame(camera, time, image.rgb.clamp(0, 1), None, None, f"{index:03d}"))
    sparse = wall()
    colors = (sparse.sh_dc * SH_C0 + 0.5).clamp(0, 1)
    return Dataset(frames, folder=Path("film"), split="train", points=sparse.means[::10], colors=colors[::10])
