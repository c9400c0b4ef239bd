"""Writers of the tables of docs/editing.md on parts and poses. Runs are those of the built-in figure with three seeds,
of the default number of steps (``fig``) and of six times as many (``long``), and with ``cpu``:

    python apps/train.py --preset quick --seed S --threads 1 --output fig-S
    python benchmarks/parts.py --run fig-0 fig-1 fig-2 --data data/figure --json benchmarks/results/parts-figure.json
    python benchmarks/posing.py --run fig-0 fig-1 fig-2 --json benchmarks/results/posing-figure.json
    python apps/train.py --preset cpu --seed S --threads 1 --output cpu-S
    python benchmarks/parts.py --run cpu-0 cpu-1 --data data/figure --json benchmarks/results/parts-cpu.json
    python apps/train.py --preset quick --steps 42000 --seed S --device cuda --output long-S
    python benchmarks/parts.py --run long-0 long-1 long-2 --data data/figure --json benchmarks/results/parts-long.json
    python benchmarks/posing.py --run long-0 long-1 long-2 --json benchmarks/results/posing-long.json
    python apps/train.py --preset quick --steps 42000 --threads 1 --output long-cpu
    python benchmarks/parts.py --run long-cpu --data data/figure --json benchmarks/results/parts-long-cpu.json
    python benchmarks/posing_pictures.py --run fig-0 fig-1 fig-2 --size 200 \\
        --json benchmarks/results/posing-pictures.json
    python benchmarks/posing_pictures.py --run long-0 long-1 long-2 --size 200 \\
        --json benchmarks/results/posing-pictures-long.json

and of two glTF characters, ``man`` and ``robot``, filmed by ``apps/synthesize.py --size 200 --train 150`` (``robot``
with ``--clip Robot_Dance``, ``robot-walk`` with ``--clip Robot_Walking``) and trained with ``--preset cpu --threads
1``, robots with ``--steps 6000`` (``man-1`` and ``robot-1`` with ``--seed 1``):

    python benchmarks/parts.py --run man man-1 --data data/man --mesh CesiumMan.glb \\
        --json benchmarks/results/parts-man.json
    python benchmarks/parts.py --run robot robot-1 --data data/robot --mesh RobotExpressive.glb \\
        --json benchmarks/results/parts-robot.json
    python benchmarks/parts.py --run robot-walk --data data/robot-walk --mesh RobotExpressive.glb \\
        --json benchmarks/results/parts-robot-walk.json
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from markdown_table import table

Results = dict[str, dict[str, Any]]

GESTURES = {
    "default": "one pull on the hand or foot",
    "least": "the least rigid turn that takes it there",
    "part": "the part turned about its joint",
    "point": "one point",
}


def parts_found(results: Results) -> str:
    """Write how well the parts and joints of each run agree with the true bones."""
    lines = []
    for result in results.values():
        for whole in (row for row in result["rows"] if row["bone"] == "all"):
            own = [row for row in result["rows"] if row["run"] == whole["run"] and row["bone"] != "all"]
            joints = sorted(row["joint_error"] for row in own if "joint_error" in row)
            axes = sorted(row["axis_error"] for row in own if "axis_error" in row)
            lines.append([
                whole["run"], f"{100 * whole['agreement']:.0f} %",
                _share(whole, "seen_agreement"), _share(whole, "tracked"), f"{whole['parts']} ({whole['bones']})",
                _spread(joints, " %"), _spread(axes, "°"), f"{whole['seconds']:.1f} s",
            ])  # fmt: skip
    head = [
        "run", "surface", "surface as seen", "trained motion", "parts (bones)", "joints off: median, largest",
        "axes off: median, largest", "found in",
    ]  # fmt: skip
    return table(head, lines)


def bones_shown(results: Results) -> str:
    """Write, for each bone of the figure, what the trained motion shows of it, for each run."""
    (result,), lines = results.values(), []
    rows = result["rows"]
    for bone in dict.fromkeys(row["bone"] for row in rows if row["bone"] != "all"):
        own = [row for row in rows if row["bone"] == bone]
        shares = [" ".join(f"{100 * row[name]:.0f}" for row in own) for name in ("tracked", "agreement")]
        trained = " ".join(f"{row['trained_turn']:.0f}" for row in own if "trained_turn" in row)
        turn = f"{own[0]['turn']:.0f}" if "turn" in own[0] else ""
        lines.append([bone, f"{100 * own[0]['points']:.0f}", turn, trained, *shares])
    head = [
        "bone", "share of the surface, %", "turns by, °", "trained: turns by, °",
        "trained: points that move with it, %", "parts: points that agree, %",
    ]  # fmt: skip
    return table(head, lines)


def _share(row: dict[str, Any], name: str) -> str:
    return f"{100 * row[name]:.0f} %" if name in row else ""


def _spread(values: list[float], unit: str) -> str:
    if not values:
        return ""
    return f"{values[len(values) // 2]:.1f}{unit}, {values[-1]:.1f}{unit} ({len(values)})"


def gestures(results: Results) -> str:
    """Write what the gestures do to the limbs, for each run."""
    (result,), lines = results.values(), []
    rows = result["rows"]
    for gesture, text in GESTURES.items():
        for limb in ("arm", "leg"):
            for degrees in sorted({row["degrees"] for row in rows}):
                key = (gesture, limb, degrees)
                own = [row for row in rows if (row["gesture"], row["limb"], row["degrees"]) == key]

                def cells(name: str, write: Callable[[float], str], own: list[dict[str, Any]] = own) -> str:
                    return " ".join(write(row[name]) for row in own if name in row)

                lines.append([
                    f"{text}: {limb}, {degrees}", cells("worst_edge", _percent),
                    cells("least_determinant", "{:.2f}".format), cells("limb_error", _percent),
                    cells("torso_moved", lambda value: f"{100 * value:.1f}"),
                ])  # fmt: skip
    return table(["gesture, degrees", "worst edge, %", "determinant", "error, %", "trunk, %"], lines, numbers=False)


def _percent(value: float) -> str:
    return f"{100 * value:.0f}"


def pictures(results: Results) -> str:
    """Write the PSNR of posed runs against ray-cast pictures of the same pose."""
    (result,) = results.values()
    rows = result["rows"]
    runs = list(dict.fromkeys(row["run"] for row in rows))
    unedited = {row["run"]: row["psnr_unedited"] for row in rows}
    lines = [["not posed", *[" ".join(f"{unedited[run]:.1f}" for run in runs)] * 3]]
    for limb, degrees in dict.fromkeys((row["limb"], row["degrees"]) for row in rows):
        own = {(r["run"], r["skin"]): r["psnr"] for r in rows if (r["limb"], r["degrees"]) == (limb, degrees)}
        skins = [" ".join(f"{own[run, skin]:.1f}" for run in runs) for skin in ("parts", "dual", "nodes")]
        lines.append([f"{limb}, {degrees}", *skins])
    return table(["joint, degrees", "`parts`", "`dual`", "`nodes`"], lines, numbers=False)
