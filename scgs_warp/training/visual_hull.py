"""Visual hulls of a subject that turns: the places that are inside the silhouettes of a window of instants."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from ..data.dataset import Dataset, spread
from ..geometry.normalisation import Normalisation
from .turn_views import project

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
        """Project points [..., 3] (``turn_views.project``)."""
        return project(self.viewmat, self.K, points)

    def ray(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the centre of projection and the direction to the centroid of the silhouette, [3] each."""
        rows, columns = np.mgrid[: self.covered.shape[0], : self.covered.shape[1]] + 0.5
        total = max(float(self.covered.sum()), 1e-9)
        x, y = float((self.covered * columns).sum()) / total, float((self.covered * rows).sum()) / total
        direction = np.array([(x - self.K[0, 2]) / self.K[0, 0], (y - self.K[1, 2]) / self.K[1, 1], 1.0])
        direction = self.viewmat[:3, :3].T @ direction
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3], direction / np.linalg.norm(direction)


class Window(NamedTuple):
    """Some views of neighbouring instants, and where the subject is in them."""

    outlines: list[Outline]
    since: np.ndarray
    """[V] instants since the middle of the window."""
    centres: np.ndarray
    """[V, 3] the subject's centre in each view."""
    radius: float

    @property
    def instants(self) -> np.ndarray:
        """[V] instant of each view."""
        return np.array([one.instant for one in self.outlines])

    @property
    def one_sided(self) -> float:
        """Length of the mean of the unit vectors from the subject to the cameras: 1 if all stand in one direction."""
        towards = np.stack([one.ray()[0] for one in self.outlines]) - self.centres
        return float(np.linalg.norm((towards / np.linalg.norm(towards, axis=1, keepdims=True)).mean(0)))

    @property
    def middle(self) -> int:
        """Index of the view nearest to the middle of the window."""
        return int(np.abs(self.since).argmin())


def read_outlines(data: Dataset, normalisation: Normalisation) -> list[Outline]:
    """Read the silhouettes that are not empty, in the order of their instants.

    Raises:
        UserError: an image is no longer readable.
    """
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
        if covered.any():
            outlines.append(Outline(int(instants[index]), camera.viewmat.double().numpy(), K, covered))
    return outlines


def _between(outlines: list[Outline], start: int, length: int) -> tuple[list[Outline], np.ndarray]:
    """Return at most ``VIEWS`` outlines of ``length`` instants from ``start`` on, and when each is, [V]."""
    inside = [one for one in outlines if start <= one.instant < start + length]
    inside = [inside[index] for index in spread(len(inside), VIEWS)]
    return inside, np.array([one.instant for one in inside]) - (start + 0.5 * (length - 1))


def steady_window(outlines: list[Outline], start: int, length: int) -> Window | None:
    """Make a window of ``length`` instants in which the subject passes steadily through the rays to the centroids of
    its silhouettes; None if fewer than half of the instants show it."""
    inside, since = _between(outlines, start, length)
    if len(inside) < length // 2:
        return None
    matrix, right = 1e-6 * np.eye(6), np.zeros(6)
    for one, when in zip(inside, since, strict=True):
        eye, direction = one.ray()
        across = np.eye(3) - np.outer(direction, direction)
        moving = np.hstack([np.eye(3), when * np.eye(3)])
        matrix += moving.T @ across @ moving
        right += moving.T @ across @ eye
    solved = np.linalg.solve(matrix, right)
    centres = solved[:3] + since[:, None] * solved[3:]
    return Window(inside, since, centres, _radius(inside, centres))


def window_along(outlines: list[Outline], start: int, length: int, centres: np.ndarray, radius: float) -> Window:
    """Make a window of ``length`` instants from the centres at all instants, [T, 3]."""
    inside, since = _between(outlines, start, length)
    return Window(inside, since, centres[[one.instant for one in inside]], radius)


def _radius(outlines: list[Outline], centres: np.ndarray) -> float:
    """Return the median distance from the centre to the farthest pixel of a silhouette, normalised."""
    farthest = []
    for one, centre in zip(outlines, centres, strict=True):
        x, y, depth = one.project(centre)
        rows, columns = np.nonzero(one.covered > INSIDE)
        pixels = np.hypot(columns - x, rows - y).max(initial=0.0)
        farthest.append(pixels * depth / one.K[0, 0])
    return float(np.median(farthest))


def unfilled(window: Window, rotations: np.ndarray) -> np.ndarray:
    """Return the share [H] of the silhouettes that the hull does not fill under each of ``rotations`` [V, H, 3, 3]."""
    axis = window.radius * np.linspace(-1.0, 1.0, ACROSS)
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    places = places[np.linalg.norm(places, axis=1) < window.radius]
    # The view nearest to the middle sees the hull alike under all rotations.
    places = places[_looked_up(window, window.middle, places)[1]]
    pixels, inside = [], np.zeros((rotations.shape[1], len(places)), np.int32)
    for view, turned in enumerate(rotations):
        pixel, within = _looked_up(window, view, places @ turned.transpose(0, 2, 1))
        pixels.append(pixel)
        inside += within
    hull = inside >= len(pixels) - int(OUTSIDE * len(pixels))
    filled = np.zeros(rotations.shape[1])
    for one, pixel in zip(window.outlines, pixels, strict=True):
        filled += _filled(one.covered, pixel, hull)
    total = sum(float(one.covered.sum()) for one in window.outlines)
    return np.maximum(1.0 - filled / total, 1e-4)


def _looked_up(window: Window, view: int, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Look up places by their offsets [..., 3] from the centre; return the index of their pixel and whether it is
    inside the silhouette, [...]."""
    one = window.outlines[view]
    x, y, _ = one.project(offsets + window.centres[view])
    height, width = one.covered.shape
    column, row = np.rint(x.clip(-1, width)).astype(np.int32), np.rint(y.clip(-1, height)).astype(np.int32)
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
