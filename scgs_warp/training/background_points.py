"""Initial points for bare walls and the far background, because a reconstruction's sparse points lie only on
texture."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..data.dataset import spread
from ..geometry.normalisation import Normalisation
from ..geometry.pinhole import in_image, projected
from ..runtime.search_tree import search_tree
from ..seeding import Purpose, generator
from ..types import Frame

MOST_VIEWS = 100
"""Largest number of frames through which rays are cast."""
NEAREST = 3
"""Number of projected points nearest to a pixel; their median depth is used as that of the pixel."""
NEAREST_DEPTH = 1e-3
"""Depth, normalised, up to which a sparse point tells nothing."""
FARTHEST = 1.5
"""Largest ratio of a point's depth to that of nearby texture. The ratio is at least 1, because surfaces without texture
lie behind texture."""


def _valid_cells(count: int, frame: Frame, random: torch.Generator) -> Tensor:
    """Draw ``count`` valid pixels with repetition; return their flat indices (row times width plus column), [count], or
    [0] if the mask is empty."""
    # torch.multinomial takes at most 2^24 pixels; integers have no such limit.
    if frame.mask is None:
        return torch.randint(frame.camera.width * frame.camera.height, (count,), generator=random)
    valid = frame.mask.flatten().nonzero()[:, 0]
    return valid[torch.randint(len(valid), (count,), generator=random)] if len(valid) else valid


def background_points(
    count: int, points: Tensor, data: Sequence[Frame], normalisation: Normalisation, seed: int
) -> tuple[Tensor, Tensor]:
    """Place points on random rays through the images, with the colours of their pixels.

    The depth is that of the nearest sparse points in the image, times a random factor between 1 and ``FARTHEST``.

    Args:
        count: largest number of points. Frames that see no sparse point or have no valid pixel yield none, so fewer may
            result.
        points: [P, 3] sparse points of the data, normalised.

    Returns:
        points [B, 3], normalised, and colours [B, 3], B <= ``count``, in random order, so that any leading part of them
        is spread over all frames.
    """
    chosen = spread(len(data), MOST_VIEWS)
    positions, colors = [], []
    for ray_set, index in enumerate(chosen):
        frame = data[index]
        share = count * (ray_set + 1) // len(chosen) - count * ray_set // len(chosen)
        camera = normalisation.apply_camera(frame.camera).to("cpu")
        known, local = projected(points.cpu(), camera)
        inside = in_image(known, local, camera, NEAREST_DEPTH)
        known, depths = known[inside], local[inside, 2]
        if share == 0 or len(known) == 0:
            continue
        random = generator(seed, Purpose.BACKGROUND_POINTS, ray_set)
        cells = _valid_cells(share, frame, random)
        if len(cells) == 0:
            continue
        rows, columns = cells // camera.width, cells % camera.width
        pixels = torch.stack([columns, rows], 1) + torch.rand(share, 2, generator=random)
        _, nearest = search_tree(known.double().numpy()).query(pixels.double().numpy(), k=min(NEAREST, len(known)))
        depth = depths[torch.from_numpy(nearest).reshape(share, -1)].median(dim=1).values
        depth = depth * torch.exp(torch.rand(share, generator=random) * math.log(FARTHEST))
        rays = torch.cat([pixels, torch.ones(share, 1)], 1) @ torch.linalg.inv(camera.K).T * depth[:, None]
        positions.append((rays - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3])
        colors.append(frame.image[rows, columns])
    if not positions:
        return torch.zeros(0, 3), torch.zeros(0, 3)
    order = torch.randperm(sum(map(len, positions)), generator=generator(seed, Purpose.BACKGROUND_POINTS, len(chosen)))
    return torch.cat(positions)[order], torch.cat(colors)[order]
