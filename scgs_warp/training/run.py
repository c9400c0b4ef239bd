"""A whole run: load, train, evaluate, and write scores, contact sheet, curves and a turntable."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from ..config.presets import TrainConfig, to_dict
from ..data import ImageCache, load
from ..data.dataset import Dataset
from ..errors import UserError, one_line
from ..evaluation.coverage import coverage_line
from ..evaluation.evaluate import Lpips, metrics_of, write_metrics
from ..evaluation.run_time import training_seconds
from ..geometry import cameras
from ..runtime.progress import progress, say
from ..runtime.provenance import provenance
from ..scene.frame_colors import FrameColors
from ..scene.scene import Scene
from ..storage.files import write_atomically
from ..visualization import video
from ..visualization.figures import curves
from ..visualization.overlay import Painter
from .loop import Watcher, fit
from .process_group import ProcessGroup

FILM_FRAMES = 120
FILM_SIZE = 400
FPS = 30.0
QUIET_SECONDS = 2.0
"""Seconds of loading after which a progress bar appears."""


def settings_of(config: TrainConfig, folder: Path) -> dict[str, Any]:
    """Make the content of ``config.json`` for a run on the data in ``folder``."""
    settings = to_dict(config)
    settings["data"]["folder"] = str(folder.resolve())
    return settings


def load_splits(config: TrainConfig, folder: Path) -> tuple[Dataset, Dataset]:
    """Load training and held-out frames, which share one cache of ``config.data.cache_mib``."""
    options, cache = dataclasses.asdict(config.data), ImageCache(config.data.cache_mib)

    def read(split: str) -> Dataset:
        began, shown = time.monotonic(), []
        with ExitStack() as stack:

            def show(done: int, total: int) -> None:
                if shown:
                    shown[0].advance()
                elif time.monotonic() - began > QUIET_SECONDS:
                    shown.append(stack.enter_context(progress(total, f"reading {split} images", start=done)))

            return load(folder, split, **options, cache=cache, progress=show)

    train, test = read("train"), read("test")
    notes, count = [*train.notes, *test.notes], len(train) + len(test)
    if config.data.min_frames > count:
        notes.append(
            f"{folder}: has {count} frames, none without an image; min_frames {config.data.min_frames} has no effect"
        )
    for note in dict.fromkeys(notes):
        say(note)
    return train, test


def train_and_evaluate(
    config: TrainConfig,
    data: Path,
    output: Path,
    *,
    device: str = "cpu",
    resume: bool = False,
    frames: int = FILM_FRAMES,
    lpips: Lpips | None = None,
    before_training: Callable[[Dataset], None] | None = None,
    tensorboard: bool = False,
    group: ProcessGroup | None = None,
    command: str | None = None,
    watcher: Watcher | None = None,
) -> dict[str, Any]:
    """Load, train and evaluate, as ``apps/train.py`` does.

    Args:
        data: folder of the data set; trains on its train split, evaluates on its test split.
        output: run folder.
        resume: continue the run in ``output``.
        frames: length of the turntable; 0: none.
        lpips: the perceptual distance; None: not measured.
        before_training: called with the training frames.
        tensorboard: also write event files for TensorBoard to ``output``.
        group: the processes that share the training; the first one evaluates.
        command: the command that trains, for ``provenance`` in ``metrics.json``.
        watcher: as for ``fit``.

    Returns:
        the content of ``metrics.json``; empty in processes other than the first.

    Raises:
        UserError: the data, the configuration, the run folder or the training fails, or scores and pictures cannot be
            written afterwards.
        KeyboardInterrupt: after Ctrl-C, SIGTERM or the end of the terminal; the checkpoint is saved.
    """
    origin = {"command": command, **provenance(device)}
    train, test = load_splits(config, data)
    if before_training is not None:
        before_training(train)
    scene = fit(
        config,
        train,
        output=output,
        device=device,
        test=test,
        resume=resume,
        settings=settings_of(config, data),
        tensorboard=tensorboard,
        group=group,
        watcher=watcher,
    )
    if group is not None and not group.first:
        return {}
    try:
        return write_results(scene, test, output, frames=frames, lpips=lpips, origin=origin)
    except (UserError, OSError) as error:
        raise UserError(
            f"{one_line(error)}; the scene is trained and saved: --resume makes the missing scores and pictures"
        ) from error


def write_results(
    scene: Scene,
    test: Dataset,
    folder: Path,
    *,
    frames: int = FILM_FRAMES,
    lpips: Lpips | None = None,
    origin: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Evaluate the trained scene on the test split, and write metrics and pictures.

    Args:
        scene: result of the training.
        test: held-out frames.
        folder: the run folder; ``metrics.json``, ``contact_sheet.png``, ``curves.png``, ``turntable.mp4``,
            ``evaluation/`` go there.
        frames: length of the turntable; 0: none.
        lpips: the perceptual distance; None: not measured.
        origin: date, command, commit and machine of the training; ``provenance`` in ``metrics.json``.

    Returns:
        the content of ``metrics.json``.
    """
    scene.freeze_binding()
    renders = folder / "evaluation" / test.split
    with progress(len(test), "evaluating") as bar:
        metrics = metrics_of(
            scene,
            test,
            seconds=training_seconds(folder),
            lpips=lpips,
            render_dir=renders,
            progress=lambda done, total: bar.advance(),
            colors=FrameColors.read(folder),
        )
    if origin is not None:
        metrics["provenance"] = origin
    sheet = renders / "contact_sheet.png"
    if sheet.is_file():
        write_atomically(folder / "contact_sheet.png", sheet.read_bytes())
    curves(folder / "log.jsonl", folder / "curves.png")
    if frames > 0:
        turntable(scene, folder / "turntable.mp4", frames)
    write_metrics(metrics, folder / "metrics.json")  # last: its presence marks the folder as complete
    return metrics


def turntable(scene: Scene, path: Path, frames: int, size: int = FILM_SIZE) -> None:
    """Render a film of the moving scene from a camera that circles it."""
    path_cameras = cameras.turntable(scene.overview, frames, size)
    views = [(camera, frame / max(frames - 1, 1)) for frame, camera in enumerate(path_cameras)]
    painter = Painter(scene, "rgb", views)
    with video.film(path, FPS) as writer, progress(frames, "turntable") as bar:
        for camera, time in views:
            writer.write(painter.paint(camera, time))
            bar.advance()


def summary(metrics: dict[str, Any]) -> str:
    """Format the scores for the terminal, one per line; the last line says where the subject is not covered, if it is
    not."""
    names = (
        "psnr",
        "mpsnr",
        "psnr_fitted",
        "psnr_interpolated",
        "psnr_worst",
        "ssim",
        "lpips",
        "epe",
        "jitter",
        "seconds",
        "gaussians",
        "control_points",
        "step",
    )
    scores = [(name, metrics[name]) for name in names if metrics.get(name) is not None]
    lines = [
        f"{name:>15}  {value:.4g}" if isinstance(value, float) else f"{name:>15}  {json.dumps(value)}"
        for name, value in scores
    ]
    return "\n".join([*lines, *filter(None, [coverage_line(metrics)])])
