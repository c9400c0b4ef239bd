"""Turn of the whole subject, found from its silhouettes.

Where the camera stands elsewhere at each instant, stage 1 learns how limbs move, but not that a dancer turns round:
spheres move no further than the images of single moments require. But three numbers describe the turn of a short window
of instants, so that many can be tried. Under the right one, the silhouettes of the window belong to one shape: its
visual hull fills each of them. Under a wrong one, hardly any place is inside all silhouettes, and the hull is too thin.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..data.dataset import Dataset
from ..geometry.normalisation import Normalisation
from ..motion.spheres import Spheres
from ..optim import Adam, log_linear
from ..seeding import Purpose, generator
from .turn_windows import WINDOW, at_instants, integrated, steadiest, tried_turns, window_starts
from .visual_hull import Outline, Window, read_outlines, steady_window, unfilled, window_along

FASTEST = 5.0
"""Largest turn per instant that is tried, degrees."""
ROUGH, FINE = 2.5, 1.0
"""Distances between tried turns, degrees per instant: to tell whether the subject turns, and by how much."""
LONG = 24
"""Number of instants of the windows by which the turns are refined."""
STEPS_OF_TURNS, MOST_MOVES = (1.0, 0.5), 4
"""Steps of the refinement in degrees per instant, one round each, and largest number of them at one place."""
EVIDENCE = 10.0
"""Weight of the logarithm of a window's unfilled share against changes of the turn (``turn_windows.steadiest``)."""
LEAST = 0.2
"""Mean decrease of this logarithm, relative to no turn, from which the subject is said to turn."""
ONE_SIDED = 0.9
"""Length of the mean direction to the cameras of a window above which they stand on one side: the hull is then open
towards them, and almost any turn fits."""
MOST_INSTANTS = 1000
"""Largest number of instants with which the turn is looked for, so that this takes minutes at most."""
STEPS, POINTS = 2500, 400
"""Number of steps in which the network learns the turn, and of points in each."""
RATE, RATE_END = 1e-3, 1e-4
"""Learning rate of the network at the first and the last of them."""
TELL_EVERY = 25
"""Number of these steps from one line of progress to the next."""
BESIDE = 0.02
"""Standard deviation, in radii of the subject, by which these points are moved: spheres will move, too."""


