"""The settings of a run as options, for every app that trains, and the configuration they make."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from scgs_warp.apps.cli import Device
from scgs_warp.config.presets import PresetName

if TYPE_CHECKING:
    from scgs_warp.config.presets import TrainConfig

BUILTIN = Path("data/figure")


@dataclass(frozen=True)
class Settings:
    """What is asked of a run, whatever it is for."""

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
    batch: int | None = None
    """Views per step, whose gradients are averaged; with torchrun as many as processes by default (docs/scaling.md)."""
    steps: int | None = None
    """Steps of both stages together; every milestone scales with it."""
    nodes: int | None = None
    """Control points."""
    progressive: bool = False
    """Pre-train on the first fifth of the frames, then on more and more: for large motions."""
    max_gaussians: int | None = None
    """Never have more Gaussians than this: bounds memory."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Any other field of the configuration, as NAME=VALUE; again for each: --set motion.hyper_dim=8 --set freeze=0."""
    device: Device = "auto"
    """Where to compute; auto takes a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all cores by default."""
    memory_gib: float | None = None
    """Take no more memory than this, on a GPU of its own: large images are drawn in bands, what does not fit is refused
    with the figure. By default what the machine has free."""


def configuration(
    options: Settings,
    file: Path | None,
    flags: dict[str, Any],
    usual: PresetName | None = None,
    usual_batch: int = 1,
) -> tuple[TrainConfig, str | None]:
    """The complete configuration, and the data folder that ``file`` names.

    Args:
        file: a config.json, or any part of one, under the options; None: there is none.
        flags: fields that options of the app's own set, by their dotted names; None: not set.
        usual: the preset where neither options nor ``file`` name one; None: cpu if ``file`` names a data folder, else
            quick.
        usual_batch: views per step where neither says so.

    Raises:
        UserError: naming the option or the file and its field.
    """
    from scgs_warp.config import presets, validation
    from scgs_warp.errors import UserError

    values = presets.read_config(file) if file else {}
    folder = values.get("data", {}).pop("folder", None) if isinstance(values.get("data"), dict) else None
    if options.preset:
        if values.get("preset", options.preset) != options.preset:
            raise UserError(f"{file}: is of preset {values['preset']}; leave out --preset {options.preset}")
        values["preset"] = options.preset
    values.setdefault("batch", usual_batch)
    values.setdefault("preset", usual or ("cpu" if folder else "quick"))
    # A complete file says where its milestones lie; a partial one that names the steps wants them scaled.
    steps = values.pop("steps", None) if "pretrain" not in values else None
    made = presets.from_dict(values, str(file or "options"))
    if steps is not None:
        made = presets.with_steps(made, presets.whole_number(steps, f"{file}: steps"))
    if options.steps is not None and options.steps != made.steps:
        made = presets.with_steps(made, options.steps)
    wanted = {
        "data.downscale": options.downscale,
        "data.resample": options.resample,
        "data.background": options.background,
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
    """The built-in scene, made on first use."""
    from scgs_warp.data.synthetic.builtin import make_synthetic
    from scgs_warp.runtime.progress import progress

    with progress(120, "making the built-in scene") as bar:
        make_synthetic(BUILTIN, device=device, progress=lambda done, total: bar.advance())
    return BUILTIN
