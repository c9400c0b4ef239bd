"""Ablations with one training run per cell: the number of control points, the motion model, ARAP on and off; and the
zoo, every built-in subject with the same settings."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from scgs_warp.apps.arguments import parse
from scgs_warp.apps.cli import prepare, run
from scgs_warp.apps.settings import Settings, builtin_scene, configuration
from scgs_warp.config.presets import PresetName

if TYPE_CHECKING:
    from scgs_warp.ablation.cells import Cell
    from scgs_warp.config.presets import TrainConfig


@dataclass(frozen=True)
class SweepOptions:
    """Options that --help lists before the settings."""

    ablation: tyro.conf.Positional[Literal["nodes", "motion", "arap", "zoo"]]
    """nodes: 64 to 4096 control points; motion: static, hexplane, per-gaussian and control-points; arap: on, off, and
    the per-gaussian baseline where the data's true motion is known; zoo: every built-in subject at 200 x 200, made on
    first use, to judge a change of a setting."""
    output: Path
    """Folder for the table and the plot (ABLATION.json, .md, .png) and for the run folder of each cell,
    SCENE/VALUE[-seedN]. Finished cells are kept, interrupted ones are continued."""
    data: tuple[Path, ...] = ()
    """Folders of data sets; by default the built-in scene, which is made on first use. For zoo: data sets beside the
    subjects; --downscale applies to them alone."""
    values: tuple[str, ...] = ()
    """Rows of the table to train, separated by commas or spaces; all by default. The table also shows cells that were
    trained before. For zoo: the subjects."""
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
    compare: Path | None = None
    """For zoo: --output of another zoo, trained with other settings or by another version. The table shows the
    differences from it in dB, and marks the rows that lose more than 0.2 dB."""
    table_only: bool = False
    """Train nothing; make the table and the plot from finished cells."""


@dataclass(frozen=True)
class Options(Settings, SweepOptions):
    """Train runs that differ in one setting only, and compare the results with published ones."""

    preset: PresetName | None = None
    """Schedule of all cells. cpu (the default): about 15 minutes per cell, for zoo shortened to 6,000 steps; quick: a
    few minutes; best: half an hour to an hour; paper: hours, the schedule of the SC-GS supplement. All cells are
    trained for equally many steps."""


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
    if options.compare is not None:
        from scgs_warp.ablation.zoo import read_table

        if options.ablation != "zoo":
            raise UserError(f"--compare {options.compare}: is for zoo; leave it out")
        read_table(options.compare)  # A missing table is reported before anything is trained.
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
    from scgs_warp.config.validation import check_node_count

    config, named = configuration(with_usual_steps(options), options.config, {}, "cpu")
    shared = {"seeds": parse_seeds(words(options.seeds)), "device": device, "lpips_weights": options.lpips_weights}
    if options.lpips_weights is not None:
        from scgs_warp.evaluation.image_metrics import LPIPS

        LPIPS(options.lpips_weights, device)  # Damaged weights are reported before anything is trained.
    if options.ablation == "zoo":
        return make_zoo_cells(options, config, shared)
    values = parse_values(options.ablation, words(options.values))
    for value in values if options.ablation == "nodes" else ():
        check_node_count(int(value), config.motion.neighbors, "--values")
    scenes = find_scenes(options.data, named, device)
    return plan(options.ablation, config, scenes, options.output, values=values, **shared)


def with_usual_steps(options: Options) -> Options:
    """Shorten the schedule of the zoo, unless an option chooses one."""
    if options.ablation != "zoo" or options.preset or options.config or options.steps is not None:
        return options
    from scgs_warp.ablation.zoo import STEPS

    return replace(options, steps=STEPS)


def make_zoo_cells(options: Options, config: TrainConfig, shared: dict[str, Any]) -> list[Cell]:
    """Plan the cells of the zoo, and make the subjects' data sets that do not exist yet.

    Args:
        shared: seeds, device and weights of LPIPS, for ``plan``.
    """
    from scgs_warp.ablation.cells import plan
    from scgs_warp.ablation.zoo import make_subjects, parse_subjects, subject_folders
    from scgs_warp.config.presets import with_field
    from scgs_warp.errors import UserError

    subjects = subject_folders(parse_subjects(words(options.values)))
    others = find_scenes(options.data, None, shared["device"]) if options.data else {}
    for name in subjects.keys() & others.keys():
        raise UserError(f"--data {others[name]}: there is a subject {name!r}; rename one, cells are kept by that name")
    full = with_field(config, "data.downscale", 1, "zoo")
    cells = plan("zoo", full, subjects, options.output, **shared)
    cells += plan("zoo", config, others, options.output, **shared)
    make_subjects(subjects, shared["device"])
    return cells


def train(options: Options, cells: list[Cell]) -> dict[str, str]:
    """Train all cells on this machine or on a cluster, and rewrite the table after each.

    Returns:
        The reason of each failure, by the name of the cell that failed.
    """
    from scgs_warp.ablation.cells import is_done
    from scgs_warp.ablation.local_runner import run_cells
    from scgs_warp.ablation.table import build, write

    def renew() -> None:
        write(build(options.ablation, options.output, cells, options.compare), options.output)

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
    options = parse(Options, "ablate", args, description=__doc__)

    from scgs_warp.ablation.markdown import markdown
    from scgs_warp.ablation.table import build, write
    from scgs_warp.errors import UserError

    # A GPU of the cluster need not exist on this machine.
    here = options.device if options.ray is None else "auto"
    check(options)
    cells = [] if options.table_only else make_cells(options, prepare(here, options.threads, options.memory_gib))
    failures = train(options, cells) if cells else {}
    report = build(options.ablation, options.output, cells, options.compare)
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
