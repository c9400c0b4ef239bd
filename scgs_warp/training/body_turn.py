"""Turn of the whole subject, found from its silhouettes.

Where the camera stands elsewhere at each instant, stage 1 learns how limbs move, but not that a dancer turns round:
spheres move no further than the images of single moments require. But three numbers describe the turn of a short window
of instants, so that many can be tried. Under the right one, the silhouettes of the window belong to one shape: its
visual hull fills each of them. Under a wrong one, hardly any place is inside all silhouettes, and the hull is too thin.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..data.dataset import Dataset, spread
from ..geometry.normalisation import Normalisation
from ..motion.spheres import Spheres
from ..optim import Adam, log_linear
from ..seeding import Purpose, generator
from .turn_windows import WINDOW, at_instants, integrated, steadiest, tried_turns, window_starts

SIZE = 48
"""Width in pixels to which silhouettes are reduced."""
INSIDE = 0.3
"""Covered share of a reduced pixel from which it belongs to the silhouette."""
ACROSS = 28
"""Number of places across the subject, along each axis, from which the hull is made."""
VIEWS = 24
"""Largest number of views of a window that are compared."""
OUTSIDE = 1 / 12
"""Share of a window's views in which a place of the hull may lie outside the silhouette: limbs move by themselves."""
FASTEST = 5.0
"""Largest turn per instant that is tried, degrees."""
ROUGH, FINE = 2.5, 1.0
"""Distances between tried turns, degrees per instant: to tell whether the subject turns, and by how much."""
EVIDENCE = 10.0
"""Weight of the logarithm of a window's unfilled share against changes of the turn (``turn_windows.steadiest``)."""
LEAST = 0.2
"""Mean decrease of this logarithm, relative to no turn, from which the subject is said to turn."""
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


class Outline(NamedTuple):
    """Silhouette of a training view."""

    instant: int
    viewmat: np.ndarray
    """[4, 4] world-to-camera, normalised."""
    K: np.ndarray
    """[3, 3] for the pixels of ``covered``."""
    covered: np.ndarray
    """[h, w] float32, covered share of each pixel."""

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Project points [..., 3]; return columns, rows (0 is the centre of the first pixel) and depths, [...] each."""
        x, y, depth = np.moveaxis(points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3], -1, 0)
        depth = np.maximum(depth, 1e-6)
        return self.K[0, 0] * x / depth + self.K[0, 2] - 0.5, self.K[1, 1] * y / depth + self.K[1, 2] - 0.5, depth

    def ray(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the centre of projection and the direction to the centroid of the silhouette, [3] each."""
        rows, columns = np.mgrid[: self.covered.shape[0], : self.covered.shape[1]] + 0.5
        total = max(float(self.covered.sum()), 1e-9)
        x, y = float((self.covered * columns).sum()) / total, float((self.covered * rows).sum()) / total
        direction = np.array([(x - self.K[0, 2]) / self.K[0, 0], (y - self.K[1, 2]) / self.K[1, 1], 1.0])
        direction = self.viewmat[:3, :3].T @ direction
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3], direction / np.linalg.norm(direction)


class Window(NamedTuple):
    """Some views, and where the subject is in them if it moves steadily."""

    outlines: list[Outline]
    since: np.ndarray
    """[V] instants since the middle of the window."""
    centre: np.ndarray
    """[3] at the middle."""
    speed: np.ndarray
    """[3] per instant."""
    radius: float


