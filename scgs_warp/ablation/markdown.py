"""The table of an ablation as Markdown."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .published import NOTES

MISSING = "-"
DIGITS = {"control_points": 0, "gaussians": 0, "psnr": 2, "ssim": 4, "lpips": 4, "epe": 2, "jitter": 3, "seconds": 0}
TITLES = {
    "control_points": "control points",
    "gaussians": "Gaussians",
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "epe": "EPE [%]",
    "jitter": "jitter [%]",
    "seconds": "seconds",
}
ALWAYS = ("control_points", "gaussians", "psnr", "ssim", "seconds")
"""Metrics that always have a column; others have one if any cell has them."""
HEADS = {"nodes": "asked", "motion": "motion", "arap": "ARAP"}
LABELS = {"arap": {"per-gaussian": "per-gaussian (baseline)"}}

Row = dict[str, Any]
Column = tuple[str, Callable[[Row], str]]


def number(value: float | None, digits: int, sign: bool = False) -> str:
    if value is None:
        return MISSING
    return f"{value:{'+' if sign else ''},.{digits}f}"


def measured(statistics: dict[str, Any] | None, digits: int) -> str:
    """Format statistics as ``43.12 ± 0.08``, without the deviation if there is only one seed."""
    if statistics is None:
        return MISSING
    text = number(statistics["mean"], digits)
    return text if statistics["std"] is None else f"{text} ± {number(statistics['std'], digits)}"


def columns(report: dict[str, Any], rows: list[Row]) -> list[Column]:
    """Return, for each column of one table, its heading and the function that writes a row's text."""
    ablation = report["ablation"]
    labels: dict[str, str] = LABELS.get(ablation, {})
    made: list[Column] = [(HEADS[ablation], lambda row: str(labels.get(row["value"], row["value"])))]
    extra = {
        "nodes": {"psnr": ("to best", "to_best", 2, True)},
        "motion": {"psnr": ("lead of control-points", "lead", 2, True)},
        "arap": {"epe": ("of baseline", "epe_share", 2, False), "jitter": ("of baseline", "jitter_share", 2, False)},
    }[ablation]
    for key, title in TITLES.items():
        if key not in ALWAYS and not any(row[key] for row in rows):
            continue
        title = "final" if (ablation, key) == ("nodes", "control_points") else title
        made.append((title, lambda row, key=key: measured(row[key], DIGITS[key])))
        if key in extra:
            title, name, digits, sign = extra[key]
            made.append((title, lambda row, n=name, d=digits, s=sign: number(row[n], d, s)))
    return made + _published(ablation, rows)


def _published(ablation: str, rows: list[Row]) -> list[Column]:
    groups: tuple[tuple[str, str, tuple[str, ...]], ...] = ()
    if ablation == "nodes":
        groups = (("published", "published", ("control_points", "psnr", "ssim", "lpips")),)
    elif ablation == "motion":
        groups = (
            ("published", "published", ("psnr", "lead")),
            ("published_mean", "published, mean of 7", ("psnr", "lead")),
        )
    titles = {**TITLES, "control_points": "final", "lead": "lead"}
    made: list[Column] = []
    for group, name, keys in groups:
        if any(row.get(group) for row in rows):
            for key in keys:

                def text(row: Row, group: str = group, key: str = key) -> str:
                    return number((row.get(group) or {}).get(key), DIGITS.get(key, 2), key == "lead")

                made.append((f"{name}: {titles[key]}", text))
    return made


def markdown(report: dict[str, Any]) -> str:
    """Write the shared settings, a table over all scenes and one for each scene."""
    lines = [f"# Ablation: {report['ablation']}", "", settings_line(report), ""]
    for table in report["tables"]:
        lines += [f"## {table['name']}", "", *table_lines(columns(report, table["rows"]), table["rows"]), ""]
    return "\n".join([*lines, NOTES[report["ablation"]], ""])


def settings_line(report: dict[str, Any]) -> str:
    """State in one sentence what the cells share."""
    shared = report["settings"]
    parts = []
    if "steps" in shared:
        parts += [f"Preset {shared['preset']}", f"{shared['steps']:,} steps in every cell"]
        parts += [f"downscale {shared['downscale']} ({shared['resample']})", f"on {shared['background']}"]
    if shared["device"]:
        parts.append(f"device {' and '.join(shared['device'])}")
    several = len(report["seeds"]) > 1
    parts.append(f"seed{'s' if several else ''} {', '.join(map(str, report['seeds']))}")
    parts.append("last step, test split" + (", mean ± standard deviation over the seeds" if several else ""))
    total = len(report["cells"])
    absent = sum(cell["metrics"] is None for cell in report["cells"])
    missing = f" {absent} of {total} cells are missing." if absent else ""
    return f"{', '.join(parts)}.{missing}"


def table_lines(made: list[Column], rows: list[Row]) -> list[str]:
    """Write aligned rows that read well as plain text."""
    texts = [[title for title, _ in made], *([text(row) for _, text in made] for row in rows)]
    widths = [max(3, *(len(line[i]) for line in texts)) for i in range(len(made))]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    padded = [[line[0].ljust(widths[0]), *(t.rjust(w) for t, w in zip(line[1:], widths[1:]))] for line in texts]
    return ["| " + " | ".join(line) + " |" for line in (padded[0], rule, *padded[1:])]
