"""Tables of quality from ``results/quality/*.json``, and tables that were reported without a committed run.

A file in ``results/quality/`` holds one run, or fields that several runs share and a list ``runs``. A run has
``table``, ``row``, ``scene``, ``provenance`` (``measured`` or ``reported``), ``commit``, ``command``, ``processor`` and
the figures of ``metrics.json``; ``label`` is the text of a row for which the writer has none. A measured run replaces
the reported one of the same table, row and scene. A run of the scene ``mean`` holds the reported mean of a row whose
runs are not known to more digits; it counts until all scenes of the row are measured. Published figures come from
``results/literature/``. Reported runs of the preset ``paper`` are rows of ``best``, as it is called now.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from literature_tables import Column, Literature, literature_table, read_literature
from markdown_table import duration, number, percent, signed, table, thousands
from provenance import OLDER, REPORTED, TRAINING, changed_since, older_note, reported_note
from zoo_tables import (
    backgrounds,
    change_of_defaults,
    clips,
    crossing,
    depth,
    differences,
    exposure,
    films,
    gallery,
    motion_before_and_after,
    rig,
    zoo,
)

from scgs_warp.ablation.published import PUBLISHED_PSNR, TABLE_S1

DNERF = ("jumpingjacks", "hook", "mutant", "standup")
TWO = DNERF[:2]
ALL_DNERF = (*DNERF, "trex", "bouncingballs", "hellwarrior")
NERF_DS = ("as", "basin", "bell", "cup", "plate", "press", "sieve")
VRIG = ("broom", "3dprinter", "chicken", "peel-banana")
FORMER_ROWS = {"paper": "best", "paper-less-pruning": "best-less-pruning"}
"""Present names of the rows that reported runs call after the former name of a preset."""

Run = dict[str, Any]
Runs = dict[tuple[str, str, str], Run]
"""Runs by table, row and scene."""


def read_runs(results: Path) -> Runs:
    """Read all runs; a measured one replaces a reported one. Runs of a renamed row have the key ``formerly``."""
    runs: Runs = {}
    for path in sorted((results / "quality").glob("*.json")):
        values = json.loads(path.read_text(encoding="utf-8"))
        shared = {key: value for key, value in values.items() if key != "runs"}
        for own in values.get("runs", [{}]):
            run = {**shared, **own}
            if run["provenance"] == "reported" and run["row"] in FORMER_ROWS:
                run = {**run, "row": FORMER_ROWS[run["row"]], "formerly": "paper"}
            key = run["table"], run["row"], run["scene"]
            if key not in runs or run["provenance"] == "measured":
                runs[key] = run
    return runs


class Source:
    """The runs of one table, and the marks of the rows that were written from them."""

    def __init__(self, runs: Runs, name: str, literature: Literature | None = None) -> None:
        self.runs, self.name, self.literature = runs, name, literature
        self.reported: list[str] = []
        self.older: list[str] = []

    def run(self, row: str, scene: str) -> Run:
        return self.runs.get((self.name, row, scene), {})

    def mean(self, row: str, scenes: Iterable[str], key: str) -> float | None:
        """Return the mean of ``key`` over ``scenes``: the reported one, unless every scene is measured."""
        own = [self.run(row, scene) for scene in scenes]
        if all(run.get("provenance") == "measured" for run in own) or (self.name, row, "mean") not in self.runs:
            values = [run.get(key) for run in own]
            return None if None in values else math.fsum(values) / len(values)  # type: ignore[arg-type]
        return self.run(row, "mean").get(key)

    def label(self, row: str, text: str) -> str:
        """Add the former name of the row's preset and the marks of its runs to ``text``, and remember their commits for
        the notes."""
        runs = [run for (name, own, _), run in self.runs.items() if (name, own) == (self.name, row)]
        text += "".join(f", then called `{name}`" for name in {run["formerly"] for run in runs if "formerly" in run})
        reported = [run["commit"] for run in runs if run["provenance"] == "reported"]
        measured = (run["commit"] for run in runs if run["provenance"] == "measured")
        older = [commit for commit in measured if changed_since(commit, TRAINING)]
        self.reported += reported
        self.older += older
        return text + (f" {REPORTED}" if reported else "") + (f" {OLDER}" if older else "")

    def notes(self) -> str:
        return "\n\n".join(note for note in (reported_note(self.reported), older_note(self.older)) if note)


def training_time(run: Run) -> str:
    """Write the duration and the make of the processor."""
    return f"{duration(run['seconds'])} ({run['processor'].split()[0].strip(',')})" if "seconds" in run else ""


def cost(run: Run) -> str:
    """Write time and make of the processor, if the machine was quiet, and the number of Gaussians."""
    return ", ".join(filter(None, [training_time(run), thousands(run["gaussians"])])) if run else ""


def beside(columns: tuple[Column, ...], rows: tuple[tuple[str, str], ...]) -> Callable[[Source], str]:
    """Make a writer for scores of this project below published figures.

    Args:
        columns: scenes, and tuples of scenes whose mean is shown.
        rows: names and texts of this project's rows; scenes without a run are ``not run``.
    """
    scenes = [column for column in columns if isinstance(column, str)]

    def cell(source: Source, row: str, column: Column) -> str:
        if isinstance(column, str):
            return number(source.run(row, column).get("psnr"), 2) or "not run"
        if column == DNERF:
            return number(source.mean(row, DNERF, "psnr"), 2)
        values = [run["psnr"] for scene in column if (run := source.run(row, scene))]
        return number(math.fsum(values) / len(values), 2) if len(values) == len(column) else ""

    def ssim(source: Source, row: str) -> str:
        values = [run["ssim"] for scene in scenes if "ssim" in (run := source.run(row, scene))]
        count = "" if len(values) == len(scenes) else f" ({len(values)} {'scenes' if len(values) > 1 else 'scene'})"
        return number(math.fsum(values) / len(values), 3) + count if values else ""

    def write(source: Source) -> str:
        own = [
            [source.label(row, text), *(cell(source, row, column) for column in columns), ssim(source, row)]
            for row, text in rows
        ]
        return literature_table(source.literature, columns, own)

    return write


OWN_ROWS = (
    ("cpu", "**`cpu`** (24,000 steps, two CPU cores)"),
    ("hexplane", "`hexplane` (4D-GS's model, `cpu` with 12,000 steps, one CPU core)"),
    ("best-spared", "**`best`** (40,000 steps, one CPU core)"),
    ("best-40000", "`best` before rigidity spared edges (two CPU cores)"),
    ("best-40000-seed-1", "`best` with `--seed 1`"),
    ("best-h200", "`best` on a GPU (three of the scenes beside six other runs)"),
    ("best-today", "`best` as it was with 80,000 steps (one CPU core)"),
    ("best", "`best` as it was with 80,000 steps (one CPU core)"),
    ("best-less-pruning", "`best` with `densify.min_contribution=0.02`"),
    ("paper", "`paper` (the supplement's schedule, 80,000 steps)"),
)
"""Rows of this project on D-NeRF at 400 x 400."""


def own_cost(source: Source) -> str:
    """Write the cost of the rows ``OWN_ROWS``."""
    published = Source(source.runs, "published")
    lines = [
        [published.label(row, text), *(cost(published.run(row, scene)) for scene in DNERF)]
        for row, text in OWN_ROWS
        if any("seconds" in published.run(row, scene) for scene in DNERF)
    ]
    source.reported, source.older = published.reported, published.older
    return table(["time, processor, Gaussians", *DNERF], lines)


def node_counts(source: Source) -> str:
    """Write the quality for each number of control points beside the supplement's Table S1."""
    lines = []
    for count in ("64", "128", "256", "512", "1024", "2048", "4096"):
        own, before = source.run(count, "mean"), source.run(f"{count}-before", "mean")
        published = TABLE_S1[count]
        source.label(f"{count}-before", "")
        text = source.label(count, count) if own else f"{count} {REPORTED}"
        lines.append(
            [
                f"{text} (jumpingjacks alone)" if before.get("scenes") == 1 else text,
                number(own.get("control_points"), 0),
                number(before.get("control_points"), 0),
                number(own.get("gaussians"), 0),
                number(own.get("psnr"), 2),
                number(before.get("psnr"), 2),
                number((own or before).get("seconds"), 0),
                number(published["control_points"], 0),
                number(published["psnr"], 2),
            ]
        )
    head = ["asked", "final", "strays kept: final", "Gaussians", "PSNR", "strays kept: PSNR", "seconds"]
    return table([*head, "published: final", "published: PSNR"], lines)


