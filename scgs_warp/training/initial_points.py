"""Where to start without points: random ones, preferably where the images' alpha says that something is."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..data.dataset import Dataset, spread
from ..geometry.normalisation import Normalisation
from ..seeding import generator
from ..types import Camera

HALF_SIZE = 1.3
"""Half the edge of the cube in which a scene without initial points starts (normalised units)."""
CANDIDATES = 100_000
MOST_VIEWS = 100
SHARPNESS = 3.0
"""Points are drawn with probability (share of views that see something there) to this power: a moving limb's places are
seen covered only part of the time, so they must not be carved away altogether."""


def random_points(count: int, seed: int, key: int) -> Tensor:
    """[count, 3] uniform in the cube, normalised units."""
    return (torch.rand(count, 3, generator=generator(seed, key)) * 2.0 - 1.0) * HALF_SIZE


class Coverage(NamedTuple):
    """What the views say of each point."""

    share: Tensor
    """[P] share of the views, among those that have the point in the image, whose alpha there is above one half."""
    colors: Tensor
    """[P, 3] mean colour in those views; grey where there is none."""


def coverage(points: Tensor, data: Dataset, normalisation: Normalisation) -> Coverage | None:
    """Look every point up in up to 100 frames; None where no frame has alpha. ``points`` [P, 3] normalised."""
    chosen = data.with_alpha
    if not chosen:
        return None
    covered, seen, colors = torch.zeros(len(points)), torch.zeros(len(points)), torch.zeros(len(points), 3)
    for index in chosen[:: max(1, len(chosen) // MOST_VIEWS)]:
        frame = data[index]
        row, column, inside = _places(points, normalisation.apply_camera(frame.camera))
        assert frame.alpha is not None
        hit = (inside & (frame.alpha[row, column] > 0.5)).float()
        covered += hit
        seen += inside.float()
        colors += hit[:, None] * torch.nan_to_num(frame.image[row, column])
    grey = 0.5 * (covered == 0).float()[:, None]
    return Coverage(covered / seen.clamp(min=1.0), colors / covered.clamp(min=1.0)[:, None] + grey)


def _places(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Row and column [P] of the pixels that the points [P, 3] fall into, and whether there is such a pixel [P]."""
    camera = camera.to("cpu")
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = local @ camera.K.T
    column = (pixels[:, 0] / pixels[:, 2]).floor().long()
    row = (pixels[:, 1] / pixels[:, 2]).floor().long()
    inside = (local[:, 2] > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1), inside


def common_view(points: Tensor, data: Dataset, normalisation: Normalisation) -> Tensor:
    """[P] share of up to 100 views that have the point, [P, 3] normalised, in the image."""
    chosen = spread(len(data), MOST_VIEWS)
    seen = torch.zeros(len(points))
    for index in chosen:
        seen += _places(points, normalisation.apply_camera(data.entries[index].camera))[2].float()
    return seen / len(chosen)


def likely_points(
    count: int, data: Dataset, normalisation: Normalisation, seed: int, key: int
) -> tuple[Tensor, Tensor | None]:
    """Random points [count, 3] in the cube and their colours [count, 3], drawn where the images are covered; where no
    frame has alpha, in the cameras' common view, without colours."""
    candidates = random_points(max(CANDIDATES, count), seed, key)
    found = coverage(candidates, data, normalisation)
    share = common_view(candidates, data, normalisation) if found is None else found.share
    if not bool((share > 0).any()):
        return candidates[:count], None
    random = generator(seed, key, 1)
    chosen = torch.multinomial(share**SHARPNESS, count, replacement=True, generator=random)
    spacing = 2.0 * HALF_SIZE / len(candidates) ** (1 / 3)  # the same candidate may be drawn twice
    return candidates[chosen] + spacing * (
        torch.rand(count, 3, generator=random) - 0.5
    ), None if found is None else found.colors[chosen]
