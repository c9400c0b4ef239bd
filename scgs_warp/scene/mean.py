"""The mean of several trainings of one data set, whose errors partly cancel."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from ..errors import UserError
from ..geometry.cameras import Overview
from ..types import Camera, Image
from .scene import Scene

SAME = 1e-3
"""Largest difference of two summaries of the same cameras, relative to their distance."""


class MeanScene(Scene):
    """Scene whose pictures are the means of those of several scenes.

    Trainings that differ in their seeds alone err in different ways, so the mean errs less than each
    (docs/quality.md). A picture takes as long as those of all scenes together. Everything but pictures and
    ``gaussian_count`` is that of the first scene.

    Attributes: ``scenes``.
    """

    def __init__(self, scenes: Sequence[Scene]) -> None:
        first = scenes[0]
        parts = first.gaussians, first.motion, first.normalisation, first.config, first.overview
        super().__init__(*parts, step=first.step, settings=first.settings)
        self.folder, self.scenes = first.folder, tuple(scenes)

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
        rgb, alpha, depth = 0.0, 0.0, 0.0
        for scene in self.scenes:
            image = scene.render(camera, time, self.background_color if background is None else background)
            rgb, alpha, depth = rgb + image.rgb, alpha + image.alpha, depth + image.depth * image.alpha
        assert isinstance(rgb, Tensor) and isinstance(alpha, Tensor) and isinstance(depth, Tensor)
        depth = torch.where(alpha > 0.0, depth / alpha.clamp_min(1e-12), 0.0)
        return Image(rgb / len(self.scenes), alpha / len(self.scenes), depth)


def load_mean(runs: Sequence[Path], device: str = "cpu") -> Scene:
    """Load the mean of several runs, or the scene of a single one.

    Raises:
        UserError: a run cannot be loaded (``Scene.load``), or was trained with other cameras than the first.
    """
    scenes = [Scene.load(run, device=device) for run in runs]
    for run, scene in zip(runs[1:], scenes[1:]):
        if not _same_cameras(scene.overview, scenes[0].overview):
            raise UserError(f"{run}: was trained with other cameras than {runs[0]}; give runs of one data set")
    return scenes[0] if len(scenes) == 1 else MeanScene(scenes)


def _same_cameras(one: Overview, other: Overview) -> bool:
    apart = torch.tensor([*one.centre, one.radius]) - torch.tensor([*other.centre, other.radius])
    turned = torch.tensor(one.up) - torch.tensor(other.up)
    return float(apart.abs().max()) <= SAME * other.radius and float(turned.abs().max()) <= SAME