def motion_models(source: Source) -> str:
    """Write the table of motion models: control points and their rivals, trained for equally many steps."""
    ours = source.mean("control-points", TWO, "psnr")
    published = {row: math.fsum(known[scene] for scene in TWO) / 2 for row, known in PUBLISHED_PSNR.items()}
    lines = []
    for row, text in (
        ("static", "static (3D-GS; published at 800 x 800)"),
        ("hexplane", "`hexplane` (4D-GS)"),
        ("per-gaussian", "`per-gaussian` (the paper's baseline)"),
        ("control-points", "**control points**"),
    ):
        mean = source.mean(row, TWO, "psnr")
        rival = row != "control-points" and mean is not None and ours is not None
        theirs = number(published[row], 2)
        lines.append(
            [
                source.label(row, text),
                *(number(source.run(row, scene).get("psnr"), 2) for scene in TWO),
                number(mean, 2),
                signed(ours - mean) if rival else "",  # type: ignore[operator]
                number(source.mean(row, TWO, "ssim"), 3),
                thousands(source.mean(row, TWO, "gaussians"), 1),
                number(source.mean(row, TWO, "seconds"), 0),
                f"{theirs}, {signed(published['control-points'] - published[row])}" if rival else theirs,
            ]
        )
    head = ["PSNR in dB", *TWO, "mean", "lead of control points", "SSIM", "Gaussians", "seconds"]
    return table([*head, "published: mean, lead"], lines)


