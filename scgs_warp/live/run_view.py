"""Packed scenes of runs and files for ``SceneView``."""

from __future__ import annotations

from pathlib import Path

from ..errors import UserError
from ..export.page import MAX_DEGREE
from ..export.page_data import pack
from ..export.page_scene import page_scene
from ..geometry.axes import Axis
from ..scene.from_gaussians import open_gaussians
from ..scene.scene import Scene
from ..storage import checkpoint
from .viewer import RunWatcher, SceneView


def packed(scene: Scene) -> bytes:
    """Return a scene as its page reads it."""
    content = page_scene(scene, min(scene.gaussians.sh_degree, MAX_DEGREE))
    return pack(content.facts, content.columns)


def read_run(folder: Path, device: str) -> tuple[bytes, str]:
    """Return the scene of a run's newest checkpoint, and a line that says how far its training is.

    Raises:
        UserError: there is no scene that a page can show.
    """
    scene = Scene.load(folder, device=device)
    steps = scene.config.steps
    done = scene.step >= steps
    return packed(scene), "" if done else f"step {scene.step:,} of {steps:,}, {scene.gaussian_count:,} Gaussians"


def _may_still_train(folder: Path) -> bool:
    return (folder / "config.json").is_file() and not (folder / "metrics.json").is_file()


def view_run(folder: Path, view: SceneView, device: str) -> RunWatcher:
    """Show a run, now and after each later checkpoint. A run whose training has just begun is waited for.

    Raises:
        UserError: there is no scene, and no training that may write one.
    """
    try:
        view.publish(*read_run(folder, device))
    except UserError as error:
        if not _may_still_train(folder):
            raise
        view.say(f"waiting for the training: {error}")
    return RunWatcher(folder / checkpoint.FILE, view, lambda: read_run(folder, device))


def view_file(path: Path, view: SceneView, device: str, up: Axis | None = None) -> None:
    """Show a file of Gaussians, with one of its axes up (``open_gaussians``).

    Raises:
        UserError: the file cannot be read.
    """
    view.publish(packed(open_gaussians(path, device, up=up)))
