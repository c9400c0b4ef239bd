"""Tables whose rows are the subjects of the zoo and other scenes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from markdown_table import number, percent, signed, table, thousands

if TYPE_CHECKING:
    from quality_tables import Source

BALLS = ("balls", "balls-steady")
DNERF = ("jumpingjacks", "hook", "mutant", "standup")
ZOO = ("robot", "rods", "rods-dark", *BALLS, "cloth", "fan", "touch", "opening", "still", *DNERF, "handheld")


def change_of_defaults(source: Source) -> str:
    """Write mean and worst PSNR of each scene before and after a change of defaults, and the mean over several scenes.

    Runs with another seed are recorded as scenes of their own: ``hook-seed-1``.
    """
    every = [f"{scene}{seed}" for scene in ZOO for seed in ("", "-seed-1")]
    scenes = [scene for scene in every if source.run("before", scene) and source.run("after", scene)]
    rows = []
    for scene in scenes:
        before, after = source.run("before", scene), source.run("after", scene)
        pairs = [(before[key], after[key]) for key in ("psnr", "psnr_worst")]
        rows.append([value for old, new in pairs for value in (old, new, new - old)])
    if len(scenes) > 1:
        rows.append([math.fsum(column) / len(scenes) for column in zip(*rows)])
    marked = [source.label(row, row) for row in ("before", "after")]
    head = ["", *marked, "difference", *(f"worst image, {text}" for text in marked), "difference"]
    cells = [[signed(value) if i % 3 == 2 else number(value, 2) for i, value in enumerate(row)] for row in rows]
    names = [*(scene.replace("-seed-", ", seed ") for scene in scenes), "mean"]
    return table(head, [[name, *row] for name, row in zip(names, cells)])


def backgrounds(source: Source) -> str:
    """Write scores on black and on white, and the alpha outside the subject, without and with a background that changes
    in the main stage."""
    both = ("before", "after")
    scores = {"": "psnr", "worst image, ": "psnr_worst", "on white, ": "psnr_white"}
    rows = []
    for scene in (*ZOO, "rods-seed-1", "standup-seed-1", "player"):
        if all(source.run(row, scene) for row in both):
            runs = [source.run(row, scene) for row in both]
            cells = [number(run[key], 2) if key in run else "" for key in scores.values() for run in runs]
            outside = [percent(100 * run["extra"], 3) for run in runs]
            rows.append(
                [
                    scene.replace("-seed-", ", seed "),
                    *cells,
                    *outside,
                    *(thousands(run["gaussians"], 1) for run in runs),
                ]
            )
    marked = [source.label(row, row) for row in both]
    heads = (*scores, "alpha outside the subject, ", "Gaussians, ")
    return table(["", *(head + text for head in heads for text in marked)], rows)


ALTERNATIVES = {
    "fading": "ARAP that fades",
    "arap": "ARAP that spares no edge",
    "nodes-512": "512 control points",
    "progressive": "`--progressive`",
    "time-10": "10 frequencies of the time",
}
"""Other settings that were tried on single subjects, by the names of their rows."""


def zoo(source: Source) -> str:
    """Write the scores of every scene with the defaults, and the best of the other settings that were tried on it."""
    head = source.label("cpu", "PSNR")
    for row in ALTERNATIVES:
        source.label(row, "")
    lines = []
    for scene in ZOO:
        run = source.run("cpu", scene)
        if not run:
            continue
        tried = {row: own["psnr"] for row in ALTERNATIVES if (own := source.run(row, scene))}
        best = max(tried, key=tried.__getitem__, default=None)
        lines.append(
            [
                scene,
                number(run["psnr"], 2),
                number(run["psnr_median"], 2),
                f"{run['psnr_worst']:.2f} ({run['psnr_worst_time']:.2f})",
                percent(100 * run["missing"], 1),
                percent(run.get("epe"), 1),
                thousands(run["gaussians"], 1),
                ""
                if best is None
                else f"{signed(tried[best] - run['psnr'])} ({ALTERNATIVES[best]}; {len(tried)} tried)",
            ]
        )
    names = ["median", "worst (at t)", "missing", "motion error", "Gaussians", "best other setting"]
    return table(["", head, *names], lines)


def differences(source: Source) -> str:
    """Write the PSNR of the row ``none`` and, each change's differences from it where it was tried."""
    rows = dict.fromkeys(row for name, row, _ in source.runs if name == source.name)
    scenes = [scene for scene in (*DNERF, *ZOO[: -len(DNERF) - 1]) if source.run("none", scene)]
    lines = []
    for row in rows:
        runs = {scene: run for scene in scenes if (run := source.run(row, scene))}
        cells = []
        for scene in scenes:
            value, base = runs.get(scene, {}).get("psnr"), source.run("none", scene)["psnr"]
            cells.append(number(value, 2) if row == "none" or value is None else signed(value - base))
        lines.append([source.label(row, next(iter(runs.values()))["label"]), *cells])
    return table(["change", *scenes], lines)


