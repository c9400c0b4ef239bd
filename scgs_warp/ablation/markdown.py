"""The table of an ablation as Markdown."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..evaluation.coverage import coverage_line
from .published import NOTES
from .zoo import LOSS_DB

MISSING = "-"
DIGITS = {"control_points": 0, "gaussians": 0, "psnr": 2, "psnr_median": 2, "psnr_worst": 2, "ssim": 4, "lpips": 4,
          "epe": 2, "jitter": 3, "missing": 2, "rods_within": 1, "seconds": 0}  # fmt: skip
TITLES = {
    "control_points": "control points",
    "gaussians": "Gaussians",
    "psnr": "PSNR",
    "psnr_median": "median",
    "psnr_worst": "worst (at t)",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "epe": "EPE [%]",
    "jitter": "jitter [%]",
    "missing": "missing [%]",
    "rods_within": "rods [%]",
    "seconds": "seconds",
}
SHARES = ("missing", "rods_within")
"""Metrics from 0 to 1 that tables show in percent."""
USUAL = ("control_points", "gaussians", "psnr", "ssim", "lpips", "epe", "jitter", "seconds")
METRICS = {
    "zoo": ("psnr", "psnr_median", "psnr_worst", "ssim", "lpips", "missing", "rods_within", "epe", "jitter",
            "gaussians", "control_points", "seconds"),
}  # fmt: skip
"""Columns of each ablation, where they are not ``USUAL``."""
OPTIONAL = ("lpips", "epe", "jitter", "missing", "rods_within")
"""Metrics that have a column only if any cell has them."""
HEADS = {"nodes": "asked", "motion": "motion", "arap": "ARAP", "zoo": "subject"}
LOST = {"psnr": "PSNR", "psnr_worst": "worst"}
LABELS = {"arap": {"per-gaussian": "per-gaussian (baseline)"}}

Row = dict[str, Any]
Column = tuple[str, Callable[[Row], str]]


def number(value: float | None, digits: int, sign: bool = False) -> str:
    if value is None:
        return MISSING
    return f"{value:{'+' if sign else ''},.{digits}f}"


def measured(row: Row, key: str) -> str:
    """Format the statistics of a metric as ``43.12 ± 0.08``, without the deviation if there is only one seed."""
    statistics = row[key]
    if statistics is None:
        return MISSING
    mean, std = (
        None if statistics[name] is None else statistics[name] * (100.0 if key in SHARES else 1.0)
        for name in ("mean", "std")
    )
    text = number(mean, DIGITS[key]) if std is None else f"{number(mean, DIGITS[key])} ± {number(std, DIGITS[key])}"
    time = row.get("psnr_worst_time") if key == "psnr_worst" else None
    return text if time is None else f"{text} ({time:.2f})"


def columns(report: dict[str, Any], rows: list[Row]) -> list[Column]:
    """Return, for each column of one table, its heading and the function that writes a row's text."""
    ablation = report["ablation"]
    labels: dict[str, str] = LABELS.get(ablation, {})
    made: list[Column] = [(HEADS[ablation], lambda row: str(labels.get(row["value"], row["value"])))]
    extra = {
        "nodes": {"psnr": ("to best", "to_best", 2, True)},
        "motion": {"psnr": ("lead of control-points", "lead", 2, True)},
        "arap": {"epe": ("of baseline", "epe_share", 2, False), "jitter": ("of baseline", "jitter_share", 2, False)},
        "zoo": {},
    }[ablation]
    for key in METRICS.get(ablation, USUAL):
        if key in OPTIONAL and not any(row[key] for row in rows):
            continue
        title = "final" if (ablation, key) == ("nodes", "control_points") else TITLES[key]
        made.append((title, lambda row, key=key: measured(row, key)))
        if key in extra:
            title, name, digits, sign = extra[key]
            made.append((title, lambda row, n=name, d=digits, s=sign: number(row[n], d, s)))
    if report.get("compared"):
        made += _compared()
    return made + _published(ablation, rows)


def _compared() -> list[Column]:
    return [
        ("change: PSNR", lambda row: number(row["psnr_change"], 2, True)),
        ("change: worst", lambda row: number(row["worst_change"], 2, True)),
        (f"loses > {LOSS_DB} dB", lambda row: ", ".join(LOST[key] for key in row["loses"])),
    ]


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
    if report["ablation"] == "zoo":
        lines += _uncovered(report)
    return "\n".join([*lines, NOTES[report["ablation"]], ""])


def _uncovered(report: dict[str, Any]) -> list[str]:
    """List the cells whose subject is not covered, and where."""
    lines = []
    for cell in report["cells"]:
        text = coverage_line(cell["metrics"] or {})
        if text is not None:
            lines.append(f"- {cell['scene']}, seed {cell['seed']}: {text}")
    return [*lines, ""] if lines else []


def settings_line(report: dict[str, Any]) -> str:
    """State in one sentence what the cells share."""
    shared = report["settings"]
    parts = []
    if "steps" in shared:
        parts += [f"Preset {shared['preset']}", f"{shared['steps']:,} steps in every cell"]
        scaled = f"downscale {shared['downscale']} ({shared['resample']})" if "downscale" in shared else ""
        parts += [part for part in (scaled, f"on {shared['background']}") if part]
    if shared["device"]:
        parts.append(f"device {' and '.join(shared['device'])}")
    several = len(report["seeds"]) > 1
    parts.append(f"seed{'s' if several else ''} {', '.join(map(str, report['seeds']))}")
    parts.append("last step, test split" + (", mean ± standard deviation over the seeds" if several else ""))
    total = len(report["cells"])
    absent = sum(cell["metrics"] is None for cell in report["cells"])
    missing = f" {absent} of {total} cells are missing." if absent else ""
    compared = report.get("compared")
    other = ""
    if compared:
        settings = ", ".join(f"{name} {value}" for name, value in compared["settings"].items())
        other = f" Compared with {compared['folder']} ({settings})."
    return f"{', '.join(parts)}.{missing}{other}"


def table_lines(made: list[Column], rows: list[Row]) -> list[str]:
    """Write aligned rows that read well as plain text."""
    texts = [[title for title, _ in made], *([text(row) for _, text in made] for row in rows)]
    widths = [max(3, *(len(line[i]) for line in texts)) for i in range(len(made))]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    padded = [[line[0].ljust(widths[0]), *(t.rjust(w) for t, w in zip(line[1:], widths[1:]))] for line in texts]
    return ["| " + " | ".join(line) + " |" for line in (padded[0], rule, *padded[1:])]
