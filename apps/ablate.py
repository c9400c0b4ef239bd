"""Ablations with one training run per cell: the number of control points, the motion model, ARAP on and off."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from scgs_warp.apps.cli import prepare, run
from scgs_warp.apps.settings import Settings, builtin_scene, configuration
from scgs_warp.config.presets import PresetName

if TYPE_CHECKING:
    from scgs_warp.ablation.cells import Cell


@dataclass(frozen=True)
class SweepOptions:
    """Options that --help lists before the settings."""

    ablation: tyro.conf.Positional[Literal["nodes", "motion", "arap"]]
    """nodes: 64 to 4096 control points; motion: static, hexplane, per-gaussian and control-points; arap: on, off, and
    the per-gaussian baseline where the data's true motion is known."""
    output: Path
    """Folder for the table and the plot (ABLATION.json, .md, .png) and for the run folder of each cell,
    SCENE/VALUE[-seedN]. Finished cells are kept, interrupted ones are continued."""
    data: tuple[Path, ...] = ()
    """Folders of data sets; by default the built-in scene, which is made on first use."""
    values: tuple[str, ...] = ()
    """Rows of the table to train, separated by commas or spaces; all by default. The table also shows cells that were
    trained before."""
    seeds: tuple[str, ...] = ()
    """Seeds, separated by commas or spaces. Every scene and row of the table is trained once with each seed; the
    table then also gives standard deviations."""
    jobs: int = 1
    """Cells to train at a time, each in its own process with a share of the threads; with --ray, on each machine."""
    ray: str | None = None
    """Ray cluster to train on: local (started on this machine for this command only), auto (the one that already runs
    on this machine), HOST:PORT, or ray://HOST:PORT from a machine outside the cluster. With a cluster, --threads is the
    number of threads on each machine. By default, no cluster is used."""
    lpips_weights: Path | None = None
    """File with VGG16 and LPIPS weights; without it LPIPS is not measured."""
    table_only: bool = False
    """Train nothing; make the table and the plot from finished cells."""


@dataclass(frozen=True)
class Options(Settings, SweepOptions):
    """Train runs that differ in one setting only, and compare the results with published ones."""

    preset: PresetName | None = None
    """Schedule of all cells. cpu (the default): about 15 minutes per cell; quick: a few minutes; paper: the full
    schedule. All cells are trained for equally many steps."""


def words(texts: tuple[str, ...]) -> list[str]:
    """Split texts at commas and spaces."""
    return [word for text in texts for word in text.replace(",", " ").split()]


def check(options: Options) -> None:
    """Refuse options that the ablation itself sets.

    Raises:
        UserError: names the option.
    """
    from scgs_warp.ablation.cells import VARIED
    from scgs_warp.errors import UserError

    if options.jobs < 1:
        raise UserError(f"--jobs {options.jobs}: must be at least 1")
    if options.ray is not None and not options.table_only:
        from scgs_warp.ablation.ray_cluster import check_address

        check_address(options.ray)
    if options.ablation == "nodes" and options.nodes is not None:
        raise UserError(f"--nodes {options.nodes}: that is what is varied; choose rows with --values")
    for text in options.set:
        name = text.partition("=")[0].strip()
        if name in VARIED[options.ablation] and name.startswith("motion."):
            raise UserError(f"--set {text}: that is what is varied; choose rows with --values")
        if name == "seed":
            raise UserError(f"--set {text}: give --seeds")


def find_scenes(folders: tuple[Path, ...], named: str | None, device: str) -> dict[str, Path]:
    """Return the data folders by their names, which the table and the run folders use.

    Raises:
        UserError: a folder is missing, or two have the same name.
    """
    from scgs_warp.errors import UserError

    if not folders:
        folders = (Path(named) if named else builtin_scene(device),)
    scenes: dict[str, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            raise UserError(f"--data {folder}: no such folder; give folders of data sets")
        name = folder.resolve().name
        if name in scenes:
            raise UserError(f"--data {folder}: there is another {name!r}; rename one, cells are kept by that name")
        scenes[name] = folder
    return scenes


def make_cells(options: Options, device: str) -> list[Cell]:
    """Plan and check all cells before the first is trained."""
    from scgs_warp.ablation.cells import parse_seeds, parse_values, plan

    check(options)
    config, named = configuration(options, options.config, {}, "cpu")
    values = parse_values(options.ablation, words(options.values))
    seeds = parse_seeds(words(options.seeds))
    if options.lpips_weights is not None:
        from scgs_warp.evaluation.image_metrics import LPIPS

        LPIPS(options.lpips_weights, device)  # Damaged weights are reported before anything is trained.
    scenes = find_scenes(options.data, named, device)
    return plan(
        options.ablation,
        config,
        scenes,
        options.output,
        values=values,
        seeds=seeds,
        device=device,
        lpips_weights=options.lpips_weights,
    )


def train(options: Options, cells: list[Cell]) -> dict[str, str]:
    """Train all cells on this machine or on a cluster, and rewrite the table after each.

    Returns:
        The reason of each failure, by the name of the cell that failed.
    """
    from scgs_warp.ablation.cells import is_done
    from scgs_warp.ablation.local_runner import run_cells
    from scgs_warp.ablation.table import build, write

    def renew() -> None:
        write(build(options.ablation, options.output, cells), options.output)

    with ExitStack() as stack:
        elsewhere = None
        if options.ray is not None and not all(map(is_done, cells)):
            from scgs_warp.ablation.ray_runner import on_cluster

            limits = {"jobs": options.jobs, "threads": options.threads, "device": options.device}
            elsewhere = stack.enter_context(on_cluster(options.ray, cells, options.output, **limits))
        renew()
        return run_cells(
            cells,
            jobs=options.jobs,
            threads=options.threads,
            report=lambda text: print(text, flush=True),
            finished=renew,
            elsewhere=elsewhere,
        )


def main(args: list[str] | None) -> None:
    options = tyro.cli(Options, args=args, prog="ablate.py", description=__doc__)

    from scgs_warp.ablation.markdown import markdown
    from scgs_warp.ablation.table import build, write
    from scgs_warp.errors import UserError

    # A GPU of the cluster need not exist on this machine.
    here = options.device if options.ray is None else "auto"
    cells = [] if options.table_only else make_cells(options, prepare(here, options.threads, options.memory_gib))
    failures = train(options, cells) if cells else {}
    report = build(options.ablation, options.output, cells)
    paths = write(report, options.output)
    print(markdown(report))
    print(f"{', '.join(map(str, paths))}")
    if failures:
        texts = [f"{name} ({message})" for name, message in failures.items()]
        raise UserError(f"{len(failures)} of {len(cells)} cells failed: {'; '.join(texts)}")


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
