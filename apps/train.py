"""Train a scene: ``python apps/train.py`` makes and trains the built-in one, ``--data DIR`` trains another."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from scgs_warp.apps.arguments import parse, refuse_given
from scgs_warp.apps.cli import prepare, run
from scgs_warp.apps.settings import (
    BUILTIN,
    ImageChoice,
    Machine,
    Method,
    Schedule,
    Settings,
    builtin_scene,
    configuration,
)
from scgs_warp.config.presets import MotionName
from scgs_warp.errors import UserError, shell_words
from scgs_warp.runtime.torchrun import process_rank

if TYPE_CHECKING:
    from scgs_warp.data import Dataset
    from scgs_warp.live.training_view import TrainingView

RUNS = Path("runs")


@dataclass(frozen=True)
class RunFolders:
    """Folders of a run."""

    data: Path | None = None
    """Folder of a data set: D-NeRF, nerfstudio, HyperNeRF, NeRF-DS, DyCheck, Panoptic, Neural 3D Video, EasyMocap,
    ActorsHQ, COLMAP and others (docs/data.md). By default the built-in scene, which is made on first use."""
    output: Path | None = None
    """Run folder; runs/NAME-PRESET by default."""


@dataclass(frozen=True)
class Usual(Schedule, RunFolders):
    """What most runs need."""

    resume: bool = False
    """Continue the run in --output, with its settings; with --steps N until step N (docs/getting-started.md)."""
    live: bool = False
    """Show the scene in the browser while it trains (docs/page.md); the result stays bit-identical."""


@dataclass(frozen=True)
class Model(Method):
    """The model and its training."""

    motion: MotionName | None = None
    """Motion model: control points (SC-GS), one network query per Gaussian, feature planes, or no motion
    (docs/static.md)."""
    seed: int | None = None
    """Random seed; the same seed gives bit-identical results on the same machine."""


@dataclass(frozen=True)
class Host(Machine):
    """Where and how the computation runs."""

    tensorboard: bool = False
    """Also write curves and images for TensorBoard to the run folder: tensorboard --logdir runs."""
    port: int = 8080
    """With --live: port on 127.0.0.1; if it is taken, one of the next."""


@dataclass(frozen=True)
class Options(Host, Model, Usual, Settings):
    """Reconstruct a moving scene from posed frames."""


GROUPS = {"usual": Usual, "image": ImageChoice, "model": Model, "machine": Host}
"""Groups of options in ``--help``: what people use first comes first."""


def default_output(folder: Path | None, preset: str) -> Path:
    """Return runs/NAME-PRESET, with the name of the data folder; None stands for the built-in scene."""
    return RUNS / f"{(folder or BUILTIN).resolve().name}-{preset}"


def live_view(options: Options, output: Path, steps: int) -> TrainingView:
    """Start the page that follows the training.

    Raises:
        UserError: the page cannot be served.
    """
    from scgs_warp.live.training_view import TrainingView
    from scgs_warp.live.viewer import SceneView
    from scgs_warp.runtime.progress import say

    if not 0 <= options.port <= 65535:
        raise UserError(f"--port {options.port}: give 1 to 65535, or 0 for any")
    view = SceneView(output.resolve().name, port=options.port, source=output)
    say(f"watch the training: open {view.server.url} in a browser")
    return TrainingView(view, steps)


def main(args: list[str] | None) -> None:
    options = parse(Options, "train", args, groups=GROUPS)
    if not options.live:
        refuse_given(options, ("port",), "belongs to --live; give both, or neither")
    where = process_rank()
    threads = where.threads if where and options.threads is None else options.threads
    device = prepare(options.device, threads, options.memory_gib)
    default_preset = "cpu" if options.data else None
    recorded = (
        options.output or default_output(options.data, options.preset or default_preset or "quick")
    ) / "config.json"
    resumed = options.resume and options.config is None and recorded.is_file()
    file = recorded if resumed else options.config
    flags = {"motion.model": options.motion, "seed": options.seed}
    config, named = configuration(options, file, flags, default_preset, where.size if where else 1, resumed)
    folder = options.data or (Path(named) if named else None)
    output = options.output or (recorded.parent if resumed else default_output(folder, config.preset))

    from scgs_warp.runtime.progress import say
    from scgs_warp.runtime.provenance import command_line
    from scgs_warp.training.dataset_advice import advise, survey
    from scgs_warp.training.preflight import refuse_early
    from scgs_warp.training.process_group import join_processes
    from scgs_warp.training.run import summary, train_and_evaluate
    from scgs_warp.training.tensorboard import check_installed

    if options.tensorboard:
        check_installed()
    refuse_early(config, output, options.resume)
    first = where is None or where.rank == 0
    watcher = live_view(options, output, config.steps) if options.live and first else None

    def show_advice(data: Dataset) -> None:
        say("\n".join(advise(survey(data), config, device)))

    with join_processes(where, device) as group:
        if folder is None:  # Only one of several processes makes it.
            folder = group.in_turn(lambda: builtin_scene(device)) if group else builtin_scene(device)
        metrics = train_and_evaluate(
            config,
            folder,
            output,
            device=device,
            resume=options.resume,
            before_training=show_advice,
            tensorboard=options.tensorboard,
            group=group,
            command=command_line("apps/train.py", sys.argv[1:] if args is None else args),
            watcher=watcher,
        )
        say(summary(metrics))
        if group:
            say(group.summary())
        say(f"{output}: metrics.json, contact_sheet.png, curves.png, turntable.mp4")
        if first:
            name = shell_words(output)
            say(f"next: python apps/view.py --run {name} --mode time --output film.mp4")
            if config.motion.model in ("control-points", "static"):
                say(f"to edit: python apps/edit.py --run {name}")


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
