"""Figures of a run: contact sheets of truth, render and error, and curves of the log."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import UserError
from ..storage.files import read_text, write_atomically
from ..storage.json_files import as_number, parse_json

AXIS_FIELDS, MAX_AXIS_VALUE = ("step", "seconds"), 1e9
"""Fields that place a log line on the axes, and their largest valid value."""
ERROR_RANGE = 0.2
"""Mean absolute error over the channels at which an error map reaches its brightest colour."""
CAPTION = 22
"""Height of a caption in pixels."""
GAP = 4
PAPER = (255, 255, 255)
INK = (30, 30, 30)
NEUTRAL = 0.5
"""Grey behind pictures with alpha."""
SOLID, MARGIN = 0.05, 0.04
"""Alpha from which a pixel belongs to the content, and the margin around the content as a share of the longer side."""

Picture = Tensor | np.ndarray


def to_bytes(image: Picture) -> np.ndarray:
    """Convert floats [H, W, 3] or [H, W], clamped to [0, 1], to uint8 on the CPU; NaN becomes 0."""
    tensor = image.detach() if isinstance(image, Tensor) else torch.from_numpy(np.ascontiguousarray(image))
    scaled = tensor.float().nan_to_num(0.0, 1.0, 0.0).mul_(255.0).add_(0.5).clamp_(0.0, 255.0)
    return scaled.to(torch.uint8).cpu().contiguous().numpy()


def _floats(image: Picture) -> np.ndarray:
    if isinstance(image, Tensor):
        image = image.detach().cpu().numpy()
    return np.nan_to_num(image.astype(np.float32) / (255.0 if image.dtype == np.uint8 else 1.0)).clip(0.0, 1.0)


def error_map(truth: Picture, render: Picture) -> np.ndarray:
    """Map the absolute error, averaged over the channels, to inferno's colours, [H, W, 3] uint8; black is 0."""
    import cv2

    error = np.abs(_floats(truth) - _floats(render)).mean(-1) / ERROR_RANGE
    return cv2.applyColorMap(to_bytes(error), cv2.COLORMAP_INFERNO)[..., ::-1]


def alpha_map(truth: Picture, render: Picture) -> np.ndarray:
    """Show two alphas [H, W] as one picture [H, W, 3] uint8: white where both cover, red where the render misses the
    truth, blue where it covers more."""
    true, rendered = _floats(truth), _floats(render)
    return to_bytes(np.stack([true, np.minimum(true, rendered), rendered], axis=-1))


def psnr_of(truth: Picture, render: Picture) -> float:
    """Compute the peak signal-to-noise ratio of clamped floats, in dB; infinite for equal images."""
    error = float(np.square(_floats(truth).astype(np.float64) - _floats(render)).mean())
    return -10.0 * math.log10(error) if error > 0 else math.inf


def _put_text(canvas: np.ndarray, text: str, x: int, y: int, width: int) -> None:
    """Write text in a box ``width`` pixels wide and ``CAPTION`` high, reduced to fit."""
    import cv2

    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.45
    needed = cv2.getTextSize(text, font, scale, 1)[0][0]
    scale = min(scale, scale * (width - 4) / max(needed, 1))
    cv2.putText(canvas, text, (x + 2, y + CAPTION - 7), font, scale, INK, 1, cv2.LINE_AA)


def _reduced(image: np.ndarray, width: int, height: int) -> tuple[int, int]:
    """Return the width and height of a picture that is reduced to fit into a cell but never enlarged."""
    scale = min(1.0, width / image.shape[1], height / image.shape[0])
    return max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))


