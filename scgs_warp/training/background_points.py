"""Where to start with sparse points: they lie on texture alone, so bare walls and the far background get some, too."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from scipy.spatial import KDTree
from torch import Tensor

from ..data.dataset import spread
from ..geometry.normalisation import Normalisation
from ..seeding import generator
from ..types import Camera, Frame

MOST_VIEWS = 100
NEAREST = 3
"""Projected points whose median depth is that of a pixel."""
FARTHEST = 1.5
"""A surface without texture lies behind what has some: up to this many times as far."""


def _project(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Pixels [P, 2] and depths [P] of the points [P, 3] in front of the camera, inside its image."""
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    local = local[local[:, 2] > 1e-3]
    pixels = local @ camera.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    inside = ((pixels >= 0) & (pixels < pixels.new_tensor([camera.width, camera.height]))).all(1)
    return pixels[inside], local[inside, 2]


def _valid_cells(count: int, frame: Frame, random: torch.Generator) -> Tensor:
    """[count] pixels inside the mask, row times width plus column, with repetition; [0] where there are none."""
    # Drawn as integers: torch.multinomial takes no more than 2^24 pixels.
    if frame.mask is None:
        return torch.randint(frame.camera.width * frame.camera.height, (count,), generator=random)
    valid = frame.mask.flatten().nonzero()[:, 0]
    return valid[torch.randint(len(valid), (count,), generator=random)] if len(valid) else valid


def backdrop(
    count: int, points: Tensor, data: Sequence[Frame], normalisation: Normalisation, seed: int, key: int
) -> tuple[Tensor, Tensor]:
    """Points on random rays through the images, and the colours of their pixels.

    The depth is that of the nearest sparse points in the image, times a factor between 1 and ``FARTHEST``.

    Args:
        count: how many, at most: a frame that sees no sparse point, or has no valid pixel, leaves out its share.
        points: [P, 3] the data's own, normalised.

    Returns:
        points [B, 3], normalised, and their colours [B, 3], B <= ``count``. Their order is random: however many of the
        first are taken, they lie in the sight of all frames.
    """
    chosen = spread(len(data), MOST_VIEWS)
    found, colors = [], []
    for place, index in enumerate(chosen):
        frame = data[index]
        share = count * (place + 1) // len(chosen) - count * place // len(chosen)
        camera = normalisation.apply_camera(frame.camera).to("cpu")
        known, depths = _project(points.cpu(), camera)
        if share == 0 or len(known) == 0:
            continue
        random = generator(seed, key, place)
        cells = _valid_cells(share, frame, random)
        if len(cells) == 0:
            continue
        rows, columns = cells // camera.width, cells % camera.width
        pixels = torch.stack([columns, rows], 1) + torch.rand(share, 2, generator=random)
        _, nearest = KDTree(known.double().numpy()).query(pixels.double().numpy(), k=min(NEAREST, len(known)))
        depth = depths[torch.from_numpy(nearest).reshape(share, -1)].median(dim=1).values
        depth = depth * torch.exp(torch.rand(share, generator=random) * math.log(FARTHEST))
        rays = torch.cat([pixels, torch.ones(share, 1)], 1) @ torch.linalg.inv(camera.K).T * depth[:, None]
        found.append((rays - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3])
        colors.append(frame.image[rows, columns])
    if not found:
        return torch.zeros(0, 3), torch.zeros(0, 3)
    order = torch.randperm(sum(map(len, found)), generator=generator(seed, key, len(chosen)))
    return torch.cat(found)[order], torch.cat(colors)[order]
