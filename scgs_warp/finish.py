"""What a run leaves behind when training is over: scores, contact sheet, curves, a turntable."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from . import cameras, film
from .data.dataset import Dataset
from .evaluate import metrics_of, write_metrics
from .overlay import Painter
from .progress import progress
from .report import curves
from .run_folder import read_seconds
from .scene import Scene

FILM_FRAMES = 120
FILM_SIZE = 400
FPS = 30.0


def finish(scene: Scene, test: Dataset, folder: Path, *, frames: int = FILM_FRAMES) -> dict[str, Any]:
    """Evaluate the last step on the test split and write every picture.

    Args:
        scene: as training left it.
        test: held-out frames.
        folder: the run directory; ``metrics.json``, ``contact_sheet.png``, ``curves.png``, ``turntable.mp4``,
            ``evaluation/`` go there.
        frames: length of the turntable.

    Returns:
        what ``metrics.json`` holds.
    """
    scene.freeze_binding()
    renders = folder / "evaluation" / test.split
    with progress(len(test), "evaluating") as bar:
        metrics = metrics_of(
            scene, test, seconds=read_seconds(folder), render_dir=renders, progress=lambda done, total: bar.advance()
        )
    write_metrics(metrics, folder / "metrics.json")
    sheet = renders / "contact_sheet.png"
    if sheet.is_file():
        (folder / "contact_sheet.png").write_bytes(sheet.read_bytes())
    curves(folder / "log.jsonl", folder / "curves.png")
    turntable(scene, folder / "turntable.mp4", frames)
    return metrics


def turntable(scene: Scene, path: Path, frames: int, size: int = FILM_SIZE) -> None:
    """A film of the moving scene seen from all around."""
    path_cameras = cameras.turntable(scene.overview, frames, size)
    views = [(camera, frame / max(frames - 1, 1)) for frame, camera in enumerate(path_cameras)]
    painter = Painter(scene, "rgb", views)
    with film.film(path, FPS) as writer, progress(frames, "turntable") as bar:
        for camera, time in views:
            writer.write(painter.paint(camera, time))
            bar.advance()


def summary(metrics: dict[str, Any]) -> str:
    """The scores, one line each, for the terminal."""
    names = ("psnr", "ssim", "lpips", "epe", "jitter", "seconds", "gaussians", "control_points", "step")
    found = [(name, metrics[name]) for name in names if metrics.get(name) is not None]
    return "\n".join(
        f"{name:>15}  {value:.4g}" if isinstance(value, float) else f"{name:>15}  {json.dumps(value)}"
        for name, value in found
    )
