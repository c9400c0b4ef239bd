"""Opacity of thin rods along their length, for data sets that store the axes of their rods.

Every rod is cut into tenths. The alpha of the render and of the truth are summed over the silhouette of a tenth,
widened by two pixels: a rod that is blurred or a little displaced keeps its sum, one that is transparent, broken or
swollen does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from ..errors import UserError
from ..storage.numpy_files import read_npy
from ..types import Camera, Frame

FILE = "rods.npz"
TENTHS = 10
WIDENED = 2.0
"""Distance in pixels by which the silhouette of a tenth is widened."""
TOLERANCE = 0.1
"""Largest relative difference between the sums of a tenth that counts as sound."""
VISIBLE, DOMINANT = 0.5, 1 / 3
"""A tenth counts if the true sum is at least ``VISIBLE`` times the area of its own silhouette (less: it leaves the
image), and its own area at least ``DOMINANT`` times the true sum (less: other parts are in front of it or beside it,
and would hide its loss)."""
SHORTEST, LONGEST = 1e-9, 1e6
"""Bounds of lengths; others count as damaged."""


@dataclass(frozen=True)
class Rods:
    """Axes of all rods at the times of the pictures of a split, world units. Rods have round ends."""

    names: tuple[str, ...]
    radii: np.ndarray
    """[R] float64."""
    ends: np.ndarray
    """[V, R, 2, 3] float64, end points of the axes, in the order of the pictures."""


class Segment(NamedTuple):
    """A tenth of a rod in one image."""

    rod: int
    tenth: int
    """0 to 9, from the first end of the rod."""
    ratio: float
    """Rendered sum of alpha over the true one."""


def load_rods(folder: str | Path, split: str, count: int) -> Rods | None:
    """Read the axes of the rods of a data set; None without them.

    Args:
        count: number of pictures of the split.

    Raises:
        UserError: the file is damaged, or does not fit the split.
    """
    path = Path(folder) / FILE
    if not path.is_file():
        return None
    names, radii, ends = read_npy(path, "names", "texts"), read_npy(path, "radii"), read_npy(path, f"{split}_ends")
    if names.ndim != 1 or radii.shape != names.shape or ends.shape != (count, len(names), 2, 3):
        raise UserError(
            f"{path}: names {names.shape}, radii {radii.shape} and {split}_ends {ends.shape} must be [R], [R] and "
            f"[{count}, R, 2, 3]; make the data set again"
        )
    if not ((radii > SHORTEST) & (radii < LONGEST)).all() or not (np.abs(ends) < LONGEST).all():
        raise UserError(f"{path}: radii must be positive and {split}_ends finite; make the data set again")
    return Rods(tuple(map(str, names.tolist())), radii, ends)


class RodCheck:
    """Collects the tenths of all images of a split."""

    def __init__(self, rods: Rods) -> None:
        self.rods = rods
        self.rows: list[tuple[str, float, Segment]] = []
        """Name and time of the image, and the tenth."""

    def add(self, index: int, frame: Frame, alpha: Tensor) -> None:
        """Measure the rods in one image.

        Args:
            index: index of the frame in its split.
            alpha: [H, W] rendered alpha.
        """
        if frame.alpha is None:
            return
        truth, rendered = frame.alpha.cpu().double().numpy(), alpha.cpu().double().numpy()
        known = np.ones(truth.shape, bool) if frame.mask is None else frame.mask.cpu().numpy()
        found = measure(rendered, truth, known, frame.camera, self.rods.ends[index], self.rods.radii)
        self.rows += [(frame.name, float(frame.time), segment) for segment in found]

    def summary(self) -> dict[str, Any]:
        """Return ``rods_within``, the share of the tenths whose ratio is at most ``TOLERANCE`` from 1 (None without
        any), ``rods_segments``, the number of tenths, and ``rods_worst``: ``rod``, ``tenth`` (1 to 10), ``name`` and
        ``time`` of the image, and ``ratio``."""
        if not self.rows:
            return {"rods_within": None, "rods_segments": 0, "rods_worst": None}
        errors = [abs(segment.ratio - 1.0) for *_, segment in self.rows]
        name, time, worst = self.rows[int(np.argmax(errors))]
        return {
            "rods_within": float(np.mean([error <= TOLERANCE for error in errors])),
            "rods_segments": len(self.rows),
            "rods_worst": {
                "rod": self.rods.names[worst.rod],
                "tenth": worst.tenth + 1,
                "name": name,
                "time": time,
                "ratio": worst.ratio,
            },
        }


def measure(
    rendered: np.ndarray,
    truth: np.ndarray,
    known: np.ndarray,
    camera: Camera,
    ends: np.ndarray,
    radii: np.ndarray,
) -> list[Segment]:
    """Compare the alpha of all tenths that lie in the image, on known pixels and apart from other parts.

    Args:
        rendered: [H, W] float64.
        truth: [H, W] float64.
        known: [H, W] bool, pixels at which the truth is known.
        ends: [R, 2, 3] end points of the axes, world.
        radii: [R] world.
    """
    viewmat, K = camera.viewmat.cpu().double().numpy(), camera.K.cpu().double().numpy()
    shares = np.linspace(0.0, 1.0, TENTHS + 1)[:, None]
    found = []
    for rod, (start, end) in enumerate(ends):
        points = (start + shares * (end - start)) @ viewmat[:3, :3].T + viewmat[:3, 3]
        depths = points[:, 2]
        if depths.min() <= radii[rod]:
            continue
        places = points @ K.T
        places = places[:, :2] / places[:, 2:]
        widths = 0.5 * (K[0, 0] + K[1, 1]) * radii[rod] / depths
        found += _tenths_of_rod(rod, rendered, truth, known, places, widths)
    return found


def _tenths_of_rod(
    rod: int,
    rendered: np.ndarray,
    truth: np.ndarray,
    known: np.ndarray,
    places: np.ndarray,
    widths: np.ndarray,
) -> list[Segment]:
    """Compare the tenths of a rod, whose axis passes through the pixels ``places`` [11, 2] and whose radius there is
    ``widths`` [11], pixels."""
    height, width = truth.shape
    reach = 0.5 * (widths[1:] + widths[:-1]) + WIDENED
    low = np.floor(np.minimum(places[1:], places[:-1]) - reach[:, None])
    high = np.ceil(np.maximum(places[1:], places[:-1]) + reach[:, None])
    inside = (low >= 0).all(1) & (high <= (width, height)).all(1)
    lengths = np.hypot(*np.diff(places, axis=0).T)
    found = []
    for tenth in np.flatnonzero(inside).tolist():
        (left, top), (right, bottom) = low[tenth].astype(int), high[tenth].astype(int)
        window = slice(top, bottom), slice(left, right)
        mask = _near(window, places[tenth], places[tenth + 1], float(reach[tenth]))
        true = float(truth[window][mask].sum())
        least, most = _own_area(lengths, widths, tenth, float(reach[tenth]))
        if VISIBLE * least <= true <= most / DOMINANT and known[window][mask].all():
            found.append(Segment(rod, tenth, float(rendered[window][mask].sum()) / true))
    return found


def _near(window: tuple[slice, slice], start: np.ndarray, end: np.ndarray, reach: float) -> np.ndarray:
    """Return a mask of the pixels of a window that are within ``reach`` of a line segment."""
    rows, columns = window
    y = np.arange(rows.start, rows.stop)[:, None] + (0.5 - start[1])
    x = np.arange(columns.start, columns.stop) + (0.5 - start[0])
    along_x, along_y = (end - start).tolist()
    length = max(along_x * along_x + along_y * along_y, 1e-12)
    share = np.minimum(np.maximum((x * along_x + y * along_y) / length, 0.0), 1.0)
    off_x, off_y = x - share * along_x, y - share * along_y
    return off_x * off_x + off_y * off_y <= reach * reach


def _own_area(lengths: np.ndarray, widths: np.ndarray, tenth: int, reach: float) -> tuple[float, float]:
    """Return the area in pixels of the rod's own silhouette within ``reach`` of a tenth, and that of a rod which
    continues in another one at both ends."""
    before = min(reach, float(lengths[:tenth].sum() + widths[0]))
    after = min(reach, float(lengths[tenth + 1 :].sum() + widths[-1]))
    width = float(widths[tenth] + widths[tenth + 1])
    return (before + lengths[tenth] + after) * width, (2.0 * reach + lengths[tenth]) * width
