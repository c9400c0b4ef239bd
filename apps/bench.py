"""Measure a frame, a rasterisation, a training step, or a drag or pull in the editor, by stages and by size."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from scgs_warp.apps.arguments import one_line_errors, program
from scgs_warp.apps.cli import Device, prepare, print_parts, run
from scgs_warp.errors import UserError

FIGURES = Path("docs/images")


@dataclass(frozen=True)
class Common:
    """Options of every benchmark."""

    gaussians: int | None = None
    """Number of Gaussians of the synthetic scene; 49,000 by default, the mean of the paper's D-NeRF scenes."""
    nodes: int | None = None
    """Number of control points of the synthetic scene; 512 by default."""
    size: str = "800"
    """Longer side of the images in pixels, or WIDTHxHEIGHT."""
    motion: str | None = None
    """Motion models, separated by commas: control-points (the default), per-gaussian, hexplane, static."""
    seconds: float = 2.0
    """Seconds to spend on each row; slow rows take longer, because each is repeated at least five times."""
    json: Path | None = None
    """Write all rows to this file, with command, date, commit and machine."""
    device: Device = "auto"
    """Where to compute; auto takes a GPU if there is one."""
    threads: int | None = None
    """CPU threads; by default everything is measured on one thread and on all."""
    memory_gib: float | None = None
    """Limit on memory in GiB (on a GPU, on the memory of the GPU); by default all free memory. Large images are drawn
    in bands, and what does not fit is refused with an error that names its size."""


@dataclass(frozen=True)
class Options(Common):
    """Options of benchmarks of one size."""

    run: Path | None = None
    """Run folder whose scene is measured instead of a synthetic one."""
    against: Literal["gsplat"] | None = None
    """Also time gsplat on the same Gaussians (only with raster, and only on a GPU)."""


@dataclass(frozen=True)
class Frame(Options):
    """Measure a frame of the moving scene: network, skinning, projection, harmonics, binning, compositing."""

    playback: bool = False
    """Keep the motion's poses and interpolate them, as for a scene that is played again and again."""
    table_s2: bool = False
    """Measure all four motion models, and compare their relative speeds with the paper's Table S2."""


@dataclass(frozen=True)
class Raster(Options):
    """Measure rasterising Gaussians at rest: forward, and forward with all gradients."""


@dataclass(frozen=True)
class Step(Options):
    """Measure a training step of the main stage, with and without the ARAP term."""


@dataclass(frozen=True)
class Edit(Options):
    """Measure a drag of a handle in the editor: to the pose that the page draws, and to a picture from the server."""

    size: str = "512"
    """Longer side of the picture in pixels, or WIDTHxHEIGHT."""


@dataclass(frozen=True)
class Pull(Edit):
    """Measure a pull of a part in the editor: to the pose that the page draws, and to a picture from the server."""


@dataclass(frozen=True)
class Scaling(Common):
    """Sweep frames and rasterisations over Gaussians, pixels, control points and threads; show the machine's limits."""

    sweeps: str = "gaussians,resolution,nodes,threads"
    """Quantities to vary, separated by commas, with optional values after a colon: nodes:64/128. Other quantities stay
    at --gaussians, --nodes, --size and all threads (or --threads)."""
    figures: Path = FIGURES
    """Folder for one figure per sweep: scaling-NAME.png."""


COMMANDS = {"frame": Frame, "raster": Raster, "step": Step, "edit": Edit, "pull": Pull, "scaling": Scaling}


def check(options: Common) -> None:
    """Refuse impossible options before anything is loaded.

    Raises:
        UserError: names the option and the remedy.
    """
    from scgs_warp.config.presets import MotionConfig
    from scgs_warp.storage.output_folders import refuse_inputs

    run, against = getattr(options, "run", None), getattr(options, "against", None)
    for name in ("gaussians", "nodes", "motion", "table_s2"):
        if run is not None and getattr(options, name, None) not in (None, False):
            raise UserError(f"--{name.replace('_', '-')}: the run in --run has its own; leave one of the two out")
    if getattr(options, "table_s2", False) and options.motion is not None:
        raise UserError("--motion: --table-s2 measures all four models; leave one of the two out")
    least = MotionConfig().neighbors + 1
    nodes = 512 if options.nodes is None else options.nodes
    gaussians = 49_000 if options.gaussians is None else options.gaussians
    if nodes < least:
        raise UserError(f"--nodes {nodes}: give at least {least}")
    if gaussians < nodes:
        raise UserError(f"--gaussians {gaussians}: give at least as many as there are control points ({nodes})")
    if not 0 <= options.seconds <= 600:
        raise UserError(f"--seconds {options.seconds:g}: give 0 to 600")
    if options.json is not None:
        refuse_inputs(options.json, [], run, "--json")
    if against is not None and not isinstance(options, Raster):
        raise UserError(f"--against {against}: it has no motion and no training step; compare with raster")