def arap(source: Source) -> str:
    """Write the table of the ARAP ablation, for scenes whose true motion is known."""
    base = source.run("per-gaussian", "figure")
    lines = []
    for row, text in (
        ("on", "**control points, ARAP**"),
        ("off", "control points without ARAP"),
        ("per-gaussian", "one network query per Gaussian (the paper's baseline)"),
    ):
        run = source.run(row, "figure")
        shares = {key: number(run[key] / base[key], 2) if run and run is not base else "" for key in ("epe", "jitter")}
        lines.append(
            [
                source.label(row, text),
                number(run.get("psnr"), 2),
                number(run.get("ssim"), 3),
                percent(run.get("epe"), 2),
                shares["epe"],
                percent(run.get("jitter"), 3),
                shares["jitter"],
                thousands(run.get("gaussians")),
            ]
        )
    share = "ratio to baseline"
    return table(["", "PSNR", "SSIM", "motion error", share, "jitter", share, "Gaussians"], lines)


def changes(scenes: tuple[str, ...], base: str) -> Callable[[Source], str]:
    """Make a writer for a table whose rows each change one setting of the row ``base``.

    Args:
        scenes: columns of the table.
        base: the row that the others are compared with, or ``TABLE/ROW``.
    """

    def write(source: Source) -> str:
        name, _, row = base.rpartition("/")
        origin = Source(source.runs, name or source.name)
        rows = dict.fromkeys(own for name, own, _ in source.runs if name == source.name)
        lines = []
        counted = any(source.mean(own, scenes, "gaussians") is not None for own in rows)
        for own in rows:
            first = next(run for (name, of, _), run in source.runs.items() if (name, of) == (source.name, own))
            mean = source.mean(own, scenes, "psnr")
            compared = first.get("against")
            other, _, its = (compared or "").rpartition("/")
            reference = Source(source.runs, other).mean(its, scenes, "psnr") if compared else None
            reference = origin.mean(row, scenes, "psnr") if reference is None else reference
            reported = source.run(own, "mean").get("difference")
            alone = (source.name, own) == (origin.name, row) or mean is None or reference is None
            difference = None if alone else reported if reported is not None else mean - reference  # type: ignore[operator]
            line = [
                source.label(own, first.get("label", own)),
                *(number(source.run(own, scene).get("psnr"), 2) for scene in scenes),
                number(mean, 2),
                signed(difference),
            ]
            lines.append([*line, thousands(source.mean(own, scenes, "gaussians"))] if counted else line)
        head = ["change", *scenes, "mean", "difference"]
        return table([*head, "Gaussians"] if counted else head, lines)

    return write


