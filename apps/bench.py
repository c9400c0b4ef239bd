"""Measure what a frame, a rasterisation or a training step costs, and which stage takes how much of it."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from scgs_warp.apps.cli import Device, prepare, run

LARGEST = 8192


@dataclass(frozen=True)
class Options:
    """What every benchmark takes."""

    run: Path | None = None
    """Measure this run's scene instead of a synthetic one."""
    gaussians: int | None = None
    """Size of the synthetic scene; 49,000 by default, the mean of the paper's D-NeRF scenes."""
    nodes: int | None = None
    """Control points of the synthetic scene; 512 by default."""
    size: int = 800
    """Longer side of the images in pixels."""
    motion: str | None = None
    """Motion models, with commas between: control-points, per-gaussian, hexplane, static. control-points by default."""
    against: Literal["gsplat"] | None = None
    """Time gsplat on the same Gaussians beside this project; raster alone, on a GPU."""
    seconds: float = 2.0
    """How long each row is measured; slow ones take longer, for five repeats."""
    json: Path | None = None
    """Write all rows, with date and machine, to this file."""
    device: Device = "auto"
    """Where to compute; auto takes a GPU if there is one."""
    threads: int | None = None
    """CPU threads; by default everything is measured on one and on all."""


@dataclass(frozen=True)
class Frame(Options):
    """A frame of the moving scene: network, skinning, projection, harmonics, binning, compositing."""

    table_s2: bool = False
    """All four motion models, and their speeds relative to each other beside those of the paper's Table S2."""


@dataclass(frozen=True)
class Raster(Options):
    """Rasterising Gaussians that stand still: forward, and forward with all gradients."""


@dataclass(frozen=True)
class Step(Options):
    """A training step of the joint phase, with and without the ARAP term."""


COMMANDS = {"frame": Frame, "raster": Raster, "step": Step}


def check(options: Options) -> None:
    """Refuse what cannot work before anything is loaded.

    Raises:
        UserError: naming the option and the remedy.
    """
    from scgs_warp.config import MotionConfig
    from scgs_warp.errors import UserError

    for name in ("gaussians", "nodes", "motion", "table_s2"):
        if options.run is not None and getattr(options, name, None) not in (None, False):
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
    if not 16 <= options.size <= LARGEST:
        raise UserError(f"--size {options.size}: give 16 to {LARGEST} pixels")
    if not 0 <= options.seconds <= 600:
        raise UserError(f"--seconds {options.seconds:g}: give 0 to 600")
    if options.against is not None and not isinstance(options, Raster):
        raise UserError(f"--against {options.against}: it has no motion and no training step; compare with raster")


def show(report: dict[str, Any]) -> None:
    """The rows as a table on the terminal."""
    from rich.console import Console
    from rich.table import Table

    machine = report["machine"]
    table = Table(title=f"{machine['gpu'] or machine['processor']}, {machine['cores']} cores")
    for column in ("name", "motion"):
        table.add_column(column, overflow="fold")
    for column in ("threads", "ms median", "ms min", "frames/s", "share", "peak MiB", "2-thread"):
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
            f"{row['peak_mib']:,.0f}" if whole and row["peak_mib"] is not None else "",
            f"{row['two_thread_scaling']:.2f}" if whole else "",
        )
    console = Console() if sys.stdout.isatty() else Console(width=120)
    console.print(table)
    first = report["rows"][0]
    console.print(
        f"{first['gaussians']:,} Gaussians, {first['control_points']:,} control points, {first['width']} x "
        f"{first['height']}, {first['pairs']:,} pairs of splat and tile, "
        f"{first['contributors']:.1f} splats a covered pixel"
    )
    if any(row["threads"] > 1 and row["two_thread_scaling"] < 1.8 for row in report["rows"] if row["device"] == "cpu"):
        console.print("two threads were not twice as fast as one at plain arithmetic: take the one-thread rows")


def show_table_s2(report: dict[str, Any], paper: dict[str, float]) -> None:
    """Speeds relative to Gaussians at rest, here and in the paper: the machines differ, the ratios compare."""
    for threads in sorted({row["threads"] for row in report["rows"]}):
        wholes = [row for row in report["rows"] if row["share"] is None and row["threads"] == threads]
        rest = next(row["fps"] for row in wholes if row["motion"] == "static")
        for row in wholes:
            name = row["motion"]
            print(
                f"{name}, {threads} threads: {row['fps']:.1f} frames/s, {row['fps'] / rest:.2f} of static "
                f"(paper: {paper[name]:.1f} frames/s, {paper[name] / paper['static']:.2f})"
            )


def main(args: list[str] | None) -> None:
    import tyro

    options: Options = tyro.extras.subcommand_cli_from_dict(COMMANDS, args=args, prog="bench.py", description=__doc__)
    check(options)
    device = prepare(options.device, options.threads)

    from scgs_warp import bench

    table = isinstance(options, Frame) and options.table_s2
    plan = bench.Plan(
        run=options.run,
        gaussians=49_000 if options.gaussians is None else options.gaussians,
        nodes=512 if options.nodes is None else options.nodes,
        size=options.size,
        motions=tuple(bench.PAPER_FPS) if table else bench.check_motions(options.motion or "control-points"),
        device=device,
        threads=bench.thread_counts(options.threads, device),
        seconds=options.seconds,
        against=options.against,
        report=lambda text: print(text, file=sys.stderr, flush=True),
    )
    report = bench.bench(type(options).__name__.lower(), plan)  # type: ignore[arg-type]
    if options.json is not None:
        bench.write(report, options.json)
    show(report)
    if table:
        show_table_s2(report, bench.PAPER_FPS)


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
