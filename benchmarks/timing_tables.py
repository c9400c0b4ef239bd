"""Tables of timings from ``results/*.json``, as ``apps/bench.py --json`` and ``opensplat.py`` write them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from markdown_table import number, table
from provenance import EDITING, OLDER, RENDERING, TRAINING, changed_since, older_note

TRUSTED_SCALING = 1.8
"""Smallest speed-up of two threads at pure arithmetic at which figures for several threads are trusted."""

Report = dict[str, Any]


def counted(threads: int) -> str:
    return "1 thread" if threads == 1 else f"{threads} threads"


def machine_line(report: Report) -> str:
    """State machine, versions and date."""
    machine = report["machine"]
    where = machine["gpu"] or f"{machine['processor']}, {machine['cores']} cores"
    versions = f"torch {machine['torch']}, Warp {machine['warp']}"
    return f"{where}; {versions}; {report['date'][:10]}."


def scaling_line(rows: list[Report]) -> str:
    """State the speed-up of two threads, and warn where it was too small."""
    values = [row["two_thread_scaling"] for row in rows if row["share"] is None and row["device"] == "cpu"]
    if not values:
        return ""
    text = f" `two_thread_scaling` {min(values):.2f} to {max(values):.2f}"
    several = [row["two_thread_scaling"] for row in rows if row["share"] is None and row["threads"] > 1]
    if several and min(several) < TRUSTED_SCALING:
        return f"{text}, below {TRUSTED_SCALING} in some rows: of those, quote the one-thread column."
    return f"{text}."


def size_line(row: Report) -> str:
    return (
        f"{row['gaussians']:,} Gaussians, {row['control_points']:,} control points, {row['width']} x {row['height']}, "
        f"{row['pairs']:,} pairs, {row['contributors']:.1f} splats a covered pixel."
    )


def stages(report: Report) -> str:
    """Write a table for each motion model: the times of whole frames or steps and of their stages.

    Each number of threads has two columns.
    """
    parts = [machine_line(report) + scaling_line(report["rows"])]
    for motion in dict.fromkeys(row["motion"] for row in report["rows"]):
        # A stage without any time was not measured: it ran inside another one.
        rows = [row for row in report["rows"] if row["motion"] == motion and row["ms_median"] > 0.0]
        threads = sorted({row["threads"] for row in rows})
        head = [motion if report["what"] != "raster" else "stage"]
        for count in threads:
            head += [f"{counted(count)}, median ms", "least ms"]
        lines = []
        for name in dict.fromkeys(row["name"] for row in rows):
            by_threads = {row["threads"]: row for row in rows if row["name"] == name}
            first = next(iter(by_threads.values()))
            whole = first["share"] is None
            line = [f"**{name}**" if whole else name]
            for count in threads:
                row = by_threads.get(count)
                line += ["", ""] if row is None else [number(row["ms_median"]), number(row["ms_min"])]
            lines.append(line)
        parts += [size_line(rows[0]), table(head, lines)]
        parts.append(memory_line(rows))
    parts += motion_lines(report)
    return "\n\n".join(part for part in parts if part)


def memory_line(rows: list[Report]) -> str:
    extra = [row["extra_mib"] for row in rows if row["share"] is None and row["extra_mib"] is not None]
    if not extra:
        return ""
    return f"Memory: the model {number(rows[0]['model_mib'])} MiB, measuring it at most {number(max(extra))} MiB more."


def motion_lines(report: Report) -> list[str]:
    lines = []
    for cost in report.get("motion", []):
        ratio = cost["ratio_to_static"]
        rest = "" if ratio is None else f"; {ratio:.2f} of the frames/s of `static`"
        lines.append(
            f"- `{cost['motion']}` on {counted(cost['threads'])}: motion (network and skinning) "
            f"{number(cost['ms_median'], 2)} ms median, {number(cost['ms_min'], 2)} ms least{rest}."
        )
    return ["\n".join(lines)] if lines else []


def table_s2(report: Report) -> str:
    head = ["motion", "threads", "frames/s", "of static", "x per-gaussian", "paper: frames/s", "of static", "x p.-g."]
    lines = [
        [
            row["motion"],
            str(row["threads"]),
            number(row["fps"]),
            number(row["ratio_to_static"], 2),
            number(row["ratio_to_per_gaussian"], 2),
            number(row["paper_fps"]),
            number(row["paper_ratio_to_static"], 2),
            number(row["paper_ratio_to_per_gaussian"], 2),
        ]
        for row in report["table_s2"]
    ]
    first = machine_line(report) + scaling_line(report["rows"])
    return "\n\n".join([first, size_line(report["rows"][0]), table(head, lines)])


def opensplat(report: Report) -> str:
    head = ["one thread", "scgs_warp, median ms", "least ms", "OpenSplat, median ms", "least ms", "ratio of medians"]
    lines = []
    for name in ("forward", "backward"):
        ours, theirs = report["rows"][f"scgs_warp/{name}"], report["rows"][f"opensplat/{name}"]
        times = [number(side[key]) for side in (ours, theirs) for key in ("ms_median", "ms_min")]
        lines.append([name, *times, number(report["ratios"][name])])
    lines.append(["both", "", "", "", "", number(report["ratios"]["both"])])
    picture = report["pictures"]["as_it_is"]
    alone = report["rows"]["scgs_warp/composite"]
    texts = [
        machine_line(report),
        f"{report['gaussians']:,} Gaussians, {report['width']} x {report['height']}, {report['pairs']:,} pairs, "
        f"{report['contributors']:.1f} splats a covered pixel; OpenSplat {report['opensplat']} with "
        f"`{report['flags']}`.",
        table(head, lines),
        f"Forward includes sorting on both sides; our compositing alone takes {number(alone['ms_median'])} ms (least "
        f"{number(alone['ms_min'])}). Of the images {100 * picture['pixels_within_1e-4']:.3f} % of pixels are within "
        f"1e-4, none differs by more than {picture['largest']:.1g}.",
    ]
    return "\n\n".join(texts)


def scaling(report: Report) -> str:
    """Write a table for each sweep: the times of whole frames and rasterisations, and their lower limits."""
    limits = [
        f"{counted(one['threads'])}: {one['gigabytes']:.1f} GB/s copied, {one['gigaflops']:.0f} GFLOP/s"
        for one in report["limits"].values()
    ]
    rows = [row for entries in report["sweeps"].values() for entry in entries for row in entry["rows"]]
    parts = [machine_line(report) + scaling_line(rows)]
    if limits:
        parts.append(f"At best: {'; '.join(limits)}.")
    wholes = ("frame", "raster/both")
    for name, entries in report["sweeps"].items():
        head = [name, "pairs", "splats a covered pixel"]
        for whole in wholes:
            head += [f"{whole}, median ms", "limit ms"]
        lines = []
        for entry in entries:
            first = entry["rows"][0]
            line = [f"{entry['point']:,}", f"{first['pairs']:,}", number(first["contributors"])]
            for whole in wholes:
                row = next(row for row in entry["rows"] if row["name"] == whole)
                limit = None if entry["limits"] is None else entry["limits"][whole]
                line += [number(row["ms_median"]), number(limit, 2)]
            lines.append(line)
        parts.append(table(head, lines))
    return "\n\n".join(parts)


def speed_overview(results: Path) -> str:
    """Write the overview from the results of the other tables; cells stay empty where one is missing."""
    lines, older = [], []
    for text, name, whole in (
        ("a whole dynamic frame, 512 control points, the network evaluated for every frame", "frame-cpu", "frame"),
        ("of which motion (network and skinning)", "frame-cpu", None),
        ("the same frame with poses kept and interpolated (`Scene.prepare_playback`)", "playback-cpu", "frame"),
        ("rasterising, forward", "raster-cpu", "raster/forward"),
        ("rasterising, forward and all gradients", "raster-cpu", "raster/both"),
        ("a training step, 40,000 Gaussians, 400 x 400", "step-cpu", "step"),
        ("a training step, 500,000 Gaussians, 1920 x 1080", "step-500k-cpu", "step"),
        ("editing, from a drag to the pose that a page draws", "edit-cpu", "edit/drag"),
        ("a dynamic frame of 1,000,000 Gaussians at 1920 x 1080", "million-cpu", "frame"),
    ):
        path = results / f"{name}.json"
        report: Report = {"rows": [], "motion": []}
        if path.is_file():
            report = json.loads(path.read_text(encoding="utf-8"))
        rows = report["rows"] if whole else report["motion"]
        times = {}
        for row in reversed(rows):  # the first model of motion counts
            if whole is None or row["name"] == whole:
                times[row["threads"]] = row["ms_median"]
        if changed_since(report.get("commit"), BENCHMARKS[name].measures):
            text = f"{text} {OLDER}"
            older.append(report["commit"])
        lines.append([text, *(f"{number(times[count])} ms" if count in times else "" for count in (1, 2))])
    return "\n\n".join(part for part in (table(["", "1 thread", "2 threads"], lines), older_note(older)) if part)


def one_thread_ratio(report: Report, key: str) -> float | None:
    """Return a ratio of speeds on one thread; of a report on motion models, that of ``control-points``."""
    if "ratios" in report:
        return report["ratios"][key]
    rows = report.get("table_s2") or report["motion"]
    return next(row[key] for row in rows if row["motion"] == "control-points" and row["threads"] == 1)


def speed_ratios(results: Path) -> str:
    """Write how many times as fast one thread is as that of others; cells stay empty where a result is missing."""
    lines, older = [], []
    for text, name, key in (
        ("rasterising, forward, beside OpenSplat's CPU rasteriser", "opensplat", "forward"),
        ("rasterising, forward and all gradients, beside OpenSplat's CPU rasteriser", "opensplat", "both"),
        ("a whole dynamic frame beside that of a static scene", "frame-cpu", "ratio_to_static"),
        ("a frame with poses kept and interpolated, beside that of a static scene", "playback-cpu", "ratio_to_static"),
        ("a whole dynamic frame beside that of `per-gaussian`", "table-s2-cpu", "ratio_to_per_gaussian"),
    ):
        path = results / f"{name}.json"
        report = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
        if report and changed_since(report["commit"], BENCHMARKS[name].measures):
            text = f"{text} {OLDER}"
            older.append(report["commit"])
        lines.append([text, number(report and one_thread_ratio(report, key), 2)])
    head = ["on one thread", "times as fast"]
    return "\n\n".join(part for part in (table(head, lines), older_note(older)) if part)


class Benchmark(NamedTuple):
    """Writer of a table of timings, and the source of its results."""

    write: Callable[[Report], str]
    command: str
    """Command that measures the results, without ``--json``."""
    measures: tuple[str, ...] = RENDERING
    """Folders with the code that is timed."""


BENCHMARKS = {
    "frame-cpu": Benchmark(stages, "apps/bench.py frame --motion control-points,static"),
    "playback-cpu": Benchmark(stages, "apps/bench.py frame --playback --motion control-points,static"),
    "raster-cpu": Benchmark(stages, "apps/bench.py raster"),
    "step-cpu": Benchmark(stages, "apps/bench.py step --gaussians 40000 --size 400", TRAINING),
    "step-500k-cpu": Benchmark(stages, "apps/bench.py step --gaussians 500000 --size 1920x1080", TRAINING),
    "edit-cpu": Benchmark(stages, "apps/bench.py edit", EDITING),
    "pull-cpu": Benchmark(stages, "apps/bench.py pull", EDITING),
    "table-s2-cpu": Benchmark(table_s2, "apps/bench.py frame --table-s2"),
    "million-cpu": Benchmark(stages, "apps/bench.py frame --gaussians 1000000 --size 1920x1080"),
    "opensplat": Benchmark(opensplat, "benchmarks/opensplat.py CHECKOUT"),
    "scaling-cpu": Benchmark(scaling, "apps/bench.py scaling"),
}


def timing_table(name: str, results: Path) -> str:
    """Write a result below the command that produced it; without a result, write the command to run."""
    benchmark, path = BENCHMARKS[name], results / f"{name}.json"
    if not path.is_file():
        return f"Not measured yet: `python {benchmark.command} --json benchmarks/results/{name}.json`"
    report = json.loads(path.read_text(encoding="utf-8"))
    older = changed_since(report.get("commit"), benchmark.measures)
    parts = [f"`{report['command']}`" + (f" {OLDER}" if older else ""), benchmark.write(report)]
    return "\n\n".join([*parts, older_note([report["commit"]])] if older else parts)