def gallery(source: Source) -> str:
    """Write the scores of the runs whose films the gallery shows."""
    lines = []
    for scene in (*DNERF, "handheld", "man", "figure"):
        run = source.run("run", scene)
        if not run:
            continue
        cells = [number(run["psnr"], 2), number(run["psnr_worst"], 2), number(run["ssim"], 3)]
        lines.append([scene, *cells, thousands(run["gaussians"], 1), f"{run['step']:,}"])
    source.label("run", "")
    return table(["run", "PSNR", "worst image", "SSIM", "Gaussians", "steps"], lines)


def films(source: Source) -> str:
    """Write what initial points on the mover, and flow in the loss, do for two films."""
    rows = (
        ("off", "neither (`flow_points=0`)"),
        ("on", "points on the mover (default)"),
        ("flow", "and `loss.flow=2`"),
    )
    lines = []
    for row, label in rows:
        phone, hand = source.run(row, "phone"), source.run(row, "handheld")
        scores = (number(run.get(key), 2) for run in (phone, hand) for key in ("psnr", "psnr_worst"))
        lines.append([source.label(row, label), f"{number(phone.get('epe'), 1)} %", *scores])
    head = ["", "walking robot: motion error", "PSNR", "worst", "hand: PSNR", "worst"]
    return table(head, lines)


def depth(source: Source) -> str:
    """Write what depth maps do for a figure that walks before one camera."""
    rows = {
        "off": "maps are ignored (`loss.depth=0`, `flow_points=0`)",
        "true": "true maps",
        "wrong": "maps that are 4 % wrong",
        "random": "true maps, data without points: random ones",
        "mapped": "true maps, data without points: those of the maps",
    }
    lines = []
    for row, label in rows.items():
        run = source.run(row, "phone")
        scores = (number(run.get(key), 2) for key in ("psnr", "psnr_worst"))
        lines.append([source.label(row, label), f"{number(run.get('epe'), 1)} %", *scores])
    return table(["", "motion error", "PSNR", "worst"], lines)


def crossing(source: Source) -> str:
    """Write what neighbours of a moment do for a figure whose legs cross."""
    rows = {
        "cpu": "`cpu`, without a second try",
        "moment": "`cpu --progressive`, `pretrain.arap_by=moment`, `pretrain.arap_weight=0.03`",
        "auto": "**`cpu`**",
        "views-1": "`cpu --seed 1`, chosen by the training views alone",
        "auto-1": "**`cpu --seed 1`**",
    }
    lines = []
    for row, label in rows.items():
        run = source.run(row, "man")
        scores = [number(run.get(key), 2) for key in ("psnr", "psnr_worst")] + [thousands(run.get("gaussians"))]
        lines.append([source.label(row, label), f"{number(run.get('epe'), 2)} %", *scores])
    return table(["", "motion error", "PSNR", "worst", "Gaussians"], lines)


def motion_before_and_after(before: str, after: str) -> Callable[[Source], str]:
    """Return a writer of the motion error, where there is truth, and PSNR of scenes before and after a change.

    Args:
        before: the columns' name for the row ``before``, and ``after`` likewise.
    """

    def write(source: Source) -> str:
        rows = [source.label("before", before), source.label("after", after)]
        lines = []
        for scene in (*ZOO, "figure-seed-1", "balls-6000", "BrainStem"):
            runs = source.run("before", scene), source.run("after", scene)
            if all(runs):
                cells = [number(run.get(key), 2) for key in ("epe", "psnr", "psnr_worst") for run in runs]
                lines.append([scene.replace("-seed-", ", seed ").replace("-6000", ", 6,000 steps"), *cells])
        head = [f"{name}, {row}" for name in ("motion error, %", "PSNR", "worst image") for row in rows]
        return table(["", *head], lines)

    return write


def rig(source: Source) -> str:
    """Write how good the view of a camera that was held out is, by the angle between the cameras of a rig."""
    rows = {
        "20-before": "20 degrees, without stereo",
        "20": "20 degrees",
        "8-before": "8 degrees, without stereo",
        "8": "8 degrees",
        "8-long": "8 degrees, all 24,000 steps",
    }
    lines = []
    for row, label in rows.items():
        run = source.run(row, "robot")
        scores = (number(run.get(key), 2) for key in ("psnr", "psnr_worst"))
        lines.append([source.label(row, label), *scores, number(run.get("ssim"), 3)])
    return table(["angle between neighbours", "PSNR", "worst", "SSIM"], lines)


def clips(source: Source) -> str:
    """Write the scores of real clips, of which every eighth frame is held out."""
    lines = []
    for clip in ("duck", "train"):
        run = source.run("gpu", clip)
        found = f"{run['registered']} of {run['frames']}" if "frames" in run else ""
        scores = (number(run.get(key), 2) for key in ("psnr", "psnr_worst"))
        lines.append([source.label("gpu", clip), found, *scores, number(run.get("ssim"), 3)])
    return table(["clip", "cameras found", "PSNR", "worst", "SSIM"], lines)


def exposure(source: Source) -> str:
    """Write what affine colours per frame do for a film whose exposure changes."""
    keys, lines = ("psnr", "psnr_fitted", "psnr_interpolated"), []
    for row in ("clean", "without", "with"):
        run = source.run(row, "handheld")
        lines.append([source.label(row, run.get("label", row)), *(number(run.get(key), 2) for key in keys)])
    return table(["handheld", "PSNR", "fitted colour", "interpolated colour"], lines)
