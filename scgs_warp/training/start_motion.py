"""Motion of what moves, learnt from its points at several moments before the first step.

The photometric loss moves a Gaussian only while the Gaussian overlaps with the surface that it shows. After a few
frames, a waving arm or a walking leg no longer overlaps with its Gaussians, and fades instead. Clouds of points, by
stereo or from depth maps, show where the limb is at each moment. The motion learns to carry the points of one moment to
the clouds of the others: along tracks where there are any, and to the nearest points of similar colour. Neighbours keep
their distances, and what stands still stays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..config.presets import TrainConfig
from ..gaussians import GaussianParameters, gaussians_from_points
from ..motion import ControlPoints
from ..optim import Adam, log_linear
from ..runtime.progress import progress
from ..runtime.search_tree import search_tree
from ..seeding import Purpose, generator
from .clouds import Cloud
from .tracks import Tracks

STEPS = 600
"""Number of steps without tracks."""
STEPS_TRACKED, STEPS_PER_CLOUD = 1500, 250
"""With tracks: least number of steps, and number of steps for each cloud. Tracks lead farther than nearest points, and
are exact enough to be followed closely."""
POINTS, RESTING = 1500, 600
"""Largest numbers of moving points of a cloud, and of resting points."""
RATE, RATE_END = 1e-3, 1e-4
"""Learning rate of the network at the first and the last step."""
COLOR = 0.7
"""Distance that equals a difference of colour of 1 in the search for nearest points, in sizes of the mover."""
FAR = 0.5
"""Distance, in sizes of the mover, beyond which pairs of points hardly pull."""
HIDDEN = 0.5
"""Weight of the points that a cloud may not show, because no two cameras see them."""
LED, BESIDE = 4.0, 0.2
"""Weight of the distance to tracks, and then of the distance to nearest points, which pulls hidden points astray."""
NEIGHBORS, STIFF = 8, 0.05
"""Number of neighbours to which a point keeps its distance, and weight of this term."""


def start_cloud(clouds: list[Cloud]) -> Cloud:
    """Choose the cloud nearest to the middle of the time; its pose is the rest pose."""
    return min(clouds, key=lambda cloud: abs(cloud.time - 0.5))


class SeenMotion(NamedTuple):
    """What is seen of the motion before the first step."""

    source: Cloud
    """Points of what moves, in the rest pose."""
    clouds: list[Cloud]
    """Points at several moments, that of the source among them; normalised."""
    tracks: Tracks | None
    """Where the points of the source are at the time of each cloud, if that is known."""


def learn_motion(motion: ControlPoints, seen: SeenMotion, resting: Tensor, config: TrainConfig) -> None:
    """Train the network in place.

    Args:
        resting: [P, 3] points of what stands still, normalised.
    """
    device, clouds = motion.positions.device, seen.clouds
    targets = [_Target(cloud, config.seed, number) for number, cloud in enumerate(clouds)]
    start = [cloud.time for cloud in clouds].index(seen.source.time)
    source = _Target(seen.source, config.seed, start)
    size = max(source.size, 1e-6)
    tracks = None if seen.tracks is None else seen.tracks.of(source.chosen).to(device)
    for target in targets:
        target.prepare(COLOR * size)
    chosen = torch.randperm(len(resting), generator=generator(config.seed, Purpose.RESTING_POINTS))[:RESTING]
    gaussians = _carried(source, resting[chosen].float(), config).to(device)
    count = len(source.points)
    body = _Body(source.points)
    network = dict(motion.network.named_parameters())
    optimizer = Adam(network, dict.fromkeys(network, RATE))
    draws = generator(config.seed, Purpose.CLOUDS)
    steps = STEPS if tracks is None else max(STEPS_TRACKED, STEPS_PER_CLOUD * len(clouds))
    with progress(steps, "motion of what moves") as bar:
        for step in range(steps):
            for group in optimizer.groups.values():
                group.rate = log_linear(RATE, RATE_END, step, steps)
            number = int(torch.randint(len(clouds), (1,), generator=draws))
            pose = motion.poses(torch.tensor([clouds[number].time]))[0]
            means = motion.bind_and_pose(gaussians, pose, frozen=True).means
            pulled = targets[number].distance(means[:count], source.colors, FAR * size) / size**2
            held = (means[count:] - gaussians.means[count:]).square().sum(1).mean() / size**2
            if tracks is not None:
                apart = (means[:count] - tracks.places[number]).square().sum(1)
                led = (tracks.weights[number] * _robust(apart, FAR * size)).mean() / size**2
                pulled = BESIDE * pulled + LED * led
            loss = pulled + STIFF * body.stretch(means[:count]) + (held if len(chosen) else 0.0)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            bar.advance()
    optimizer.zero_grad()


def _carried(source: _Target, resting: Tensor, config: TrainConfig) -> GaussianParameters:
    """Make Gaussians at the points that move and those that do not; they get no gradients."""
    points = torch.cat([source.points, resting])
    gaussians = gaussians_from_points(points, None, sh_degree=0, hyper_columns=config.motion.hyper_columns)
    gaussians.hyper.data[:, : config.motion.hyper_dim] *= config.motion.hyper_stretch
    return gaussians.requires_grad_(False)


class _Body:
    """Distances between neighbouring points."""

    def __init__(self, points: Tensor) -> None:
        count = min(NEIGHBORS, len(points) - 1)
        _, nearest = search_tree(points.numpy()).query(points.numpy(), k=count + 1)
        self.neighbors = torch.from_numpy(nearest.reshape(len(points), -1)[:, 1:].copy())
        self.lengths = self._lengths(points)

    def _lengths(self, points: Tensor) -> Tensor:
        return (points[:, None] - points[self.neighbors.to(points.device)]).square().sum(-1).add(1e-12).sqrt()

    def stretch(self, points: Tensor) -> Tensor:
        """Return the mean squared change of the distances, as a share of their mean square."""
        rest = self.lengths.to(points.device)
        return (self._lengths(points) - rest).square().mean() / rest.square().mean().clamp(min=1e-12)


class _Target:
    """The points of one cloud, to which others are drawn."""

    def __init__(self, seen: Cloud, seed: int, number: int) -> None:
        self.chosen = torch.randperm(len(seen.points), generator=generator(seed, Purpose.CLOUD_POINTS, number))[:POINTS]
        self.points, self.colors = seen.points[self.chosen], seen.colors[self.chosen]
        self.size = float((self.points - self.points.median(0).values).norm(dim=1).median())

    def prepare(self, color_unit: float) -> None:
        """Build the search; ``color_unit`` is the length of a unit of colour."""
        self._unit = color_unit
        self._features = self._joined(self.points, self.colors)
        self._tree = search_tree(self._features)

    def _joined(self, points: Tensor, colors: Tensor) -> np.ndarray:
        return torch.cat([points.detach().cpu(), self._unit * colors], 1).double().numpy()

    def distance(self, points: Tensor, colors: Tensor, far: float) -> Tensor:
        """Return the mean squared distance of points [P, 3] of given colours to this cloud and back, in which distances
        beyond ``far`` count less and less (Geman and McClure)."""
        moved = self._joined(points, colors)
        own = self.points.to(points.device)
        nearest = torch.from_numpy(search_tree(moved).query(self._features)[1]).to(points.device)
        there = torch.from_numpy(self._tree.query(moved)[1]).to(points.device)
        to_cloud, back = (points[nearest] - own).square().sum(1), (points - own[there]).square().sum(1)
        return _robust(to_cloud, far).mean() + HIDDEN * _robust(back, far).mean()


def _robust(squares: Tensor, far: float) -> Tensor:
    return squares / (1.0 + squares / far**2)
