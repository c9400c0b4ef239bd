"""Initial points: those of the data with others on what moves and behind them, or random ones, where the images' alpha
shows an object."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..config.presets import TrainConfig
from ..data.dataset import Dataset, spread
from ..geometry.normalisation import Normalisation
from ..geometry.pinhole import in_image, projected
from ..seeding import Purpose, generator
from ..types import Camera
from .automatic import has_initial_points
from .background_points import background_points
from .body_turn import BodyTurn
from .frames import first_frames
from .initial_models import sphere_unit, starts_in_first_pose
from .points_on_movers import points_on_movers
from .start_motion import SeenMotion
from .stereo_depth import StereoDepths

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


class InitialPoints(NamedTuple):
    """Where Gaussians and control points begin."""

    points: Tensor
    """[P, 3] normalised."""
    colors: Tensor
    """[P, 3]"""
    moves: Tensor
    """[Q] bool for the leading Q points, which lie on what is seen: True if known to move."""
    motion: SeenMotion | None = None
    """What is seen of the motion."""
    stereo: StereoDepths | None = None
    """Depth of the frames of a rig."""


def initial_points(
    config: TrainConfig, data: Dataset, normalisation: Normalisation, turn: BodyTurn | None = None
) -> InitialPoints:
    """Choose initial points: those of the data and others about them, or random ones if the data has too few.

    Args:
        turn: that of the subject; random points are then those of the middle instant.
    """
    count = max(config.init_points, round(sphere_unit(config) * config.pretrain.start_ratio))
    if data.points is None or not has_initial_points(data, config):
        return _at_random(count, config, data, normalisation, turn)
    return _of_data(count, data.points, config, data, normalisation)


def _at_random(
    count: int, config: TrainConfig, data: Dataset, normalisation: Normalisation, turn: BodyTurn | None
) -> InitialPoints:
    """Draw points where the images are covered; with ``init_random`` cube, grey ones in a cube."""
    if config.init_random == "cube":
        points, colors = random_points(count, config.seed), None
    else:
        # Spheres that start in the pose of the first frames are sampled from these frames only.
        frames = first_frames(data) if starts_in_first_pose(config) and config.pretrain_steps else data
        points, colors = sample_initial_points(count, frames, normalisation, config.seed, turn)
    colors = torch.full_like(points, 0.5) if colors is None else colors
    return InitialPoints(points, colors, torch.zeros(len(points), dtype=torch.bool))


def _of_data(
    count: int, given: Tensor, config: TrainConfig, data: Dataset, normalisation: Normalisation
) -> InitialPoints:
    """Take the data's points ``given`` [P, 3], world units, in random order, followed by those on what moves at one
    instant, and by points behind them for surfaces without texture. With alpha, or with ``init_random`` cube, nothing
    follows the data's points."""
    order = torch.randperm(len(given), generator=generator(config.seed, Purpose.DATA_POINTS))[:count]
    points = normalisation.apply(given)[order].float().contiguous()
    colors = torch.full_like(points, 0.5) if data.colors is None else data.colors[order].float()
    moves = torch.zeros(len(points), dtype=torch.bool)
    if config.init_random == "cube" or data.with_alpha:  # with alpha, no background lies behind the points
        return InitialPoints(points, colors, moves)
    known, motion, stereo = points, None, None
    if config.flow_points and config.motion.model != "static":
        used = min(config.init_points, config.densify.max_gaussians)
        seen, keep, motion, stereo = points_on_movers(
            config.flow_points, used, points, data, normalisation, config.seed
        )
        known, room = points[keep], used - len(seen.points)
        points, colors = torch.cat([known[:room], seen.points]), torch.cat([colors[keep][:room], seen.colors])
        moves = torch.cat([moves[keep][:room], seen.moves])
    behind = background_points(count - len(points), known, data, normalisation, config.seed)
    return InitialPoints(torch.cat([points, behind[0]]), torch.cat([colors, behind[1]]), moves, motion, stereo)


def random_points(count: int, seed: int) -> Tensor:
    """Draw points [count, 3] uniformly in the cube, normalised units."""
    return (torch.rand(count, 3, generator=generator(seed, Purpose.RANDOM_POINTS)) * 2.0 - 1.0) * HALF_SIZE


class Coverage(NamedTuple):
    """Coverage of points by the alpha of the views."""

    share: Tensor
    """[P] share of the views with alpha above one half at the point, among the views that contain it."""
    colors: Tensor
    """[P, 3] mean colour in the views that cover the point; grey if no view covers it."""


def coverage(
    points: Tensor, data: Dataset, normalisation: Normalisation, turn: BodyTurn | None = None
) -> Coverage | None:
    """Measure the coverage of ``points`` [P, 3], normalised, in up to 100 frames; return None if no frame has alpha.

    Args:
        turn: carries the points; None if they rest.
    """
    chosen = data.with_alpha
    if not chosen:
        return None
    covered, seen, colors = torch.zeros(len(points)), torch.zeros(len(points)), torch.zeros(len(points), 3)
    for index in chosen[:: max(1, len(chosen) // MOST_VIEWS)]:
        frame = data[index]
        there = points if turn is None else turn.carry(points, frame.time)
        row, column, inside = _pixels(there, normalisation.apply_camera(frame.camera))
        assert frame.alpha is not None
        hit = (inside & (frame.alpha[row, column] > 0.5)).float()
        covered += hit
        seen += inside.float()
        colors += hit[:, None] * torch.nan_to_num(frame.image[row, column])
    grey = 0.5 * (covered == 0).float()[:, None]
    return Coverage(covered / seen.clamp(min=1.0), colors / covered.clamp(min=1.0)[:, None] + grey)


def _pixels(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Project points [P, 3] to pixels: return their rows [P] and columns [P], and [P] bool: inside the image."""
    pixels, local = projected(points, camera)
    inside = in_image(pixels, local, camera)
    column, row = pixels.floor().long().unbind(1)
    return row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1), inside


def common_view(points: Tensor, data: Dataset, normalisation: Normalisation) -> Tensor:
    """Return, for each of ``points`` [P, 3], normalised, the share [P] of up to 100 views that contain it."""
    chosen = spread(len(data), MOST_VIEWS)
    seen = torch.zeros(len(points))
    for index in chosen:
        seen += _pixels(points, normalisation.apply_camera(data.entries[index].camera))[2].float()
    return seen / len(chosen)


def sample_initial_points(
    count: int, data: Dataset, normalisation: Normalisation, seed: int, turn: BodyTurn | None = None
) -> tuple[Tensor, Tensor | None]:
    """Draw random points where the images are covered or, if no frame has alpha, where the cameras' views overlap.

    Args:
        turn: carries the points; None if they rest.

    Returns:
        points [count, 3], normalised, and colours [count, 3]; the colours are None if no frame has alpha.
    """
    candidates = random_points(max(CANDIDATES, count), seed)
    covered = coverage(candidates, data, normalisation, turn)
    share = common_view(candidates, data, normalisation) if covered is None else covered.share
    if not bool((share > 0).any()):
        return candidates[:count], None
    random = generator(seed, Purpose.RANDOM_POINTS, 1)
    chosen = torch.multinomial(share**SHARPNESS, count, replacement=True, generator=random)
    spacing = 2.0 * HALF_SIZE / len(candidates) ** (1 / 3)  # the same candidate may be drawn twice
    points = candidates[chosen] + spacing * (torch.rand(count, 3, generator=random) - 0.5)
    return points, None if covered is None else covered.colors[chosen]
