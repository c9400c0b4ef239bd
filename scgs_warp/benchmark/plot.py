"""Figures of sweeps: milliseconds over the swept quantity, both logarithmic; measured times solid, limits dashed."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from PIL import Image as PillowImage

from ..errors import UserError

LABELS = {
    "gaussians": "Gaussians",
    "resolution": "side of the image in pixels",
    "nodes": "control points",
    "threads": "threads",
}
COLORS = {
    "frame": "#111111",
    "frame/network": "#0072b2",
    "frame/skin": "#56b4e9",
    "frame/project": "#009e73",
    "frame/harmonics": "#e69f00",
    "frame/bin": "#cc79a7",
    "frame/composite": "#d55e00",
    "raster/both": "#888888",
}
"""Lines of a figure, in colours that colour-blind readers can tell apart (Okabe and Ito)."""
SIZE = (7.2, 4.6)
DPI = 110


def draw(report: dict[str, Any], folder: Path) -> list[Path]:
    """Draw one small PNG for each sweep, ``scaling-NAME.png``.

    Args:
        report: Result of :func:`scgs_warp.benchmark.scaling.scaling`.
        folder: Made if it is missing.

    Raises:
        UserError: the folder cannot be written.
    """
    written = []
    for name, entries in report["sweeps"].items():
        path = folder / f"scaling-{name}.png"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.write_bytes(_picture(name, entries, report))
        except OSError as error:
            raise UserError(f"--figures {folder}: cannot be written ({error.strerror}); name another folder") from error
        written.append(path)
    return written


def series(entries: list[dict[str, Any]], row_name: str) -> tuple[list[int], list[float], list[float]]:
    """Return points, medians and limits of one line, without points that lack the row; limits may be empty."""
    points, medians, limits = [], [], []
    for entry in entries:
        for row in entry["rows"]:
            if row["name"] == row_name:
                points.append(entry["point"])
                medians.append(row["ms_median"])
                if entry["limits"] is not None and row_name in entry["limits"]:
                    limits.append(entry["limits"][row_name])
    return points, medians, limits


def _picture(name: str, entries: list[dict[str, Any]], report: dict[str, Any]) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import FuncFormatter, NullLocator

    figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    handles = []
    for row_name, color in COLORS.items():
        points, medians, limits = series(entries, row_name)
        if not points:
            continue
        whole = row_name in ("frame", "raster/both")
        label = {"frame": "whole frame", "raster/both": "raster, all gradients"}.get(row_name, row_name[6:])
        axes.plot(points, medians, color=color, linewidth=2.4 if whole else 1.4, marker="o", markersize=3)
        handles.append(Line2D([], [], color=color, linewidth=2.4 if whole else 1.4, label=label))
        if len(limits) == len(points):
            axes.plot(points, limits, color=color, linewidth=1.8 if whole else 0.9, linestyle="--", alpha=0.8)
    handles.append(Line2D([], [], color="#555555", linestyle="--", label="limit: bytes or flops"))
    axes.set(xscale="log", yscale="log", xlabel=LABELS[name], ylabel="milliseconds, median")
    ticks = [entry["point"] for entry in entries]
    axes.set_xticks(ticks)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.set_title(_title(name, entries, report), fontsize=9)
    figure.legend(handles=handles, loc="outside right center", fontsize=8, frameon=False)
    canvas.draw()
    buffer = io.BytesIO()
    image = PillowImage.frombuffer(
        "RGBA", canvas.get_width_height(), canvas.buffer_rgba().tobytes(), "raw", "RGBA", 0, 1
    )
    image.convert("RGB").quantize(128, PillowImage.Quantize.MAXCOVERAGE).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _short(value: float) -> str:
    for least, unit, letter in ((1e6, 1e6, "M"), (1e4, 1e3, "k")):
        if value >= least and value % (unit / 10) == 0:
            return f"{value / unit:g}{letter}"
    return f"{value:g}"


def _title(name: str, entries: list[dict[str, Any]], report: dict[str, Any]) -> str:
    """Describe the quantities that stay the same along the sweep, and the machine."""
    row = entries[0]["rows"][0]
    parts = {
        "gaussians": f"{row['gaussians']:,} Gaussians",
        "resolution": f"{row['width']} x {row['height']}",
        "nodes": f"{row['control_points']} control points",
        "threads": f"{row['threads']} thread{'s' if row['threads'] > 1 else ''}",
    }
    machine = report["machine"]
    return ", ".join([*(text for key, text in parts.items() if key != name), machine["gpu"] or machine["processor"]])
