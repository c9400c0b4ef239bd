"""Table of an ablation: the finished cells beside the published figures."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..config.presets import FREE_TO_CHANGE
from ..data.synthetic.zoo import SUBJECTS
from ..errors import UserError
from ..storage.files import write_atomically
from .cells import (
    NUMBERS,
    VARIED,
    Cell,
    cell_folder,
    discover,
    first_difference,
    read_metrics,
    recorded_settings,
    sort_values,
)
from .markdown import markdown
from .plot import picture
from .published import PUBLISHED_PSNR, TABLE_S1
from .zoo import compare_rows, read_table

REFERENCE = {"motion": "control-points", "arap": "per-gaussian"}
"""Row of each table that the others are compared with."""

Row = dict[str, Any]


def build(ablation: str, output: Path, planned: Sequence[Cell] = (), compare: Path | None = None) -> dict[str, Any]:
    """Collect the cells and compute the tables.

    Args:
        output: Folder of the cells, ``SCENE/VALUE[-seedN]``.
        planned: Cells that have an entry even while they are missing.
        compare: Output folder of another zoo, whose scores are subtracted.

    Returns:
        ``ablation``, ``settings`` (shared by the cells), ``scenes``, ``values``, ``seeds``, ``cells`` (one entry each,
        metrics None while missing) and ``tables``: the mean over several scenes, then one table for each scene, with
        ``rows`` of statistics {mean, std, count}, None for missing cells. For ``zoo`` it is one table, whose rows are
        the scenes and their mean; with ``compare`` there is ``compared``, the other folder and its settings.

    Raises:
        UserError: there are no cells, a file is damaged, or cells differ in more than the ablation varies.
    """
    keys = dict.fromkeys([(cell.scene, cell.value, cell.seed) for cell in planned])
    keys.update(dict.fromkeys(discover(output, ablation)))
    if not keys:
        raise UserError(f"{output}: holds no cells of {ablation}; train some first, without --table-only")
    cells = []
    for scene, value, seed in keys:
        metrics = read_metrics(output / scene / cell_folder(value, seed))
        cells.append({"scene": scene, "value": value, "seed": seed, "metrics": metrics})
    settings = _shared_settings(ablation, output, cells, planned)
    scenes = list(dict.fromkeys(cell["scene"] for cell in cells))
    report = {
        "ablation": ablation,
        "settings": {**settings, "device": sorted({c["metrics"]["device"] for c in cells if _has(c, "device")})},
        "scenes": scenes,
        "values": sort_values(ablation, [cell["value"] for cell in cells]),
        "seeds": sorted({cell["seed"] for cell in cells}),
        "cells": [_without_images(cell) for cell in cells],
    }
    if ablation == "zoo":
        return _zoo_report(report, cells, compare)
    tables = [_table(report, cells, [scene]) for scene in scenes]
    if len(scenes) > 1:
        tables.insert(0, _table(report, cells, scenes))
    return {**report, "tables": tables}


def _has(cell: Row, key: str) -> bool:
    return cell["metrics"] is not None and cell["metrics"].get(key) is not None


def _without_images(cell: Row) -> Row:
    if cell["metrics"] is None:
        return cell
    return {**cell, "metrics": {key: value for key, value in cell["metrics"].items() if key != "per_image"}}


def _shared_settings(ablation: str, output: Path, cells: list[Row], planned: Sequence[Cell]) -> dict[str, Any]:
    """Return the settings in the head of the table; refuse to compare cells with different ones."""
    ignored = (*VARIED[ablation], *FREE_TO_CHANGE, "seed", "data.folder")
    first, shared = "the options", planned[0].settings if planned else None
    for cell in cells:
        folder = output / cell["scene"] / cell_folder(cell["value"], cell["seed"])
        settings = recorded_settings(folder) if cell["metrics"] is not None else None
        if settings is None:
            continue
        if shared is None:
            first, shared = str(folder), settings
        differs = first_difference(settings, shared, ignored)
        if differs is not None:
            name, actual, wanted = differs
            raise UserError(
                f"{folder}: made with {name} = {actual!r}, but {first} has {wanted!r}: not one table; "
                "give the same options, or another --output"
            )
    if shared is None:
        return {}
    names = ("resample", "background") if ablation == "zoo" else ("downscale", "resample", "background")
    data = {name: shared["data"][name] for name in names}
    return {"preset": shared["preset"], "steps": shared["steps"], **data}


def statistics(values: Sequence[float]) -> dict[str, Any] | None:
    """Compute mean, standard deviation of the sample (None for one value) and count; None without values."""
    if not values:
        return None
    mean = math.fsum(values) / len(values)
    spread = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1)) if len(values) > 1 else None
    return {"mean": mean, "std": spread, "count": len(values)}


def _over_scenes(cells: list[Row], scenes: list[str], key: str) -> dict[str, Any] | None:
    """Average each scene over its seeds and the results over scenes; compute the deviation over the seeds that every
    scene has.

    Return None unless every scene has a cell, since a mean over fewer scenes is not comparable.
    """
    known: dict[str, dict[int, float]] = {scene: {} for scene in scenes}
    for cell in cells:
        if cell["scene"] in known and _has(cell, key):
            known[cell["scene"]][cell["seed"]] = float(cell["metrics"][key])
    if not all(known.values()):
        return None
    complete = set.intersection(*(set(values) for values in known.values()))
    sample = statistics([math.fsum(v[seed] for v in known.values()) / len(scenes) for seed in sorted(complete)])
    mean = math.fsum(math.fsum(v.values()) / len(v) for v in known.values()) / len(scenes)
    return {
        "mean": mean,
        "std": None if sample is None else sample["std"],
        "count": sum(len(values) for values in known.values()),
    }


def _table(report: dict[str, Any], cells: list[Row], scenes: list[str]) -> dict[str, Any]:
    """Compute the rows of ``scenes`` together."""
    ablation = report["ablation"]
    alone = len(scenes) < len(report["scenes"])
    rows: list[Row] = []
    for value in report["values"]:
        own = [cell for cell in cells if cell["value"] == value and cell["scene"] in scenes]
        rows.append({"value": value, **{key: _over_scenes(own, scenes, key) for key in NUMBERS}})
    _compare(ablation, rows)
    if ablation == "nodes" and not alone:
        for row in rows:
            row["published"] = TABLE_S1.get(row["value"])
    elif ablation == "motion":
        _published_leads(rows, scenes, "published")
        if not alone:
            _published_leads(rows, ["mean"], "published_mean")
    name = scenes[0] if len(scenes) == 1 else f"mean of {', '.join(scenes)}"
    return {"name": name, "scenes": scenes, "rows": rows}


def _zoo_report(report: dict[str, Any], cells: list[Row], compare: Path | None) -> dict[str, Any]:
    """Add the one table of the zoo to its report."""
    order = list(SUBJECTS)
    scenes = sorted(report["scenes"], key=lambda scene: order.index(scene) if scene in order else len(order))
    rows: list[Row] = []
    for scene in scenes:
        own = [cell for cell in cells if cell["scene"] == scene]
        worst = min((cell["metrics"] for cell in own if _has(cell, "psnr_worst")), key=_worst_psnr, default={})
        rows.append({"value": scene, **{key: _over_scenes(own, [scene], key) for key in NUMBERS}})
        rows[-1]["psnr_worst_time"] = worst.get("psnr_worst_time")
    if len(scenes) > 1:
        rows.append({"value": "mean", **{key: _over_scenes(cells, scenes, key) for key in NUMBERS}})
        rows[-1]["psnr_worst_time"] = None
    compared = None if compare is None else read_table(compare)
    if compared is not None:
        compare_rows(rows, compared.pop("rows"))
    return {
        **report,
        "scenes": scenes,
        "compared": compared,
        "tables": [{"name": "subjects", "scenes": scenes, "rows": rows}],
    }


def _worst_psnr(metrics: Row) -> float:
    return metrics["psnr_worst"]


def _compare(ablation: str, rows: list[Row]) -> None:
    """Add comparisons to each row.

    ``nodes``: PSNR less that of the best row, dB. ``motion``: lead of the reference row in PSNR, dB. ``arap``:
    end-point error and jitter as shares of the reference row's.
    """

    def mean(row: Row | None, key: str) -> float | None:
        return None if row is None or row[key] is None else row[key]["mean"]

    if ablation == "nodes":
        best = max((value for row in rows if (value := mean(row, "psnr")) is not None), default=None)
        for row in rows:
            value = mean(row, "psnr")
            row["to_best"] = None if value is None or best is None else value - best
        return
    reference = next((row for row in rows if row["value"] == REFERENCE[ablation]), None)
    for row in rows:
        if ablation == "motion":
            ours, its = mean(reference, "psnr"), mean(row, "psnr")
            row["lead"] = None if ours is None or its is None or row is reference else ours - its
            continue
        for key in ("epe", "jitter"):
            base, its = mean(reference, key), mean(row, key)
            row[f"{key}_share"] = None if its is None or not base or row is reference else its / base


def _published_leads(rows: list[Row], scenes: list[str], key: str) -> None:
    """Add the published means over ``scenes`` to the rows, if a figure is published for every scene."""
    ours = PUBLISHED_PSNR["control-points"]
    if not all(scene in ours for scene in scenes):
        return
    for row in rows:
        known = PUBLISHED_PSNR[row["value"]]
        psnr = math.fsum(known[scene] for scene in scenes) / len(scenes)
        lead = math.fsum(ours[scene] - known[scene] for scene in scenes) / len(scenes)
        row[key] = {"psnr": psnr, "lead": lead if row["value"] != "control-points" else None}


def write(report: dict[str, Any], output: Path) -> list[Path]:
    """Write ``ABLATION.json``, ``ABLATION.md`` and ``ABLATION.png`` to ``output``.

    Raises:
        UserError: a file cannot be written.
    """
    contents = {
        "json": (json.dumps(report, indent=2) + "\n").encode(),
        "md": markdown(report).encode(),
        "png": picture(report),
    }
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--output {output}: cannot be made ({error.strerror}); name another folder") from error
    paths = []
    for ending, content in contents.items():
        paths.append(output / f"{report['ablation']}.{ending}")
        write_atomically(paths[-1], content)
    return paths