def turns_round(data: Dataset, normalisation: Normalisation) -> bool:
    """Return whether the subject of images with alpha turns as a whole."""
    windows = _windows(data, normalisation)
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
    windows = _windows(data, normalisation)
    if not windows or _gain(windows, ROUGH)[0] < LEAST:
        return None
    turns = _gain(windows, FINE, tell)[1]
    times = data.times.double().unique().numpy()
    count, middles = len(times), np.array(window_starts(len(times), WINDOW)) + 0.5 * (WINDOW - 1)
    rotations = integrated(at_instants(middles, turns, count))
    centres = np.stack([window.centre for window in windows])
    centres = np.stack([np.interp(np.arange(count), middles, centres[:, axis]) for axis in range(3)], 1)
    radius = float(np.median([window.radius for window in windows]))
    return BodyTurn(times, rotations @ rotations[count // 2].T, centres, radius)


def _gain(
    windows: list[Window], step: float, tell: Callable[[str], None] = lambda text: None
) -> tuple[float, np.ndarray]:
    """Return the mean decrease of the logarithm of the unfilled share relative to no turn, and the turn per instant of
    each window [W, 3], for turns that are ``step`` degrees apart."""
    turns = tried_turns(FASTEST, step)
    unfilled = []
    for number, window in enumerate(windows):
        tell(f"turn of the subject, {number}/{len(windows)}")
        unfilled.append(np.log(_unfilled(window, turns)))
    still = int(np.linalg.norm(turns, axis=1).argmin())
    chosen = steadiest([EVIDENCE * cost for cost in unfilled], turns)
    gain = np.mean([cost[still] - cost[index] for cost, index in zip(unfilled, chosen, strict=True)])
    return float(gain), turns[chosen]


def _windows(data: Dataset, normalisation: Normalisation) -> list[Window]:
    """Return the windows that cover all instants, ``STRIDE`` apart; none if there are too few or too many instants."""
    count = len(data.times.unique())
    if not 2 * WINDOW <= count <= MOST_INSTANTS:
        return []
    outlines = _outlines(data, normalisation)
    windows = []
    for start in window_starts(count, WINDOW):
        inside = [one for one in outlines if start <= one.instant < start + WINDOW and one.covered.any()]
        if len(inside) < WINDOW // 2:
            return []
        windows.append(_window([inside[index] for index in spread(len(inside), VIEWS)], start))
    return windows


def _outlines(data: Dataset, normalisation: Normalisation) -> list[Outline]:
    """Read the silhouettes of all frames with alpha, in the order of their instants."""
    times = data.times.double()
    instants = np.searchsorted(times.unique().numpy(), times.numpy())
    outlines = []
    for index in sorted(data.with_alpha, key=lambda index: instants[index]):
        frame = data[index]
        assert frame.alpha is not None
        camera = normalisation.apply_camera(frame.camera)
        share = SIZE / camera.width
        size = SIZE, max(1, round(camera.height * share))
        covered = cv2.resize(frame.alpha.numpy(), size, interpolation=cv2.INTER_AREA)
        K = np.diag([share, size[1] / camera.height, 1.0]) @ camera.K.double().numpy()
        outlines.append(Outline(int(instants[index]), camera.viewmat.double().numpy(), K, covered))
    return outlines


def _window(outlines: list[Outline], start: int) -> Window:
    """Place the subject so that it passes steadily through the rays to the centroids of the silhouettes."""
    since = np.array([one.instant for one in outlines]) - (start + 0.5 * (WINDOW - 1))
    matrix, right = 1e-6 * np.eye(6), np.zeros(6)
    for one, when in zip(outlines, since, strict=True):
        eye, direction = one.ray()
        across = np.eye(3) - np.outer(direction, direction)
        moving = np.hstack([np.eye(3), when * np.eye(3)])
        matrix += moving.T @ across @ moving
        right += moving.T @ across @ eye
    solved = np.linalg.solve(matrix, right)
    centre, speed = solved[:3], solved[3:]
    return Window(outlines, since, centre, speed, _radius(outlines, since, centre, speed))


def _radius(outlines: list[Outline], since: np.ndarray, centre: np.ndarray, speed: np.ndarray) -> float:
    """Return the median distance from the centre to the farthest pixel of a silhouette, normalised."""
    farthest = []
    for one, when in zip(outlines, since, strict=True):
        x, y, depth = one.project(centre + when * speed)
        rows, columns = np.nonzero(one.covered > INSIDE)
        pixels = np.hypot(columns - x, rows - y).max(initial=0.0)
        farthest.append(pixels * depth / one.K[0, 0])
    return float(np.median(farthest))


def _unfilled(window: Window, turns: np.ndarray) -> np.ndarray:
    """Return the share [H] of the silhouettes that the hull does not fill under each of ``turns`` [H, 3]."""
    axis = window.radius * np.linspace(-1.0, 1.0, ACROSS)
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    places = places[np.linalg.norm(places, axis=1) < window.radius]
    # The nearest view to the middle sees the hull under all turns alike.
    middle = int(np.abs(window.since).argmin())
    places = places[_looked_up(window, middle, places)[1]]
    pixels, inside = [], np.zeros((len(turns), len(places)), np.int32)
    for view, when in enumerate(window.since):
        rotations = Rotation.from_rotvec(when * turns).as_matrix()
        pixel, within = _looked_up(window, view, places @ rotations.transpose(0, 2, 1))
        pixels.append(pixel)
        inside += within
    hull = inside >= len(pixels) - int(OUTSIDE * len(pixels))
    filled = np.zeros(len(turns))
    for one, pixel in zip(window.outlines, pixels, strict=True):
        filled += _filled(one.covered, pixel, hull)
    total = sum(float(one.covered.sum()) for one in window.outlines)
    return np.maximum(1.0 - filled / total, 1e-4)


def _looked_up(window: Window, view: int, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Look up places by their offsets [..., 3] from the centre; return the index of their pixel and whether it is
    inside the silhouette, [...]."""
    one = window.outlines[view]
    x, y, _ = one.project(offsets + window.centre + window.since[view] * window.speed)
    height, width = one.covered.shape
    column, row = np.rint(x).astype(np.int32), np.rint(y).astype(np.int32)
    shown = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = row.clip(0, height - 1) * width + column.clip(0, width - 1)
    return pixel, shown & (one.covered.reshape(-1)[pixel] > INSIDE)


def _filled(covered: np.ndarray, pixel: np.ndarray, hull: np.ndarray) -> np.ndarray:
    """Sum the silhouette over the pixels at and beside places of the hull, [H].

    Args:
        pixel: [H, n] pixel of each place.
        hull: [H, n] bool, the places that belong to the hull.
    """
    height, width = covered.shape
    shown = np.zeros((len(hull), height * width), np.uint8)
    which, place = np.nonzero(hull)
    shown[which, pixel[which, place]] = 1
    # An empty row and column beside each picture keeps the pictures of a stack apart.
    stack = np.pad(shown.reshape(-1, height, width), ((0, 0), (0, 1), (0, 1))).reshape(-1, width + 1)
    wide = cv2.dilate(stack, np.ones((3, 3), np.uint8)).reshape(-1, height + 1, width + 1)
    return (wide[:, :height, :width] * covered).sum((1, 2), dtype=np.float64)


def learn_turn(
    spheres: Spheres, points: Tensor, turn: BodyTurn, seed: int, tell: Callable[[str], None] = lambda text: None
) -> None:
    """Train the network to carry ``points`` [P, 3] of the middle instant along the turn, in place.

    Args:
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
    spheres.led = True
