"""Published figures from ``results/literature/*.json``, beside the scores of this project.

A file in ``results/literature/`` holds the figures that stand in one table: the name of the ``table``, the ``data``,
``scenes``, ``sources`` and ``rows``. A source has a ``text`` and a ``checkpoint``: ``best`` (chosen by its score on
test views), ``last``, or ``not stated``. A row has a ``row``, ``label`` and ``source``, and any of:

- ``psnr``, ``ssim``, ``lpips``: one figure for each scene, null where none is published. ``psnr_of`` names a row of
  ``scgs_warp.ablation.published.PUBLISHED_PSNR`` that holds the PSNR, its mean included.
- ``mean``: the means as published. The table shows the means of the scenes where all scenes are published.
- ``mean_differs``: the metrics whose published mean is not the mean of their scenes.
- ``mean_scenes``: the number of scenes in ``mean``, if it is not all.
- ``digits``: published digits of PSNR, if not 2; ``kinds``: what SSIM and LPIPS are, if not SSIM and LPIPS-VGG;
  ``remark``: a sentence below the table.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markdown_table import number, table

from scgs_warp.ablation.published import PUBLISHED_PSNR

METRICS = {"psnr": 2, "ssim": 3, "lpips": 3}
"""Metrics, and the digits that a table shows."""

Column = str | tuple[str, ...]
"""A scene, or the scenes of a mean."""


@dataclass(frozen=True)
class Row:
    """Figures of one method from one source."""

    name: str
    label: str
    source: str
    scores: dict[str, dict[str, float]]
    """By metric and scene; a scene that is not published is missing."""
    published_mean: dict[str, float]
    mean_differs: tuple[str, ...] = ()
    mean_scenes: int | None = None
    digits: int = METRICS["psnr"]
    kinds: str = ""
    remark: str = ""

    def computed_mean(self, metric: str, scenes: Iterable[str]) -> float | None:
        """Return the mean over ``scenes``; None if one is not published."""
        values = [self.scores[metric].get(scene) for scene in scenes]
        return None if None in values else math.fsum(values) / len(values)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Literature:
    """All rows of one table."""

    scenes: tuple[str, ...]
    sources: dict[str, dict[str, str]]
    rows: tuple[Row, ...]


def read_literature(results: Path, name: str) -> Literature | None:
    """Read the published figures of the table ``name``; None if there are none."""
    for path in sorted((results / "literature").glob("*.json")):
        values = json.loads(path.read_text(encoding="utf-8"))
        if values["table"] == name:
            scenes = tuple(values["scenes"])
            return Literature(scenes, values["sources"], tuple(_row(row, scenes) for row in values["rows"]))
    return None


def _row(values: dict[str, Any], scenes: tuple[str, ...]) -> Row:
    """Read a row.

    Raises:
        ValueError: a metric does not have one figure for each scene.
    """
    mean = dict(values.get("mean", {}))
    scores: dict[str, dict[str, float]] = {}
    for metric in METRICS:
        figures = values.get(metric, [None] * len(scenes))
        if len(figures) != len(scenes):
            raise ValueError(f"row {values['row']}: {metric} needs {len(scenes)} figures, one for each scene")
        scores[metric] = {scene: value for scene, value in zip(scenes, figures, strict=True) if value is not None}
    if "psnr_of" in values:
        known = PUBLISHED_PSNR[values["psnr_of"]]
        scores["psnr"] = {scene: known[scene] for scene in scenes}
        mean["psnr"] = known["mean"]
    return Row(
        values["row"],
        values["label"],
        values["source"],
        scores,
        mean,
        tuple(values.get("mean_differs", ())),
        **{key: values[key] for key in ("mean_scenes", "digits", "kinds", "remark") if key in values},
    )


def literature_table(literature: Literature | None, columns: tuple[Column, ...], own: list[list[str]]) -> str:
    """Write published figures and the sources below them.

    Args:
        literature: published rows; None: only ``own``.
        columns: scenes, and tuples of scenes whose mean is shown.
        own: lines of this project: label, one cell for each column, and SSIM.
    """
    rows = literature.rows if literature else ()
    numbers = {source: str(index) for index, source in enumerate(dict.fromkeys(row.source for row in rows), start=1)}
    lines = []
    for row in rows:
        assert literature is not None
        checkpoint = literature.sources[row.source]["checkpoint"]
        cells = [_psnr(row, column, literature.scenes) for column in columns]
        lines.append([row.label, *cells, _others(row, literature.scenes), checkpoint, numbers[row.source]])
    lines += [[*line, "last", "this project"] for line in own]
    head = [column if isinstance(column, str) else f"mean of {len(column)}" for column in columns]
    text = table(["PSNR in dB", *head, "SSIM / LPIPS", "checkpoint", "source"], lines)
    if literature is None:
        return text
    legend = [f"{index}. {literature.sources[source]['text']}" for source, index in numbers.items()]
    remarks = [f"- {remark}" for row in rows for remark in _remarks(row)]
    return "\n\n".join([text, "Sources:", "\n".join(legend), *(["Remarks:", "\n".join(remarks)] if remarks else [])])


def _psnr(row: Row, column: Column, scenes: tuple[str, ...]) -> str:
    if isinstance(column, str):
        return number(row.scores["psnr"].get(column), row.digits)
    mean = row.computed_mean("psnr", column)
    if mean is None and len(column) == len(scenes):
        mean = row.published_mean.get("psnr")
        return number(mean, row.digits) + (f" ({row.mean_scenes} scenes)" if row.mean_scenes else "")
    return number(mean, row.digits)


def _others(row: Row, scenes: tuple[str, ...]) -> str:
    """Write the means of SSIM and LPIPS over all scenes, as ``SSIM / LPIPS``."""
    means = []
    for metric in ("ssim", "lpips"):
        mean = row.computed_mean(metric, scenes)
        means.append(number(row.published_mean.get(metric) if mean is None else mean, METRICS[metric]))
    if not any(means):
        return ""
    text = f"{means[0]} / {means[1]}" if means[1] else means[0]
    return f"{text} ({row.kinds})" if row.kinds else text


def _remarks(row: Row) -> list[str]:
    remarks = [row.remark] if row.remark else []
    if row.mean_differs:
        digits = {"psnr": row.digits, "ssim": 3, "lpips": 4}
        means = ", ".join(f"{key.upper()} {number(row.published_mean[key], digits[key])}" for key in row.mean_differs)
        remarks.append(f"published as mean, but not the mean of the scenes: {means}.")
    return [f"{row.label}: {remark}" for remark in remarks]
