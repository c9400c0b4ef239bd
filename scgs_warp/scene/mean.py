"""The mean of several trainings of one data set, whose errors partly cancel."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from ..errors import UserError
from ..storage import checkpoint
from ..storage.recorded_images import differ
from ..types import Camera, Image
from .scene import Scene


class MeanScene(Scene):
    """Scene whose pictures are the means of those of several scenes.

    Trainings that differ in their seeds alone err in different ways, so the mean errs less than each
    (docs/quality.md). A picture takes as long as those of all scenes together. ``gaussian_count`` is that of all;
    Gaussians and control points are those of the first scene, since motions have no mean.

    Attributes: ``scenes``.
    """

    def __init__(self, scenes: Sequence[Scene]) -> None:
        first = scenes[0]
        parts = first.gaussians, first.motion, first.normalisation, first.config, first.overview
        super().__init__(*parts, step=first.step, settings=first.settings)
        self.folder, self.scenes = first.folder, tuple(scenes)

    @property
    def unfinished(self) -> str | None:
        """As that of a single scene, for the first that has not reached its last step."""
        return next((scene.unfinished for scene in self.scenes if scene.unfinished is not None), None)

    def _repr_html_(self) -> str | None:
        """Return None: a page shows a single scene."""
        return None

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians of all scenes."""
        return sum(scene.gaussian_count for scene in self.scenes)

    @torch.no_grad()
    def render(
        self, camera: Camera, time: float, background: tuple[float, float, float] | Tensor | None = None
    ) -> Image:
        """Render the mean of all scenes; arguments and errors are those of ``Scene.render``. Depth is weighted by
        opacity."""
        rgb = alpha = depth = torch.zeros(())
        for scene in self.scenes:
            image = scene.render(camera, time, self.background_color if background is None else background)
            rgb, alpha, depth = rgb + image.rgb, alpha + image.alpha, depth + image.depth * image.alpha
        depth = torch.where(alpha > 0.0, depth / alpha.clamp_min(1e-12), 0.0)
        return Image(rgb / len(self.scenes), alpha / len(self.scenes), depth)


def load_mean(runs: Sequence[str | Path], device: str = "cpu") -> Scene:
    """Load the mean of several runs, or the scene of a single one.

    Raises:
        UserError: a run cannot be loaded (``Scene.load``), is given twice, or was trained on other frames than the
            first.
    """
    folders = [Path(run) for run in runs]
    scenes = [Scene.load(run, device=device) for run in folders]
    for place, run in enumerate(folders[1:], 1):
        if any(run.samefile(before) for before in folders[:place]):
            raise UserError(f"{run}: is given twice; give runs with different seeds")
        same_cameras = scenes[place].overview == scenes[0].overview
        (frames, images), (others, shown) = _frames_of(folders[0]), _frames_of(run)
        if not same_cameras or others != frames or differ(images, shown):
            raise UserError(f"{run}: was trained on other frames than {folders[0]}; give runs of one data set")
    return scenes[0] if len(scenes) == 1 else MeanScene(scenes)


def _frames_of(run: Path) -> tuple[str | None, str]:
    """Return the hash of the names, times and sizes of a run's training frames, and their thumbnails; "": unknown."""
    recorded = checkpoint.read(run, ())[1]
    images = recorded.get("images")
    shown = images.get("train") if isinstance(images, dict) else None
    return recorded.get("frames"), shown if isinstance(shown, str) else ""