def levers(source: Source) -> str:
    """Write each change with its scores and the differences from the row ``none`` or the one in ``against``, scene by
    scene: most were tried on few scenes."""
    rows = dict.fromkeys(row for name, row, _ in source.runs if name == source.name)
    lines = []
    for row in rows:
        cells, first = [], {}
        for scene in TWO:
            run = source.run(row, scene)
            first = first or run
            base = source.run(run.get("against", "none"), scene)
            known = run and row != "none" and "psnr" in base
            cells += [number(run.get("psnr"), 2), signed(run["psnr"] - base["psnr"]) if known else ""]
            cells.append(thousands(run.get("gaussians"), 1))
        lines.append([source.label(row, first["label"]), *cells])
    return table(["change", *(head for scene in TWO for head in (scene, "difference", "Gaussians"))], lines)


def overview(source: Source) -> str:
    """Write the overview from the runs of the other tables."""
    lines = []
    owners = {name: Source(source.runs, name) for name in ("arap", "published", "overview")}
    source.label("figure", "")
    for row, scene, text in (
        ("arap/on", "figure", "built-in scene, 400 x 400, `quick` (7,000 steps)"),
        ("overview/long", "figure", "built-in scene, 400 x 400, `quick --steps 21000`"),
        *(("published/cpu", scene, f"D-NeRF {scene}, `--downscale 2`, `cpu` (24,000 steps)") for scene in DNERF),
        *(
            ("published/best-spared", scene, f"D-NeRF {scene}, `--downscale 2`, `best` (40,000 steps)")
            for scene in DNERF
            if ("published", "best-spared", scene) in source.runs
        ),
        ("published/handheld", "handheld", "handheld, a real film, `--downscale 2`, `cpu --steps 6000`"),
    ):
        name, _, own = row.partition("/")
        run = source.runs.get((name, own, scene), {})
        motion = f"{percent(run['epe'], 2)}, jitter {percent(run['jitter'], 3)}" if "epe" in run else ""
        timed = run if "seconds" in run else source.run(scene, scene)
        lines.append(
            [
                owners[name].label(own, text),
                f"{number(run['psnr'])} dB" if run else "",
                number(run.get("ssim"), 3),
                motion,
                training_time(timed),
            ]
        )
    for owner in owners.values():
        source.reported += owner.reported
        source.older += owner.older
    return table(["", "PSNR", "SSIM", "motion error", "training"], lines)


WRITERS: dict[str, Callable[[Source], str]] = {
    "published": beside((*DNERF, DNERF, *ALL_DNERF[4:], ALL_DNERF), OWN_ROWS),
    "published-cost": own_cost,
    "published-800": beside((*DNERF, DNERF, *ALL_DNERF[4:], ALL_DNERF), (("cpu", "**`cpu`**"),)),
    "published-nerf-ds": beside((*NERF_DS, NERF_DS), (("cpu", "**`cpu`**"),)),
    "published-hypernerf": beside((*VRIG, VRIG), (("cpu", "**`cpu`**"),)),
    "nodes": node_counts,
    "motion": motion_models,
    "arap": arap,
    "defaults": change_of_defaults,
    "tints": change_of_defaults,
    "log-error": change_of_defaults,
    "correctives": change_of_defaults,
    "sharpness": change_of_defaults,
    "fast-parts": change_of_defaults,
    "halved": change_of_defaults,
    "halved-longer": change_of_defaults,
    "faint": change_of_defaults,
    "background": backgrounds,
    "levers": levers,
    "levers-today": differences,
    "low-rank": differences,
    "spared": differences,
    "spared-short": differences,
    "exposure": exposure,
    "films": films,
    "rig": rig,
    "depth": depth,
    "crossing": crossing,
    "second-try": motion_before_and_after("one try", "two tries"),
    "body-turn": motion_before_and_after("without the turn", "with the turn"),
    "turns": motion_before_and_after("without turns", "with turns"),
    "clips": clips,
    "gallery": gallery,
    "zoo": zoo,
    "parts": changes(TWO, "none"),
    "parts-shading": changes(TWO, "parts/shading"),
    "parts-threshold": changes(TWO, "parts-shading/threshold"),
    "parts-settling": changes(("mutant", "standup"), "none"),
    "parts-pruning": changes(TWO, "none"),
    "overview": overview,
}
"""Writers by the name of the table, which the pages call ``quality-NAME``."""


def quality_table(name: str, results: Path) -> str:
    source = Source(read_runs(results), name, read_literature(results, name))
    text = WRITERS[name](source)
    return "\n\n".join(part for part in (text, source.notes()) if part)