def show(report: dict[str, Any]) -> None:
    """Print the rows as a table."""
    from rich.table import Table

    machine = report["machine"]
    table = Table(title=f"{machine['gpu'] or machine['processor']}, {machine['cores']} cores")
    for column in ("name", "motion"):
        table.add_column(column, overflow="fold")
    for column in ("threads", "ms median", "ms min", "frames/s", "share", "extra MiB", "2-thread"):
        table.add_column(column, justify="right")
    several = len({row["renderer"] for row in report["rows"]}) > 1
    for row in report["rows"]:
        whole = row["share"] is None
        name = f"{row['renderer']} {row['name']}" if several else row["name"]
        table.add_row(
            name if whole else f"  {name}",
            row["motion"],
            str(row["threads"]),
            f"{row['ms_median']:.2f}",
            f"{row['ms_min']:.2f}",
            f"{row['fps']:.1f}" if whole else "",
            "" if whole else f"{100 * row['share']:.1f} %",
            f"{row['extra_mib']:,.0f}" if whole and row["extra_mib"] is not None else "",
            f"{row['two_thread_scaling']:.2f}" if whole else "",
        )
    first = report["rows"][0]
    about = (
        f"{first['gaussians']:,} Gaussians, {first['control_points']:,} control points, {first['width']} x "
        f"{first['height']}, {first['pairs']:,} pairs of splat and tile, "
        f"{first['contributors']:.1f} splats a covered pixel; the first model holds {first['model_mib']:,.1f} MiB"
    )
    notes = []
    if any(row["threads"] > 1 and row["two_thread_scaling"] < 1.8 for row in report["rows"] if row["device"] == "cpu"):
        notes = ["two threads were not twice as fast as one at plain arithmetic: take the one-thread rows"]
    print_parts(table, about, *notes, width=None if sys.stdout.isatty() else 120)


def show_motion(report: dict[str, Any]) -> None:
    """Print the cost of motion, and the speed relative to Gaussians at rest."""
    for cost in report["motion"]:
        rest = cost["ratio_to_static"]
        print(
            f"{cost['motion']}, {cost['threads']} threads: motion (network and skinning) takes "
            f"{cost['ms_median']:.2f} ms of a frame" + ("" if rest is None else f"; {rest:.2f} of static's frames/s")
        )


def show_table_s2(report: dict[str, Any]) -> None:
    """Print speeds relative to Gaussians at rest, here and in the paper."""
    for row in report["table_s2"]:
        print(
            f"{row['motion']}, {row['threads']} threads: {row['fps']:.1f} frames/s, {row['ratio_to_static']:.2f} of "
            f"static, {row['ratio_to_per_gaussian']:.2f} x per-gaussian (paper: {row['paper_fps']:.1f} frames/s, "
            f"{row['paper_ratio_to_static']:.2f}, {row['paper_ratio_to_per_gaussian']:.2f} x)"
        )


def show_scaling(report: dict[str, Any]) -> None:
    """Print the machine's limits, and the times of whole frames and rasterisations."""
    for limit in report["limits"].values():
        best = f"{limit['gigabytes']:.1f} GB/s copied, {limit['gigaflops']:.0f} GFLOP/s"
        print(f"at best, {limit['threads']} threads: {best}")
    for name, entries in report["sweeps"].items():
        for entry in entries:
            wholes = [row for row in entry["rows"] if row["share"] is None]
            texts = []
            for row in wholes:
                limit = "" if entry["limits"] is None else f" (limit {entry['limits'][row['name']]:.2f})"
                texts.append(f"{row['name']} {row['ms_median']:.2f} ms{limit}")
            print(f"{name} {entry['point']:,}: {', '.join(texts)}")


def measure(options: Options, plan: Any) -> dict[str, Any]:
    """Measure one size; return the report with its rows and their summaries."""
    from scgs_warp.benchmark import run as bench
    from scgs_warp.benchmark import summary

    report = bench.bench(type(options).__name__.lower(), plan)  # type: ignore[arg-type]
    if getattr(options, "table_s2", False):
        report["table_s2"] = summary.table_s2(report["compared"])
    return report


def main(args: list[str] | None) -> None:
    import tyro

    words = list(sys.argv[1:] if args is None else args)
    if words and not words[0].startswith("-") and words[0] not in COMMANDS:
        raise UserError(f"benchmark {words[0]}: choose one of {', '.join(COMMANDS)}")
    with one_line_errors("bench", words, *COMMANDS.values()):
        options: Common = tyro.extras.subcommand_cli_from_dict(
            COMMANDS, args=words, prog=program("bench"), description=__doc__
        )
    check(options)
    device = prepare(options.device, options.threads, options.memory_gib)
    if getattr(options, "playback", False) and device == "cuda":
        raise UserError("--playback: on a GPU frames are recorded with the network; leave the option out")

    from scgs_warp.benchmark import plot, scaling
    from scgs_warp.benchmark import run as bench
    from scgs_warp.benchmark.scenes import camera_size
    from scgs_warp.benchmark.summary import PAPER_FPS
    from scgs_warp.runtime.provenance import command_line

    table = isinstance(options, Frame) and options.table_s2
    plan = bench.BenchPlan(
        run=getattr(options, "run", None),
        gaussians=49_000 if options.gaussians is None else options.gaussians,
        nodes=512 if options.nodes is None else options.nodes,
        size=camera_size(options.size),
        motions=tuple(PAPER_FPS) if table else bench.check_motions(options.motion or "control-points"),
        device=device,
        threads=bench.thread_counts(options.threads, device),
        seconds=options.seconds,
        against=getattr(options, "against", None),
        playback=getattr(options, "playback", False),
        report=lambda text: print(text, file=sys.stderr, flush=True),
    )
    if isinstance(options, Scaling):
        report = scaling.scaling(plan, scaling.parse_sweeps(options.sweeps))
    else:
        assert isinstance(options, Options)
        report = measure(options, plan)
    if options.json is not None:
        command = command_line("apps/bench.py", sys.argv[1:] if args is None else args)
        bench.write({"command": command, **report}, options.json)
    if isinstance(options, Scaling):
        show_scaling(report)
        for path in plot.draw(report, options.figures):
            print(path)
        return
    show(report)
    if "motion" in report:
        show_motion(report)
    if table:
        show_table_s2(report)


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
