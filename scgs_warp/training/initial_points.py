"""Random initial points for data sets without points, drawn where the images' alpha shows an object."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..data.dataset import Dataset, spread
from ..geometry.normalisation import Normalisation
from ..seeding import generator
from ..types import Camera

HALF_SIZE = 1.3
"""Half the edge of the cube in which random points are drawn, normalised units."""
CANDIDATES = 100_000
"""Smallest number of candidates from which the initial points are drawn."""
MOST_VIEWS = 100
"""Largest number of frames in which a candidate is looked up."""
SHARPNESS = 3.0
"""Exponent of the share of views in which a candidate is covered; the power is its probability of being drawn. Points
covered in only some views must remain possible, because a moving limb covers each of its positions only part of the
time."""


def random_points(count: int, seed: int, key: int) -> Tensor:
    """Draw points [count, 3] uniformly in the cube, normalised units."""
    return (torch.rand(count, 3, generator=generator(seed, key)) * 2.0 - 1.0) * HALF_SIZE


class Coverage(NamedTuple):
    """Coverage of points by the alpha of the views."""

    share: Tensor
    """[P] share of the views with alpha above one half at the point, among the views that contain it."""
    colors: Tensor
    """[P, 3] mean colour in the views that cover the point; grey if no view covers it."""


def coverage(points: Tensor, data: Dataset, normalisation: Normalisation) -> Coverage | None:
    """Measure the coverage of ``points`` [P, 3], normalised, in up to 100 frames; return None if no frame has alpha."""
    chosen = data.with_alpha
    if not chosen:
        return None
    covered, seen, colors = torch.zeros(len(points)), torch.zeros(len(points)), torch.zeros(len(points), 3)
    for index in chosen[:: max(1, len(chosen) // MOST_VIEWS)]:
        frame = data[index]
        row, column, inside = _pixels(points, normalisation.apply_camera(frame.camera))
        assert frame.alpha is not None
        hit = (inside & (frame.alpha[row, column] > 0.5)).float()
        covered += hit
        seen += inside.float()
        colors += hit[:, None] * torch.nan_to_num(frame.image[row, column])
    grey = 0.5 * (covered == 0).float()[:, None]
    return Coverage(covered / seen.clamp(min=1.0), colors / covered.clamp(min=1.0)[:, None] + grey)


def _pixels(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Project points [P, 3] to pixels: return their rows [P] and columns [P], and [P] bool: inside the image."""
    camera = camera.to("cpu")
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = local @ camera.K.T
    column = (pixels[:, 0] / pixels[:, 2]).floor().long()
    row = (pixels[:, 1] / pixels[:, 2]).floor().long()
    inside = (local[:, 2] > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1), inside


def common_view(points: Tensor, data: Dataset, normalisation: Normalisation) -> Tensor:
    """Return, for each of ``points`` [P, 3], normalised, the share [P] of up to 100 views that contain it."""
    chosen = spread(len(data), MOST_VIEWS)
    seen = torch.zeros(len(points))
    for index in chosen:
        seen += _pixels(points, normalisation.apply_camera(data.entries[index].camera))[2].float()
    return seen / len(chosen)


def sample_initial_points(
    count: int, data: Dataset, normalisation: Normalisation, seed: int, key: int
) -> tuple[Tensor, Tensor | None]:
    """Draw random points where the images are covered or, if no frame has alpha, where the cameras' views overlap.

    Returns:
        points [count, 3], normalised, and colours [count, 3]; the colours are None if no frame has alpha.
    """
    candidates = random_points(max(CANDIDATES, count), seed, key)
    covered = coverage(candidates, data, normalisation)
    share = common_view(candidates, data, normalisation) if covered is None else covered.share
    if not bool((share > 0).any()):
        return candidates[:count], None
    random = generator(seed, key, 1)
    chosen = torch.multinomial(share**SHARPNESS, count, replacement=True, generator=random)
    spacing = 2.0 * HALF_SIZE / len(candidates) ** (1 / 3)  # the same candidate may be drawn twice
    points = candidates[chosen] + spacing * (torch.rand(count, 3, generator=random) - 0.5)
    return points, None if covered is None else covered.colors[chosen]
