"""Pictures for checking a capture before training: a contact sheet of the picked frames, and a plot of the cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..data.dataset import spread
from ..storage.png_files import write_png
from .writing import CapturedScene

MAX_PICTURES = 48
"""Largest number of frames on the sheet."""
COLUMNS = 8
CELL = 200
"""Width of a frame on the sheet, pixels."""
CAPTION = 18
GAP = 4
MOVING = (255, 60, 40)
"""Tint of masked pixels."""
STRUCK_OUT = (200, 30, 30)
MAX_POINTS = 6000
MAX_FRUSTA = 60


def sheet(
    path: Path,
    load: Callable[[int], tuple[np.ndarray, np.ndarray | None]],
    captions: Sequence[str],
    registered: set[int],
) -> None:
    """Write the contact sheet: frames in order of time, masked pixels tinted, and frames without a camera struck out.

    Args:
        load: function from the number of a picked frame to its image [H, W, 3] uint8 and mask [H, W] bool or None.
        captions: text below each picked frame.
        registered: numbers of the frames with a camera.
    """
    count = len(captions)
    shown = spread(count, MAX_PICTURES)
    cells = [_cell(*load(k), _caption(captions[k], k in registered), k in registered) for k in shown]
    height, width = max(len(cell) for cell in cells), CELL  # cameras of a rig may be held upright or not
    columns = min(COLUMNS, len(cells))
    rows = -(-len(cells) // columns)
    canvas = np.full((GAP + rows * (height + GAP), GAP + columns * (width + GAP), 3), 255, np.uint8)
    for position, cell in enumerate(cells):
        top, left = GAP + position // columns * (height + GAP), GAP + position % columns * (width + GAP)
        canvas[top : top + len(cell), left : left + width] = cell
    write_png(path, canvas)


def _caption(text: str, registered: bool) -> str:
    return text if registered else f"{text}, no camera"


def _cell(image: np.ndarray, mask: np.ndarray | None, text: str, registered: bool) -> np.ndarray:
    size = (CELL, max(1, round(image.shape[0] * CELL / image.shape[1])))
    picture = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if mask is not None:
        hidden = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
        picture[hidden] = (picture[hidden] // 2 + np.array(MOVING) // 2).astype(np.uint8)
    if not registered:
        cv2.line(picture, (0, 0), (size[0] - 1, size[1] - 1), STRUCK_OUT, 2, cv2.LINE_AA)
    cell = np.full((size[1] + CAPTION, CELL, 3), 255, np.uint8)
    cell[: size[1]] = picture
    color = (40, 40, 40) if registered else STRUCK_OUT
    cv2.putText(cell, text, (3, size[1] + 13), cv2.FONT_HERSHEY_SIMPLEX, 0.4, color, 1, cv2.LINE_AA)
    return cell


def cameras(path: Path, scene: CapturedScene) -> None:
    """Plot the scene from above and from the side: points in their colours, cameras coloured by time."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6.2), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    frusta = _frusta(scene)
    some = slice(None, None, max(1, len(scene.points) // MAX_POINTS))
    points, colors = scene.points[some], scene.colors[some] / 255.0
    places = frusta[:, 0, 0]
    low, high = _window(points, places)
    lines: Any = None
    for axes, (a, b), title in zip(figure.subplots(1, 2), ((0, 1), (1, 2)), ("from above", "from the side")):
        axes.scatter(points[:, a], points[:, b], s=2, c=colors, linewidths=0)
        every = max(1, len(frusta) // MAX_FRUSTA)
        chosen = frusta[::every]
        edges = chosen[..., [a, b]].reshape(-1, *chosen.shape[2:3], 2)
        lines = LineCollection(list(edges), cmap="plasma", linewidths=0.9)
        lines.set_array(np.repeat(np.array(scene.seconds)[::every], chosen.shape[1]))
        axes.add_collection(lines)
        axes.plot(places[:, a], places[:, b], color="0.4", linewidth=0.6)
        axes.set(xlim=(low[a], high[a]), ylim=(low[b], high[b]), aspect="equal", title=title)
        axes.set(xlabel="xyz"[a], ylabel="xyz"[b])
    figure.colorbar(lines, ax=figure.axes, label="second of the video", shrink=0.8)
    figure.suptitle(f"{len(places)} cameras, {len(scene.points):,} points")
    figure.savefig(path, metadata={"Software": None})


def _frusta(scene: CapturedScene) -> np.ndarray:
    """Return polylines [V, 5, 4, 3] of the cameras: each of the four sides starts and ends at the camera's centre, and
    the fifth joins the corners of the image plane."""
    p = scene.pinhole
    reach = 0.25
    corners = np.array([[0, 0], [p.width, 0], [p.width, p.height], [0, p.height]], np.float64)
    rays = np.concatenate([(corners - (p.cx, p.cy)) / (p.fx, p.fy), np.ones((4, 1))], 1) * reach
    lines = []
    for viewmat in scene.viewmats:
        rotation = viewmat[:3, :3].T
        centre = -rotation @ viewmat[:3, 3]
        ends = rays @ rotation.T + centre
        sides = [np.stack([centre, ends[k], ends[(k + 1) % 4], centre]) for k in range(4)]
        lines.append(np.stack([*sides, ends]))
    return np.stack(lines)


def _window(points: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the plotted range, which covers all cameras, and the points without outliers."""
    if len(points):
        near, far = np.quantile(points, [0.02, 0.98], axis=0)
        points = points[((points >= near) & (points <= far)).all(1)]
    both = np.concatenate([places, points])
    low, high = both.min(0), both.max(0)
    margin = 0.08 * max(float((high - low).max()), 1e-6)
    return low - margin, high + margin