def _fit(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Centre the picture in a cell, reduced to fit but never enlarged."""
    import cv2

    size = _reduced(image, width, height)
    if size != (image.shape[1], image.shape[0]):
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    cell = np.full((height, width, 3), PAPER, np.uint8)
    top, left = (height - image.shape[0]) // 2, (width - image.shape[1]) // 2
    cell[top : top + image.shape[0], left : left + image.shape[1]] = image
    return cell


def _content(pair: tuple[Picture, Picture]) -> tuple[slice, slice]:
    """Return the rows and columns of what either alpha covers, with a margin; all of them if nothing is covered."""
    solid = np.maximum(*map(_floats, pair)) > SOLID
    margin, spans = math.ceil(MARGIN * max(solid.shape)), []
    for axis in (1, 0):
        found = np.flatnonzero(solid.any(axis))
        low, high = (found[0], found[-1]) if len(found) else (0, solid.shape[1 - axis])
        spans.append(slice(max(0, int(low) - margin), int(high) + 1 + margin))
    return spans[0], spans[1]


def _pictures(
    truth: Picture, render: Picture, pair: tuple[Picture, Picture] | None, background: Sequence[float] | None
) -> list[np.ndarray]:
    """Return truth, render, error and, where there is alpha, alpha, cropped to the content and on a neutral
    background."""
    shown, error = [_floats(truth), _floats(render)], error_map(truth, render)
    if pair is None:
        return [*map(to_bytes, shown), error]
    if background is not None:
        change = NEUTRAL - np.asarray(background, np.float32)
        shown = [image + (1.0 - _floats(alpha))[..., None] * change for image, alpha in zip(shown, pair)]
    box = _content(pair)
    return [picture[box] for picture in (*map(to_bytes, shown), error, alpha_map(*pair))]


def contact_sheet(
    rows: Sequence[tuple[Picture, Picture]],
    titles: Sequence[str] = (),
    *,
    scores: Sequence[float] = (),
    alphas: Sequence[tuple[Picture, Picture] | None] = (),
    background: Sequence[float] | None = None,
    cell: int = 400,
) -> np.ndarray:
    """Draw truth, render and error side by side, one row per pair. Rows with alpha are cropped to their content, on a
    neutral background, with the alpha beside them.

    Args:
        rows: (truth, render), each [H, W, 3]: floats in [0, 1] or uint8; the two of a row have one size.
        titles: a caption for each row; may be shorter than ``rows``.
        scores: PSNR of each row, dB, if it differs from that of the two pictures because of masks.
        alphas: (truth, render) of each row, each [H, W]; None for a row without alpha.
        background: colour on which rows with alpha were composited; None: it is kept.
        cell: longest side of a picture on the sheet, pixels. Errors are computed before the reduction.

    Returns:
        [height, width, 3] uint8 RGB.

    Raises:
        ValueError: there are no rows, or truth and render differ in size.
    """
    if not rows:
        raise ValueError("rows is empty; a contact sheet needs at least one pair of images")
    for truth, render in rows:
        if truth.shape != render.shape or truth.ndim != 3:
            raise ValueError(f"truth {list(truth.shape)} and render {list(render.shape)} must both be [H, W, 3]")
    pairs = [alphas[index] if index < len(alphas) else None for index in range(len(rows))]
    drawn = [_pictures(truth, render, pair, background) for (truth, render), pair in zip(rows, pairs)]
    sizes = [_reduced(pictures[0], cell, cell) for pictures in drawn]
    width, height = max(size[0] for size in sizes), max(size[1] for size in sizes)
    heads = ["truth", "render", f"error (0 .. {ERROR_RANGE:g})"]
    if any(pair is not None for pair in pairs):
        heads.append("alpha: red missing, blue extra")
    size = CAPTION + len(rows) * (height + CAPTION + GAP), len(heads) * (width + GAP) + GAP
    sheet = np.full((*size, 3), PAPER, np.uint8)
    columns = [GAP + column * (width + GAP) for column in range(len(heads))]
    for x, text in zip(columns, heads):
        _put_text(sheet, text, x, 0, width)
    for index, (truth, render) in enumerate(rows):
        y = CAPTION + index * (height + CAPTION + GAP)
        for x, picture in zip(columns, drawn[index]):
            sheet[y : y + height, x : x + width] = _fit(picture, width, height)
        score = scores[index] if index < len(scores) else psnr_of(truth, render)
        captions = (titles[index] if index < len(titles) else "", "", f"PSNR {score:.2f} dB")
        for x, text in zip(columns, captions):
            _put_text(sheet, text, x, y + height, width)
    return sheet


def read_log(path: str | Path) -> list[dict[str, Any]]:
    """Read the lines of a run's ``log.jsonl``; skip malformed lines, such as one truncated when a run was killed.

    Raises:
        UserError: the file cannot be read.
    """
    try:
        text = read_text(path, errors="replace")
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); give the folder of a run") from None
    lines = []
    for line in text.splitlines():
        try:
            value = parse_json(line)
        except ValueError:
            continue
        if isinstance(value, dict) and all(_is_axis_value(value.get(key)) for key in AXIS_FIELDS):
            lines.append(value)
    return lines


def _is_axis_value(value: Any) -> bool:
    """Return whether a field is missing or a valid number."""
    return value is None or (as_number(value) is not None and 0 <= value <= MAX_AXIS_VALUE)


def axis_positions(lines: list[dict[str, Any]]) -> tuple[dict[tuple[str, int], float], list[tuple[str, float]]]:
    """Place each (stage, step) on one axis, stage after stage; return the positions and the start of each stage."""
    steps: dict[str, list[int]] = {}
    for line in lines:
        if as_number(line.get("step")) is not None:
            steps.setdefault(str(line.get("stage", "")), []).append(int(line["step"]))
    positions, starts, end = {}, [], 0.0
    for stage, stage_steps in steps.items():
        # A stage that counts from zero again follows the previous one.
        offset = end if min(stage_steps) < end else 0.0
        starts.append((stage, offset + min(stage_steps)))
        positions.update({(stage, step): step + offset for step in stage_steps})
        end = max(end, offset + max(stage_steps))
    return positions, starts


def series_of(lines: list[dict[str, Any]], key: str, positions: dict[tuple[str, int], float]) -> dict[float, float]:
    """Return position -> value in ascending order; of several lines for a step (a resumed run), the last one counts."""
    series = {}
    for line in lines:
        value = as_number(line.get(key))
        if value is not None and as_number(line.get("step")) is not None:
            series[positions[str(line.get("stage", "")), int(line["step"])]] = value
    return dict(sorted(series.items()))


def curves(log_path: str | Path, out_png: str | Path) -> None:
    """Draw PSNR, loss and the number of Gaussians over the steps of a run.

    Args:
        log_path: ``log.jsonl``: JSON objects with ``step`` and some of ``stage``, ``psnr``, ``test_psnr``, ``loss``,
            ``l1``, ``ssim``, ``gaussians``; missing fields are not drawn.
        out_png: path of the picture.

    Raises:
        UserError: the log cannot be read, or the picture cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # Needs neither a display nor a global backend.
    from matplotlib.figure import Figure

    lines = read_log(log_path)
    stage = ""
    for line in lines:  # A line without a stage (an evaluation) belongs to the stage of the lines before it.
        stage = line["stage"] = str(line.get("stage", stage))
    positions, starts = axis_positions(lines)
    panels = (
        ("PSNR [dB]", (("psnr", "train", "-"), ("test_psnr", "test", "o-"))),
        ("loss", (("loss", "loss", "-"), ("l1", "L1", "-"))),
        ("Gaussians", (("gaussians", "Gaussians", "-"),)),
    )
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    for column, (title, series) in enumerate(panels):
        axes = figure.add_subplot(1, len(panels), column + 1, sharex=figure.axes[0] if column else None)
        axes.set_title(title)
        axes.set_xlabel("step")
        axes.grid(alpha=0.3)
        for key, label, style in series:
            points = series_of(lines, key, positions)
            if points:
                axes.plot(list(points), list(points.values()), style, label=label, markersize=3, linewidth=1.2)
        drawn = len(axes.lines)
        if title == "loss" and any(np.max(line.get_ydata()) > 0 for line in axes.lines):
            axes.set_yscale("log", nonpositive="mask")
            if any(np.min(line.get_ydata()) < 0 for line in axes.lines):  # It has a logarithm (``loss.log_error``).
                axes.set_title("loss, where it is positive")
        for _, start in starts[1:]:
            axes.axvline(start, color="0.6", linestyle=":", linewidth=1)
        if drawn and len(series) > 1:
            axes.legend(frameon=False)
    FigureCanvasAgg(figure)
    picture = io.BytesIO()
    figure.savefig(picture, dpi=110, format="png")
    write_atomically(Path(out_png), picture.getvalue())
