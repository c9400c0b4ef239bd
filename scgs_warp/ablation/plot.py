"""Plot of an ablation."""

from __future__ import annotations

import io
import math
from typing import Any

from .published import TABLE_S1

HEIGHT = 3.9
DPI = 110
OURS, PUBLISHED = "#0072b2", "#d55e00"
COLORS = {
    "static": "#999999",
    "hexplane": "#e69f00",
    "per-gaussian": "#56b4e9",
    "control-points": "#0072b2",
    "on": "#0072b2",
    "off": "#d55e00",
}
"""Colours that colour-blind readers can tell apart (Okabe and Ito)."""
LABELS = {
    "on": "ARAP",
    "off": "no ARAP",
    "per-gaussian": "per-Gaussian",
    "control-points": "control points",
}

Table = dict[str, Any]


def picture(report: dict[str, Any]) -> bytes:
    """Draw the plot and return it as a PNG.

    For ``nodes`` it shows PSNR and the final number of control points over the requested number, for ``zoo`` a bar for
    each scene with its worst image, otherwise bars for each scene.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # no display, no global backend
    from matplotlib.figure import Figure

    draw = {"nodes": _nodes, "motion": _motion, "arap": _arap, "zoo": _zoo}[report["ablation"]]
    figure = Figure(dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    draw(figure, report)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _points(table: Table, key: str) -> tuple[list[int], list[float], list[float]]:
    """Return requested numbers of control points, means and deviations.

    The mean of missing cells is NaN, which leaves a gap in the line; the deviation of a single seed is 0.
    """
    statistics = [(int(row["value"]), row[key] or {"mean": math.nan, "std": None}) for row in table["rows"]]
    counts, rows = [count for count, _ in statistics], [row for _, row in statistics]
    return counts, [row["mean"] for row in rows], [row["std"] or 0.0 for row in rows]


def _nodes(figure: Any, report: dict[str, Any]) -> None:
    from matplotlib.ticker import FuncFormatter, NullLocator

    figure.set_size_inches(10.5, HEIGHT)
    quality, count = figure.subplots(1, 2)
    top = report["tables"][0]
    for table in report["tables"]:
        main = table is top
        style: dict[str, Any] = {"color": OURS, "linewidth": 2.2, "zorder": 3} if main else {"color": "0.65"}
        for axes, key in ((quality, "psnr"), (count, "control_points")):
            x, y, spread = _points(table, key)
            bars = spread if any(spread) else None
            axes.errorbar(x, y, bars, marker="o", markersize=4, capsize=2, **style)
            if not main and axes is quality and not math.isnan(y[0]):
                below = y[0] < _points(top, "psnr")[1][0]
                at = (-4, -16 if below else 8)
                axes.annotate(table["name"], (x[0], y[0]), at, textcoords="offset points", fontsize=8, color="0.4")
    asked = [int(value) for value in TABLE_S1]
    ticks = sorted({*asked, *map(int, report["values"])})
    published = quality.twinx()
    published.plot(asked, [row["psnr"] for row in TABLE_S1.values()], "s--", color=PUBLISHED, markersize=4)
    published.set_ylabel("published PSNR [dB]", color=PUBLISHED)
    published.tick_params(axis="y", colors=PUBLISHED)
    drawn = any(row["psnr"] for table in report["tables"] for row in table["rows"])
    _same_scale(quality, published, drawn)
    quality.set(title="PSNR: the two axes have one scale, shifted", ylabel="PSNR [dB]")
    count.plot(asked, [row["control_points"] for row in TABLE_S1.values()], "s--", color=PUBLISHED, markersize=4)
    count.plot(ticks, ticks, color="0.8", linewidth=1, zorder=0)
    count.set(title="control points after training", yscale="log", ylabel="final")
    for axes in (quality, count):
        axes.set(xscale="log", xlabel="control points asked for", xticks=ticks)
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.grid(alpha=0.3, linewidth=0.5)
    count.set_yticks(ticks)
    count.yaxis.set_minor_locator(NullLocator())
    count.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    _legend(figure, [(OURS, "-", _short(top, top)), (PUBLISHED, "--", "published: mean of D-NeRF, 400 x 400")])


def _short(table: Table, top: Table) -> str:
    several = len(table["scenes"]) > 1
    return f"mean of {len(table['scenes'])} scenes" if table is top and several else table["name"]


def _same_scale(ours: Any, published: Any, drawn: bool) -> None:
    """Give the y axes of both plots the same dB per centimetre, and centre each curve vertically."""
    limits = [axes.get_ylim() for axes in ((ours, published) if drawn else (published,))]
    span = max(high - low for low, high in limits)
    for axes, (low, high) in zip((ours, published) if drawn else (published,), limits):
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * span, middle + 0.5 * span)
    if not drawn:
        ours.set_yticks([])


def _legend(figure: Any, entries: list[tuple[str, Any, str]]) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=color, linestyle=style, linewidth=2) for color, style, _ in entries]
    figure.legend(
        handles, [text for *_, text in entries], loc="outside lower center", ncols=len(entries), frameon=False
    )


def _bars(axes: Any, report: dict[str, Any], key: str, digits: int) -> list[float]:
    """Draw a group of bars for each table and a bar for each value; return the heights."""
    values, tables = report["values"], report["tables"]
    width = 0.84 / len(values)
    heights = []
    for index, value in enumerate(values):
        for group, table in enumerate(tables):
            row = next((row for row in table["rows"] if row["value"] == value), None)
            if row is None or row[key] is None:
                continue
            x, height = group + (index - 0.5 * (len(values) - 1)) * width, row[key]["mean"]
            axes.bar(x, height, 0.92 * width, yerr=row[key]["std"], color=COLORS[value], error_kw={"linewidth": 1})
            axes.text(x, height, f"{height:.{digits}f}", ha="center", va="bottom", fontsize=7)
            known = row.get("published") or (row.get("published_mean") if len(tables) == 1 else None)
            if key == "psnr" and known:
                axes.plot([x - 0.44 * width, x + 0.44 * width], [known["psnr"]] * 2, color="black", linewidth=1.4)
                heights.append(known["psnr"])
            heights.append(height)
    axes.set_xticks(range(len(tables)), [_short(table, tables[0]) for table in tables])
    axes.set_xlim(-0.6, len(tables) - 0.4)
    axes.tick_params(axis="x", length=0)
    axes.grid(axis="y", alpha=0.3, linewidth=0.5)
    axes.set_axisbelow(True)
    return heights


def _psnr_axis(axes: Any, heights: list[float]) -> None:
    """Begin the axis at a multiple of 5 dB below the lowest bar, since 0 dB has no meaning."""
    if heights:
        axes.set_ylim(5 * ((min(heights) - 2) // 5), max(heights) + 1.5)


def _handles(report: dict[str, Any]) -> tuple[list[Any], list[str]]:
    from matplotlib.patches import Patch

    values = report["values"]
    return [Patch(color=COLORS[value]) for value in values], [str(LABELS.get(value, value)) for value in values]


def _motion(figure: Any, report: dict[str, Any]) -> None:
    from matplotlib.lines import Line2D

    figure.set_size_inches(max(5.5, 1.2 + 0.55 * len(report["tables"]) * len(report["values"])), HEIGHT)
    axes = figure.add_subplot()
    axes.set_ylabel("PSNR [dB]")
    _psnr_axis(axes, _bars(axes, report, "psnr", 1))
    handles, texts = _handles(report)
    if any(row.get("published") or row.get("published_mean") for table in report["tables"] for row in table["rows"]):
        handles.append(Line2D([], [], color="black", linewidth=1.4))
        texts.append("published")
    figure.legend(handles, texts, loc="outside lower center", ncols=5, frameon=False, fontsize=9)


def _arap(figure: Any, report: dict[str, Any]) -> None:
    panels = [("psnr", "PSNR [dB]", 2), ("epe", "EPE [% of height]", 2), ("jitter", "jitter [% of height]", 3)]
    rows = [row for table in report["tables"] for row in table["rows"]]
    panels = [panel for panel in panels if panel[0] == "psnr" or any(row[panel[0]] for row in rows)]
    groups = len(report["tables"]) * len(report["values"])
    figure.set_size_inches(max(5.5, len(panels) * max(3.2, 0.8 + 0.5 * groups)), HEIGHT)
    for index, (key, title, digits) in enumerate(panels):
        axes = figure.add_subplot(1, len(panels), index + 1)
        heights = _bars(axes, report, key, digits)
        if key == "psnr":
            _psnr_axis(axes, heights)
        else:
            axes.set_ylim(0, 1.12 * max(heights, default=1.0))
        axes.set_title(title)
    handles, texts = _handles(report)
    figure.legend(handles, texts, loc="outside lower center", ncols=len(handles), frameon=False)


def _zoo(figure: Any, report: dict[str, Any]) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    rows = report["tables"][0]["rows"]
    figure.set_size_inches(max(5.5, 1.6 + 0.75 * len(rows)), HEIGHT)
    axes = figure.add_subplot()
    heights: list[float] = []
    for place, row in enumerate(rows):
        if row["psnr"] is not None:
            mean = top = row["psnr"]["mean"]
            axes.bar(place, mean, 0.6, yerr=row["psnr"]["std"], color=OURS, error_kw={"linewidth": 1})
            if row.get("psnr_change") is not None:
                other = mean - row["psnr_change"]
                axes.plot([place - 0.36, place + 0.36], [other, other], color="black", linewidth=1.4)
                top = max(mean, other)
            axes.text(place, top + 0.1, f"{mean:.1f}", ha="center", va="bottom", fontsize=7)
            heights.append(top)
        if row["psnr_worst"] is not None:
            axes.plot(place, row["psnr_worst"]["mean"], "o", color=PUBLISHED, markersize=5)
            heights.append(row["psnr_worst"]["mean"])
    axes.set_ylabel("PSNR [dB]")
    _psnr_axis(axes, heights)
    axes.set_xticks(range(len(rows)), [row["value"] for row in rows])
    axes.set_xlim(-0.6, len(rows) - 0.4)
    axes.tick_params(axis="x", length=0, labelsize=8)
    axes.grid(axis="y", alpha=0.3, linewidth=0.5)
    axes.set_axisbelow(True)
    handles = [Patch(color=OURS), Line2D([], [], color=PUBLISHED, marker="o", linestyle="")]
    texts = ["mean", "worst image"]
    if report.get("compared"):
        handles.append(Line2D([], [], color="black", linewidth=1.4))
        texts.append(f"mean in {report['compared']['folder']}")
    figure.legend(handles, texts, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
