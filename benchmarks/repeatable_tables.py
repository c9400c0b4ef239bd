"""Writers of the tables in docs/scaling.md, docs/editing.md, docs/mesh.md, docs/page.md, docs/capture.md and
docs/trust.md whose results can be measured again with committed scripts (for those on parts and poses, see
``posing_tables.py``).

Until all results of a table are there, the reported table stands in its place. A column NAME of the tables of sharing
comes from ``results/sharing-NAME.json``, one-process runs from ``results/sharing-NAME-alone.json``:

    torchrun --standalone --nproc-per-node 2 benchmarks/sharing.py --size 200 --steps 25 --threads 1 \\
        --json benchmarks/results/sharing-200.json
    python benchmarks/sharing.py --size 400 --steps 25 --threads 1 --json benchmarks/results/sharing-400-alone.json

The table of edits comes from ``results/edit-cpu.json`` and ``results/edit-4096-cpu.json`` (``apps/bench.py edit``, with
and without ``--nodes 4096``), that of meshes from ``results/mesh-distance.json`` (``mesh_distance.py``), that of edges
of masks from ``results/mask-edges.json`` (``mask_edges.py``), that of optical flow from ``results/optical-flow.json``
(``optical_flow.py``), those of a filmed room from ``results/filmed-room.json`` (``filmed_room.py``), that of true shape
and motion from ``results/film-limits-FILM.json`` (``film_limits.py``), that of means from ``results/mean-of-runs.json``
(``mean_of_runs.py``), that of long films from ``results/long-film-memory.json`` (``long_film.py memory``), that of
zeros in ``docs/benchmarks.md`` from ``results/network-zeros.json`` (``network_zeros.py``). Those of pages come from
``results/page-million.json`` (``page_frames.py``) and ``results/live-cost.json`` (``live_cost.py``), and that of soaks
from ``results/chaos-PART.json`` (``chaos.py --part PART --minutes 118``).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from markdown_table import number, table
from posing_tables import bones_shown, gestures, parts_found, pictures
from provenance import EDITING, MESHES, OLDER, TRAINING, changed_since, older_note
from timing_tables import machine_line

COLUMNS = {"200": "200 x 200", "400": "400 x 400", "800": "800 x 800", "400-300k": "400 x 400, 300,000 Gaussians"}
ALONE = ("400", "400-300k")

Results = dict[str, dict[str, Any]]
"""Results by the names of their files."""


def processor_ms(result: dict[str, Any], *names: str) -> float:
    """Add up the processor time of some parts of a step."""
    return sum(row["cpu_ms"] for row in result["rows"] if row["name"] in names)


def sharing_steps(results: Results) -> str:
    """Write the processor time of the parts of a step shared by two processes."""
    shared = [results[f"sharing-{name}"] for name in COLUMNS]
    moved = ("exchange", "join")
    alone = [f"{processor_ms(results[f'sharing-{n}-alone'], 'step'):.0f} ms" if n in ALONE else "" for n in COLUMNS]
    rest = [processor_ms(one, "step") - processor_ms(one, "view", *moved) for one in shared]
    lines = [
        ["one view, forward and backward", *(f"{processor_ms(one, 'view'):.0f} ms" for one in shared)],
        [
            "moving and adding gradients (`exchange`, `join`)",
            *(f"{processor_ms(one, *moved):.0f} ms" for one in shared),
        ],
        ["averaging, Adam, statistics", *(f"{value:.0f} ms" for value in rest)],
        ["the whole step", *(f"{processor_ms(one, 'step'):.0f} ms" for one in shared)],
        ["the whole step with one process and one view", *alone],
        ["bytes received per process", *(f"{one['mib_per_step']:.1f} MiB" for one in shared)],
    ]
    return table(["processor time", *COLUMNS.values()], lines)


def sharing_memory(results: Results) -> str:
    """Write the peaks of resident memory of one process, and of each of two."""
    lines = []
    for name, text in zip(ALONE, ("49,000 Gaussians, 400 x 400", "300,000 Gaussians, 400 x 400")):
        peaks = (results[f"sharing-{name}-alone"]["peak_mib"], results[f"sharing-{name}"]["peak_mib"])
        lines.append([text, *(f"{peak:,.0f} MiB" for peak in peaks)])
    return table(["peak of resident memory", "one process", "each of two"], lines)


def edit_updates(results: Results) -> str:
    """Write the cost of an update of the editor for two numbers of control points, on one thread."""
    lines = []
    for result in results.values():
        times = {row["name"]: row["ms_median"] for row in result["rows"] if row["threads"] == 1}
        pose, solve, picture = (times[name] for name in ("edit/drag", "edit/drag/solve", "edit/picture"))
        count = f"{result['rows'][0]['control_points']:,}"
        lines.append([count, *(f"{number(value)} ms" for value in (pose, solve, picture))])
    return table(["control points", "from a drag to the pose a page draws", "of which solve", "to a picture"], lines)


def mesh_distance(results: Results) -> str:
    """Write the distances of exported meshes from true surfaces."""
    lines = []
    for row in results["mesh-distance"]["rows"]:
        pairs = ((row[f"{way}_mean"], row[f"{way}_p95"]) for way in ("to_mesh", "to_true"))
        told = [f"{mean:.2f} %, {most:.2f} %" for mean, most in pairs]
        lines.append([row["subject"], row["mesh"], f"{row['time']:g}", f"{row['faces']:,}", *told])
    return table(["subject", "mesh", "time", "triangles", "from the true surface", "from the mesh"], lines)


def mask_edges(results: Results) -> str:
    """Write how far masks agree with true ones, before and after filters that follow the edges of the image."""
    rows = results["mask-edges"]["rows"]
    kinds = {
        "found": "found by the capture", "coarse": "true, drawn at an eighth of the size",
        "outside": "true, outline 4 pixels outside", "inside": "true, outline 4 pixels inside",
    }  # fmt: skip
    filters = {
        "none": "as it is", "guided": "guided filter", "weighted-median": "weighted median", "grab-cut": "grabCut"
    }  # fmt: skip
    shares = {(row["masks"], row["filter"]): row["overlap"] for row in rows}
    lines = [[text, *(f"{100 * shares[kind, name]:.0f} %" for name in filters)] for kind, text in kinds.items()]
    return table(["mask", *filters.values()], lines)


def mean_of_runs(results: Results) -> str:
    """Write the scores of single runs and of the means of several."""
    lines = []
    for row in results["mean-of-runs"]["rows"]:
        runs = "one run" if row["runs"] == 1 else f"mean of {row['runs']}"
        lines.append([row["scene"], runs, f"{row['psnr']:.2f}", f"{row['worst']:.2f}", f"{row['ssim']:.4f}"])
    return table(["scene", "shown", "PSNR, dB", "worst image, dB", "SSIM"], lines)


def optical_flow(results: Results) -> str:
    """Write how far measured flow is from the truth, and what it costs."""
    lines = []
    for row in results["optical-flow"]["rows"]:
        errors = (f"{row[name]:.2f}" for name in ("error", "error_moving", "error_trusted"))
        lines.append([row["flow"], *errors, f"{100 * row['trusted']:.0f} %", f"{row['ms']:,.0f} ms"])
    return table(["flow", "error, pixels", "of what moves", "of what is trusted", "trusted", "processor time"], lines)


CAPTURES = {
    "room": "default number of frames",
    "room-no-masks": "default number, `--masks none`",
    "room-75": "`--frames 75`",
}
"""Captures of the film of the room, by the names of their folders."""


def film_captures(results: Results) -> str:
    """Write how far the cameras of captures of one film are from the truth, before and after their adjustment."""
    lines = []
    for row in results["filmed-room"]["captures"]:
        errors = (f"{100 * row[mean]:.3f} %, {100 * row[worst]:.2f} %" for mean, worst in
                  (("mapped_mean", "mapped_worst"), ("mean", "worst")))  # fmt: skip
        picked = [str(row["picked"]), str(row["registered"])]
        lines.append([CAPTURES[row["capture"]], *picked, *errors, f"{100 * row['focal']:+.2f} %"])
    head = ["capture", "picked", "registered", "centres off, as mapped", "adjusted", "focal length"]
    return table(head, lines)


def film_views(results: Results) -> str:
    """Write the scores of the held-out frames of a run on the film of the room."""
    one = results["filmed-room"]["views"]
    head = [f"{one['frames']} held-out frames, `{one['preset']} --steps {one['steps']}`", "PSNR"]
    lines = [
        ["whole", f"{one['psnr']:.2f} dB"],
        ["worst frame", f"{one['worst']:.2f} dB"],
        [f"the box, {100 * one['share']:.0f} % of the pixels", f"{one['box']:.2f} dB"],
        ["all but the box", f"{one['rest']:.2f} dB"],
    ]
    return table(head, lines)


def film_limits(results: Results) -> str:
    """Write what the pictures of a rig and of a phone give of held-out views if shape and motion are known."""
    lines = []
    for name, label in (("film-limits-rig", "rig, 8 degrees"), ("film-limits-phone", "phone")):
        one = results[name]
        scores = (number(one[part], 2) for part in ("psnr", "mover", "room"))
        lines.append([label, *scores, f"{100 * one['unseen']:.1f} %"])
    return table(["true shape and motion, colours of the film", "PSNR", "the robot", "the room", "not filmed"], lines)


def long_film_memory(results: Results) -> str:
    """Write how much memory reading a film takes, by its length."""
    lines = []
    for row in results["long-film-memory"]["rows"]:
        kept = f"up to {row['cache_mib']:,} MiB of images" + ("" if row["bounded"] else ", all silhouettes")
        sizes = (f"{row[name]:,.0f} MiB" for name in ("images_mib", "peak_mib"))
        lines.append([kept, f"{row['frames']:,}", *sizes])
    return table(["kept", "frames", "images in the cache", "peak of memory"], lines)


def page_million(results: Results) -> str:
    """Write how long a page of a million Gaussians takes to load, and a view to be drawn."""
    one = results["page-million"]
    lines = [
        ["size of the file", f"{one['file_mib']:.0f} MiB"],
        ["steps in which progress is shown", str(one["progress_steps"])],
        ["until it is read", f"{one['load_s']:.0f} s"],
        ["until the first picture is complete", f"{one['first_picture_s']:.0f} s"],
        ["another view, processor time", f"{one['cpu_s_per_view']:.1f} s"],
    ]
    head = f"{one['gaussians']:,} Gaussians that move, a window of {one['size']} x {one['size']}"
    return table([head, f"{one['browser'].split('.')[0]}, WebGL in software"], lines)


def live_cost(results: Results) -> str:
    """Write the ratio of the times of a training with and without a page."""
    one = results["live-cost"]
    lines = []
    for name, text in (("wall", "time"), ("processor", "processor time")):
        found = one[name]
        low, high = found["quartiles"]
        lines.append([text, f"{found['median']:.3f}", f"{low:.3f} to {high:.3f}", f"{found['of_sums']:.3f}"])
    head = f"with a page over without, {one['steps']:,} steps, {one['pictures']} pictures"
    note = f"The checkpoints {'have the same bits' if one['same_bits'] else 'differ'}."
    return table([head, f"median of {one['pairs']} pairs", "quartiles", "whole run"], lines) + f"\n\n{note}"


SOAKS = {
    "training": "training",
    "live": "training with an open page",
    "export": "exports",
    "editor": "the editor",
}
"""What ``chaos.py`` disturbs, by the names of its parts."""


def soaks(results: Results) -> str:
    """Write how many rounds of each kind of work were disturbed, and how many broke an invariant."""
    lines = []
    for part, text in SOAKS.items():
        one = results[f"chaos-{part}"]
        minutes = one["command"].partition("--minutes ")[2].split()[0]
        disturbed = one["rounds"] - one["faults"][part].get("none", 0)
        lines.append([text, f"{minutes} min", str(one["rounds"]), str(disturbed), str(len(one["broken"]))])
    return table(["work", "time", "rounds", "of them with a fault", "invariants broken"], lines)


def network_zeros(results: Results) -> str:
    """Write how many hidden values of trained networks, and of the synthetic scene's, are zero."""
    rows = results["network-zeros"]["rows"]
    trained, made = rows[:-1], rows[-1]

    def span(key: str) -> str:
        values = [row[key] for row in trained]
        return f"{100 * min(values):.0f} to {100 * max(values):.0f} %"

    lines = [
        ["hidden values that are zero", span("zeros"), f"{100 * made['zeros']:.0f} %"],
        ["columns that are zero in eight rows", span("columns"), f"{100 * made['columns']:.0f} %"],
    ]
    return table(["", f"{len(trained)} trained networks", "synthetic scene"], lines)