class BodyTurn(NamedTuple):
    """Rigid motion of the whole subject, normalised."""

    times: np.ndarray
    """[T] the instants."""
    rotations: np.ndarray
    """[T, 3, 3] from the middle instant to each."""
    centres: np.ndarray
    """[T, 3] centre at each instant."""
    radius: float
    """Distance from the centre within which the subject is."""

    def carry(self, points: Tensor, time: float) -> Tensor:
        """Return where ``points`` [P, 3] of the middle instant are at the instant nearest to ``time``."""
        instant, middle = int(np.abs(self.times - time).argmin()), len(self.times) // 2
        rotation, centres = torch.from_numpy(self.rotations[instant]), torch.from_numpy(self.centres)
        turned = (points - centres[middle].to(points)) @ rotation.T.to(points)
        return turned + centres[instant].to(points)

    @property
    def total(self) -> float:
        """Return the angle between the two most different instants, degrees."""
        quats = Rotation.from_matrix(self.rotations[:: max(1, len(self.rotations) // 100)])
        return float(np.degrees(max((quats * one.inv()).magnitude().max() for one in quats)))


def turns_round(data: Dataset, normalisation: Normalisation) -> bool:
    """Return whether the subject of images with alpha turns as a whole."""
    windows = _windows(read_outlines(data, normalisation), len(data.times.unique()))
    return bool(windows) and _gain(windows, ROUGH)[0] >= LEAST


def find_body_turn(
    data: Dataset, normalisation: Normalisation, tell: Callable[[str], None] = lambda text: None
) -> BodyTurn | None:
    """Find the turn of the whole subject of images with alpha; None if it does not turn, or too little is known.

    Args:
        tell: gets what is being done, from time to time.

    Raises:
        UserError: an image is no longer readable.
    """
    times = data.times.double().unique().numpy()
    count, outlines = len(times), read_outlines(data, normalisation)
    windows = _windows(outlines, count)
    if not windows or _gain(windows, ROUGH)[0] < LEAST:
        return None
    turns = _gain(windows, FINE, tell)[1]
    middles = np.array(window_starts(count, WINDOW)) + 0.5 * (WINDOW - 1)
    centres = np.stack([window.centres.mean(0) for window in windows])
    centres = np.stack([np.interp(np.arange(count), middles, centres[:, axis]) for axis in range(3)], 1)
    radius = float(np.median([window.radius for window in windows]))
    long = [window_along(outlines, start, LONG, centres, radius) for start in window_starts(count, LONG)]
    rotations = integrated(at_instants(middles, _refined(long, middles, turns, count, tell), count))
    return BodyTurn(times, rotations @ rotations[count // 2].T, centres, radius)


def _windows(outlines: list[Outline], count: int) -> list[Window]:
    """Return the windows that cover ``count`` instants; none if there are too few or too many of them, or if one hardly
    shows the subject, or from one side only."""
    if not 2 * WINDOW <= count <= MOST_INSTANTS:
        return []
    windows = [steady_window(outlines, start, WINDOW) for start in window_starts(count, WINDOW)]
    shown = [window for window in windows if window is not None and window.one_sided <= ONE_SIDED]
    return shown if len(shown) == len(windows) else []


def _gain(
    windows: list[Window], step: float, tell: Callable[[str], None] = lambda text: None
) -> tuple[float, np.ndarray]:
    """Return the mean decrease of the logarithm of the unfilled share relative to no turn, and the turn per instant of
    each window [W, 3], for turns that are ``step`` degrees apart."""
    turns = tried_turns(FASTEST, step)
    costs = []
    for number, window in enumerate(windows):
        tell(f"turn of the subject, {number}/{len(windows)}")
        costs.append(np.log(unfilled(window, _steady(window, turns))))
    still = int(np.linalg.norm(turns, axis=1).argmin())
    chosen = steadiest([EVIDENCE * cost for cost in costs], turns)
    gain = np.mean([cost[still] - cost[index] for cost, index in zip(costs, chosen, strict=True)])
    return float(gain), turns[chosen]


def _refined(
    windows: list[Window], middles: np.ndarray, turns: np.ndarray, count: int, tell: Callable[[str], None]
) -> np.ndarray:
    """Improve turns per instant [W, 3] at ``middles``, step by step over long windows, in which errors add up."""
    turns = turns.copy()
    for step in np.radians(STEPS_OF_TURNS):
        for knot, middle in enumerate(middles):
            tell(f"turn of the subject, refined {knot}/{len(middles)}")
            near = [one for one in windows if abs(one.instants.mean() - middle) <= 0.5 * LONG]
            moves = step * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
            for _ in range(MOST_MOVES):
                tried = np.repeat(turns[None], len(moves), 0)
                tried[:, knot] += moves
                rotations = np.stack([integrated(at_instants(middles, each, count)) for each in tried], 1)
                cost = np.sum([np.log(unfilled(one, _about_middle(one, rotations))) for one in near], axis=0)
                best = int(cost.argmin())
                if best == 0:
                    break
                turns = tried[best]
    return turns


def _about_middle(window: Window, rotations: np.ndarray) -> np.ndarray:
    """Return rotations [V, H, 3, 3] from the view in the middle of a window to each, of those at all instants
    [T, H, 3, 3]."""
    here = rotations[window.instants]
    return here @ here[window.middle].transpose(0, 2, 1)


def _steady(window: Window, turns: np.ndarray) -> np.ndarray:
    """Return the rotations [V, H, 3, 3] of each view under turns [H, 3] that are constant in a window."""
    vectors = window.since[:, None, None] * turns
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def learn_turn(
    spheres: Spheres,
    points: Tensor,
    turn: BodyTurn,
    held: int,
    seed: int,
    tell: Callable[[str], None] = lambda text: None,
) -> None:
    """Train the network to carry ``points`` [P, 3] of the middle instant along the turn, in place.

    Args:
        held: number of first steps of stage 1 in which the network stays as it is: gradients of spheres that have not
            found their colours yet would undo the turn.
        tell: gets what is being done, from time to time.
    """
    random = generator(seed, Purpose.BODY_TURN)
    network = dict(spheres.network.named_parameters())
    optimizer = Adam(network, dict.fromkeys(network, RATE))
    for step in range(STEPS):
        if step % TELL_EVERY == 0:
            tell(f"turn learnt, {step:,}/{STEPS:,}")
        for group in optimizer.groups.values():
            group.rate = log_linear(RATE, RATE_END, step, STEPS)
        time = float(turn.times[int(torch.randint(len(turn.times), (1,), generator=random))])
        chosen = torch.randint(len(points), (POINTS,), generator=random)
        apart = BESIDE * turn.radius * torch.randn(POINTS, 3, generator=random)
        start = points[chosen.to(points.device)] + apart.to(points.device)
        moved = start + spheres.translations(start, torch.tensor([time]))[0]
        loss = (moved - turn.carry(start, time)).square().sum(1).mean() / turn.radius**2
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    optimizer.zero_grad()
    spheres.held = held
