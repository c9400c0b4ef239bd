"""Training in one call, for notebooks and scripts: from a folder or a data set to a scene."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

from ..config import presets
from ..config.presets import PresetName, TrainConfig
from ..config.validation import check
from ..data.dataset import Dataset
from ..data.synthetic.builtin import make_synthetic
from ..errors import UserError
from ..runtime import environment
from ..runtime.caller_settings import unaffected
from ..runtime.progress import Report, quiet, reported, say
from ..scene.scene import Scene
from .dataset_advice import advise, survey
from .loop import fit
from .preflight import refuse_early
from .run import load_splits, settings_of, write_results

BUILTIN = Path("data/figure")
"""Folder in which the built-in scene is made on first use."""


@unaffected
def train(
    data: str | Path | Dataset | None = None,
    preset: PresetName = "cpu",
    *,
    output: str | Path | None = None,
    device: str = "auto",
    steps: int | None = None,
    resume: bool = False,
    progress: bool | Report = True,
    **settings: Any,
) -> Scene:
    """Train a scene, as ``apps/train.py`` does, and return it.

    ```python
    scene = scgs_warp.train("data/film", preset="cpu", data__downscale=2)
    scene.turntable("film.mp4")
    ```

    Args:
        data: folder of a data set in any layout, or frames in memory (``scgs_warp.data.load``). None: the built-in
            scene, which is made in ``data/figure`` on first use.
        preset: ``quick``, ``cpu``, ``best`` or ``paper``.
        output: run folder, which no other run may hold. None: ``runs/NAME-PRESET``.
        device: ``cpu`` or ``cuda``; ``auto`` takes a GPU if there is one.
        steps: total number of steps; every milestone scales with it.
        resume: continue the run in ``output``.
        progress: True shows a bar, and advice on the data; False prints nothing. A function is called as
            ``progress(work, done, total)`` after each step of each work, for example ("training", 500, 24000). An error
            that it raises stops the work; a training saves its checkpoint first.
        settings: fields of the configuration by their dotted names, with two underscores for a dot:
            ``motion__nodes=256``, ``data__downscale=2``, ``seed=1``. ``scgs-warp config`` lists them.

    Returns:
        The scene after the last step, whose ``folder`` is the run folder. If ``data`` is a folder, the run folder also
        holds scores and renders of the held-out views, a contact sheet and curves.

    Raises:
        UserError: the data, a setting or the run folder is wrong; one line names it and the remedy.
        KeyboardInterrupt: after Ctrl-C, or the stop button of a notebook; the checkpoint is saved, and ``resume=True``
            continues.
    """
    config = configuration(preset, steps, settings)
    name = BUILTIN.name if data is None else (data.folder if isinstance(data, Dataset) else Path(data)).resolve().name
    folder = Path(output) if output is not None else Path("runs") / f"{name}-{preset}"
    refuse_early(config, folder, resume)
    folder = folder.absolute()  # progress may change the directory
    where = chosen_device(device)
    shown = reported(progress) if callable(progress) else nullcontext() if progress else quiet()
    with shown:
        return _trained(config, data, folder, where, resume)


def _trained(config: TrainConfig, data: str | Path | Dataset | None, folder: Path, device: str, resume: bool) -> Scene:
    if isinstance(data, Dataset):
        say("\n".join(advise(survey(data), config, device)))
        return fit(config, data, output=folder, device=device, resume=resume)
    if data is None:
        make_synthetic(BUILTIN, device=device)
    source = BUILTIN if data is None else Path(data)
    training, test = load_splits(config, source)
    say("\n".join(advise(survey(training), config, device)))
    settings = settings_of(config, source)
    scene = fit(config, training, output=folder, device=device, test=test, resume=resume, settings=settings)
    write_results(scene, test, folder, frames=0)
    return scene


def configuration(preset: PresetName, steps: int | None, settings: dict[str, Any]) -> TrainConfig:
    """Make the configuration of a preset with other steps and settings.

    Raises:
        UserError: names the argument.
    """
    if preset not in presets.PRESETS:
        raise UserError(f"preset is {preset!r}; choose one of {', '.join(presets.PRESETS)}")
    config = presets.preset(preset)
    if steps is not None:
        config = presets.with_steps(config, presets.whole_number(steps, "steps"))
    for name, value in settings.items():
        config = presets.with_field(config, name.replace("__", "."), value, name)
    return check(config)


def chosen_device(device: Any) -> str:
    """Return ``cpu`` or ``cuda``.

    Raises:
        UserError: another device is wanted, or there is no GPU.
    """
    import torch

    device = str(device)  # a torch.device, as for Scene.load, too
    if device not in ("auto", "cpu", "cuda"):
        raise UserError(f"device is {device!r}; choose one of auto, cpu, cuda")
    available = torch.cuda.is_available() and environment.warp_finds_gpu()
    if device == "cuda" and not available:
        raise UserError("device is 'cuda', but torch and Warp find no GPU here; choose cpu")
    return "cuda" if available and device != "cpu" else "cpu"