class Repeatable(NamedTuple):
    """A table, the names of its results, and the folders with the code that they measure."""

    write: Callable[[Results], str]
    results: tuple[str, ...]
    measures: tuple[str, ...]


REPEATABLE = {
    "scaling-step": Repeatable(
        sharing_steps, (*(f"sharing-{n}" for n in COLUMNS), *(f"sharing-{n}-alone" for n in ALONE)), TRAINING
    ),
    "scaling-memory": Repeatable(
        sharing_memory, (*(f"sharing-{n}" for n in ALONE), *(f"sharing-{n}-alone" for n in ALONE)), TRAINING
    ),
    "mesh-distance": Repeatable(mesh_distance, ("mesh-distance",), MESHES),
    "capture-mask-edges": Repeatable(mask_edges, ("mask-edges",), ("scgs_warp/capture/moving.py",)),
    "capture-optical-flow": Repeatable(optical_flow, ("optical-flow",), ("scgs_warp/geometry/optical_flow.py",)),
    "capture-films": Repeatable(film_captures, ("filmed-room",), ("scgs_warp/capture",)),
    "capture-film-views": Repeatable(film_views, ("filmed-room",), ("scgs_warp/capture", *TRAINING)),
    "capture-film-limits": Repeatable(
        film_limits, ("film-limits-rig", "film-limits-phone"), ("scgs_warp/data/synthetic/films",)
    ),
    "capture-long-films": Repeatable(
        long_film_memory, ("long-film-memory",), ("scgs_warp/training/silhouettes.py", "scgs_warp/data/cache.py")
    ),
    "posing-parts": Repeatable(
        parts_found,
        ("parts-figure", "parts-cpu", "parts-long", "parts-long-cpu", "parts-man", "parts-robot", "parts-robot-walk"),
        EDITING,
    ),
    "posing-bones": Repeatable(bones_shown, ("parts-long",), EDITING),
    "posing-gestures": Repeatable(gestures, ("posing-figure",), EDITING),
    "posing-gestures-long": Repeatable(gestures, ("posing-long",), EDITING),
    "posing-pictures": Repeatable(pictures, ("posing-pictures",), EDITING),
    "posing-pictures-long": Repeatable(pictures, ("posing-pictures-long",), EDITING),
    "page-million": Repeatable(page_million, ("page-million",), ("scgs_warp/export/web",)),
    "live-cost": Repeatable(live_cost, ("live-cost",), ("scgs_warp/live", "scgs_warp/training")),
    "trust-soaks": Repeatable(
        soaks, tuple(f"chaos-{part}" for part in SOAKS), ("scgs_warp/storage", "scgs_warp/editor", "scgs_warp/live")
    ),
    "network-zeros": Repeatable(network_zeros, ("network-zeros",), ("scgs_warp/benchmark/scenes.py",)),
    "quality-mean-of-runs": Repeatable(mean_of_runs, ("mean-of-runs",), TRAINING),
    "editing-updates": Repeatable(edit_updates, ("edit-cpu", "edit-4096-cpu"), EDITING),
}


def repeatable_table(name: str, folder: Path) -> str | None:
    """Write a table from its results; None unless all of them are there."""
    one = REPEATABLE[name]
    paths = {result: folder / f"{result}.json" for result in one.results}
    if not all(path.is_file() for path in paths.values()):
        return None
    results = {result: json.loads(path.read_text(encoding="utf-8")) for result, path in paths.items()}
    older = [result["commit"] for result in results.values() if changed_since(result["commit"], one.measures)]
    first = machine_line(next(iter(results.values()))) + (f" {OLDER}" if older else "")
    return "\n\n".join(part for part in (first, one.write(results), older_note(older)) if part)
