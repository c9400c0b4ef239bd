"""Options for the settings of a run, for every app that trains, and the configuration that they give."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from scgs_warp.apps.cli import Device
from scgs_warp.config.presets import PresetName

if TYPE_CHECKING:
    from scgs_warp.config.presets import TrainConfig

BUILTIN = Path("data/figure")


@dataclass(frozen=True)
class Schedule:
    """What most runs need."""

    preset: PresetName | None = None
    """Schedule. quick: a few minutes on two cores; cpu: about a quarter of an hour; best: half an hour to an
    hour, a little better; paper: hours, the schedule of the SC-GS supplement. By default quick for the built-in scene
    and cpu for others."""
    downscale: int | None = None
    """Factor by which the images' width and height are divided."""
    steps: int | None = None
    """Steps of both stages together; every milestone of the schedule scales with it, except with --resume."""


@dataclass(frozen=True)
class ImageChoice:
    """Which images, and how they are read."""

    frames: str | None = None
    """Instants to use, as A:B:C (first, end, step): 0:300:2 takes every other one of the first 300."""
    only_cameras: str | None = None
    """Names of the cameras to use, separated by commas (docs/data.md)."""
    min_frames: int | None = None
    """Smallest number of frames whose images must exist; by default half of them. Frames without images are left
    out."""
    resample: Literal["area", "bicubic"] | None = None
    """Filter that reduces images: area, or bicubic as in the official code."""
    background: Literal["black", "white", "random"] | None = None
    """Colour behind transparent pixels."""


@dataclass(frozen=True)
class Method:
    """The model and its training."""

    nodes: int | None = None
    """Number of control points."""
    progressive: tyro.conf.FlagCreatePairsOff[bool] = False
    """Pre-train on the first fifth of the frames, then on more and more; for large motions. --set
    pretrain.progressive=false turns it off for the preset quick."""
    max_gaussians: int | None = None
    """Largest number of Gaussians at any time, which bounds memory."""
    batch: int | None = None
    """Views per step; their gradients are averaged. With torchrun, the default is one per process (docs/scaling.md)."""
    config: Path | None = None
    """config.json of an earlier run, or a part of one; options override it."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Any other field of the configuration as NAME=VALUE (scgs-warp config lists them); may be repeated: --set
    motion.hyper_dim=8 --set freeze=0."""


@dataclass(frozen=True)
class Machine:
    """Where and how the computation runs."""

    device: Device = "auto"
    """Where to compute; auto takes a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all cores by default."""
    memory_gib: float | None = None
    """Limit on memory in GiB (on a GPU, on the memory of the GPU); by default all free memory. Large images are drawn
    in bands, and what does not fit is refused with an error that names its size."""


@dataclass(frozen=True)
class Settings(Machine, Method, ImageChoice, Schedule):
    """Settings of a training run."""


def configuration(
    options: Settings,
    file: Path | None,
    flags: dict[str, Any],
    default_preset: PresetName | None = None,
    default_batch: int = 1,
    resumed: bool = False,
) -> tuple[TrainConfig, str | None]:
    """Build the complete configuration, and return it with the data folder that ``file`` names.

    Args:
        file: A config.json or a part of one, which options override, or None.
        flags: Fields that the app's own options set, by their dotted names; None leaves a field unset.
        default_preset: Preset if neither the options nor ``file`` name one; None stands for cpu if ``file`` names a
            data folder, otherwise quick.
        default_batch: Views per step if neither the options nor ``file`` set them.
        resumed: whether ``file`` is that of a run that continues: ``--steps`` then moves its end alone.

    Raises:
        UserError: names the option, or the file and its field.
    """
    from scgs_warp.config import presets, validation
    from scgs_warp.errors import UserError

    values = presets.read_config(file) if file else {}
    folder = values.get("data", {}).pop("folder", None) if isinstance(values.get("data"), dict) else None
    if options.preset:
        if values.get("preset", options.preset) != options.preset:
            raise UserError(f"{file}: is of preset {values['preset']}; leave out --preset {options.preset}")
        values["preset"] = options.preset
    values.setdefault("batch", default_batch)
    values.setdefault("preset", default_preset or ("cpu" if folder else "quick"))
    # A complete file states its milestones; those of a partial one that names the steps are scaled.
    steps = values.pop("steps", None) if "pretrain" not in values else None
    made = presets.from_dict(values, str(file or "options"))
    if steps is not None:
        steps = presets.whole_number(steps, f"{file}: steps")
    wanted_steps = steps if options.steps is None else options.steps
    if wanted_steps is not None and wanted_steps != made.steps:
        made = replace(made, steps=wanted_steps) if resumed else presets.with_steps(made, wanted_steps)
    wanted = {
        "data.downscale": options.downscale,
        "data.resample": options.resample,
        "data.background": options.background,
        "data.frames": options.frames,
        "data.only_cameras": options.only_cameras,
        "data.min_frames": options.min_frames,
        "motion.nodes": options.nodes,
        "pretrain.progressive": options.progressive or None,
        "densify.max_gaussians": options.max_gaussians,
        "batch": options.batch,
        **flags,
    }
    for name, value in wanted.items():
        if value is not None:
            made = presets.with_field(made, name, value, "options")
    for text in options.set:
        name, sign, value = text.partition("=")
        if not sign:
            raise UserError(f"--set {text}: write NAME=VALUE, for example motion.hyper_dim=8")
        made = presets.with_field(made, name.strip(), presets.parse_value(value.strip()), f"--set {text}")
    try:
        validation.check(made)
    except UserError as error:
        raise UserError(f"{error} (in {file}, or an option beside it)" if file else str(error)) from None
    if folder is not None and not isinstance(folder, str):
        raise UserError(f"{file}: data.folder is no text; name the folder of a data set")
    return made, folder


def builtin_scene(device: str) -> Path:
    """Return the folder of the built-in scene, which is made on first use."""
    from scgs_warp.data.synthetic.builtin import make_synthetic
    from scgs_warp.runtime.progress import progress

    with progress(120, "making the built-in scene") as bar:
        make_synthetic(BUILTIN, device=device, progress=lambda done, total: bar.advance())
    return BUILTIN
