"""Train a scene: ``python apps/train.py`` makes and learns the built-in one, ``--data DIR`` learns yours."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from scgs_warp.apps.cli import Device, prepare, run
from scgs_warp.config import MotionName, PresetName

BUILTIN = Path("data/figure")
RUNS = Path("runs")


@dataclass(frozen=True)
class Options:
    """Reconstruct a moving scene from posed frames."""

    data: Path | None = None
    """Folder of a data set in D-NeRF layout (transforms_train.json ...). Without it the built-in scene is made."""
    output: Path | None = None
    """Run directory; runs/NAME by default."""
    preset: PresetName | None = None
    """quick: a few minutes on two cores; cpu: some 15 minutes, most of the quality; paper: the full schedule.
    Default: quick for the built-in scene, cpu for yours."""
    config: Path | None = None
    """A config.json of an earlier run, or any part of one; flags override it."""
    downscale: int | None = None
    """Divide the images' width and height by this."""
    resample: Literal["area", "bicubic"] | None = None
    """How images are reduced: area, or bicubic as the official code does it."""
    background: Literal["black", "white", "random"] | None = None
    """What lies behind transparent pixels."""
    steps: int | None = None
    """Steps of both stages together; every milestone scales with it."""
    nodes: int | None = None
    """Control points."""
    motion: MotionName | None = None
    """How the scene moves: control points (ours), one network query per Gaussian, feature planes, not at all."""
    progressive: bool = False
    """Pre-train on the first fifth of the frames, then on more and more: for large motions."""
    max_gaussians: int | None = None
    """Never have more Gaussians than this: bounds memory."""
    seed: int | None = None
    """The same seed gives the same bits on the same machine."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Any other field of the configuration, as NAME=VALUE; again for each: --set motion.hyper_dim=8 --set freeze=0."""
    resume: bool = False
    """Continue the run in --output."""
    device: Device = "auto"
    """Where to compute; auto takes a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all cores by default."""


def configuration(options: Options, recorded: Path) -> tuple[Any, str | None]:
    """The complete configuration, and the data folder that a --config names; ``recorded``: config.json of the run that
    --resume continues."""
    from scgs_warp import config, limits
    from scgs_warp.errors import UserError

    file = options.config or (recorded if options.resume and recorded.is_file() else None)
    values = config.read_config(file) if file else {}
    folder = values.get("data", {}).pop("folder", None) if isinstance(values.get("data"), dict) else None
    if options.preset:
        if values.get("preset", options.preset) != options.preset:
            raise UserError(f"{file}: is of preset {values['preset']}; leave out --preset {options.preset}")
        values["preset"] = options.preset
    values.setdefault("preset", "cpu" if options.data or folder else "quick")
    # A complete file says where its milestones lie; a partial one that names the steps wants them scaled.
    steps = values.pop("steps", None) if "pretrain" not in values else None
    made = config.from_dict(values, str(file or "options"))
    if steps is not None:
        made = config.with_steps(made, config.whole_number(steps, f"{file}: steps"))
    if options.steps is not None and options.steps != made.steps:
        made = config.with_steps(made, options.steps)
    flags = {
        "data.downscale": options.downscale,
        "data.resample": options.resample,
        "data.background": options.background,
        "motion.nodes": options.nodes,
        "motion.model": options.motion,
        "pretrain.progressive": options.progressive or None,
        "densify.max_gaussians": options.max_gaussians,
        "seed": options.seed,
    }
    for name, value in flags.items():
        if value is not None:
            made = config.with_field(made, name, value, "options")
    for text in options.set:
        name, sign, value = text.partition("=")
        if not sign:
            raise UserError(f"--set {text}: write NAME=VALUE, for example motion.hyper_dim=8")
        made = config.with_field(made, name.strip(), config.parse_value(value.strip()), f"--set {text}")
    return limits.check(made), folder


def default_output(options: Options) -> Path:
    """runs/NAME-PRESET, NAME being that of the data folder."""
    name = (options.data or BUILTIN).resolve().name
    return RUNS / f"{name}-{options.preset or ('cpu' if options.data else 'quick')}"


def find_data(options: Options, folder: str | None, device: str) -> Path:
    """The data set to train on; the built-in scene is made on first use."""
    if options.data or folder:
        return options.data or Path(str(folder))
    from scgs_warp.data.synthetic import make_synthetic
    from scgs_warp.progress import progress

    with progress(120, "making the built-in scene") as bar:
        make_synthetic(BUILTIN, device=device, progress=lambda done, total: bar.advance())
    return BUILTIN


def main(args: list[str] | None) -> None:
    options = tyro.cli(Options, args=args, prog="train.py")
    device = prepare(options.device, options.threads)
    output = options.output or default_output(options)
    config, named = configuration(options, output / "config.json")

    from scgs_warp.config import to_dict
    from scgs_warp.data import load
    from scgs_warp.finish import finish, summary
    from scgs_warp.run_folder import refuse_existing
    from scgs_warp.train import fit

    refuse_existing(output, options.resume)
    folder = find_data(options, named, device)
    look = dataclasses.asdict(config.data)
    train, test = load(folder, "train", **look), load(folder, "test", **look)
    settings = to_dict(config)
    settings["data"]["folder"] = str(folder.resolve())
    scene = fit(config, train, output=output, device=device, test=test, resume=options.resume, settings=settings)
    metrics = finish(scene, test, Path(output))
    print(summary(metrics))
    print(f"{output}: metrics.json, contact_sheet.png, curves.png, turntable.mp4")


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
