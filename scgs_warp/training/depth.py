"""Depth maps as a term of the loss: Gaussians gather about the surfaces that the maps show.

Where a surface has no texture, or too few cameras see it, the photometric loss leaves its distance open. The term
compares inverse depths of everything that covers a pixel, so that fog before a surface counts as well as a surface at
the wrong distance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import cv2
import numpy as np
import torch
from torch import Tensor

from ..config.presets import TrainConfig
from ..data.dataset import Dataset
from ..errors import FrameError, UserError
from ..geometry.cameras import scaled_camera
from ..geometry.pinhole import ray_of
from ..ops.binning import bin_splats
from ..ops.compositing import composite
from ..ops.projection import project
from ..runtime.environment import one_piece
from ..runtime.progress import progress
from ..types import Camera, Gaussians, Splats, Tiles
from .flow import OPAQUE, flow_size

EVERY = 2
"""The term applies in every second step, with twice the weight."""
NEAREST = 1e-2
"""Depth, normalised, below which a Gaussian counts as being so near."""
SMOOTH = 1e-3
"""Relative error of inverse depth below which the term is quadratic."""
KEPT_MIB = 128
"""Memory for the depth of a run; maps beyond it are read again at each use."""
EDGE = 0.05
"""Relative difference of depth within 3 x 3 compared pixels beyond which they lie on an outline, which is not compared:
its pixels show two surfaces."""
LEAST_INVERSE = 0.25
"""Inverse depth, as a share of the view's mean weighted by itself, below which errors are no longer relative to it: a
sky at any distance would otherwise outweigh everything."""


class SeenDepth(NamedTuple):
    """Depth of a frame, compared at a reduced size."""

    camera: Camera
    """Of the frame, normalised, with the size of the depth."""
    inverse: Tensor
    """[h, w] inverse of the depth along z, normalised; 0 where it is unknown."""

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels [P, 2] with known depth, and their points [P, 3], normalised, row by row."""
        inverse = self.inverse.numpy()
        rows, columns = np.nonzero(inverse > 0)
        pixels = np.stack([columns, rows], 1).astype(np.float64)
        return pixels, self.points_at(pixels, inverse[rows, columns])

    def points_at(self, pixels: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Return the points [P, 3], normalised, at pixels [P, 2] with inverse depths [P]."""
        start, directions = ray_of(self.camera, pixels)
        along = directions @ self.camera.viewmat[2, :3].double().numpy()
        return start + directions / (inverse * along)[:, None]


class FrameDepths(Protocol):
    """Depth of training frames, from depth maps or by stereo."""

    @property
    def available(self) -> bool: ...

    def of(self, index: int) -> SeenDepth | None: ...


class Depths:
    """Depth maps of the training frames."""

    def __init__(self, data: Dataset, views: Sequence[Camera], scale: float) -> None:
        """
        Args:
            views: normalised cameras of the frames, on the host.
            scale: factor on depths by which they are normalised.
        """
        self._data, self._views, self._scale = data, views, scale
        self._kept: dict[int, SeenDepth] = {}

    @property
    def available(self) -> bool:
        """True if frames have a depth map."""
        return bool(self._data.with_depth)

    def read(self) -> None:
        """Read all maps once, so that a damaged one is found before training begins, and keep what fits.

        Raises:
            UserError: a file is missing or no depth map, or does not fit its image.
        """
        used, listed = 0, self._data.with_depth
        with progress(len(listed), "reading depth maps") as bar:
            for index in listed:
                seen = self._reduced(index)
                used += seen.inverse.nbytes
                if used <= KEPT_MIB * 2**20:
                    self._kept[index] = seen
                bar.advance()

    def of(self, index: int) -> SeenDepth | None:
        """Return the depth of a frame, on the host; None if it has none.

        Raises:
            FrameError: the file is no longer readable.
        """
        if index in self._kept or self._data.entries[index].depth is None:
            return self._kept.get(index)
        try:
            return self._reduced(index)
        except UserError as error:
            raise FrameError(str(error)) from error

    def _reduced(self, index: int) -> SeenDepth:
        depth, frame = self._data.depth(index), self._data[index]
        assert depth is not None, "asked for frames with a depth map only"
        seen = seen_depth(depth.numpy() * np.float32(self._scale), self._views[index])
        size = seen.inverse.shape[1], seen.inverse.shape[0]
        for plane, least in ((frame.mask, 1.0 - 1e-4), (frame.alpha, OPAQUE)):
            if plane is not None:
                shown = cv2.resize(plane.numpy().astype(np.float32), size, interpolation=cv2.INTER_AREA)
                seen.inverse[torch.from_numpy(shown <= least)] = 0.0
        return seen


def seen_depth(depth: np.ndarray, camera: Camera) -> SeenDepth:
    """Reduce a depth map [h, w] of any size to the size at which it is compared, without its outlines.

    Args:
        depth: along z, in the units of the camera; 0 or not finite where unknown.
    """
    size = flow_size(camera.width, camera.height)
    known = np.isfinite(depth) & (depth > 0)
    safe = np.where(known, depth, 0.0).astype(np.float32)
    around = np.ones((2 * max(1, round(depth.shape[1] / size[0])) + 1,) * 2)
    low = cv2.erode(np.where(known, safe, np.inf).astype(np.float32), around)
    high = cv2.dilate(safe, around)
    known &= (high - low) <= EDGE * safe
    taken = cv2.resize(np.where(known, safe, 0.0), size, interpolation=cv2.INTER_NEAREST_EXACT)
    with np.errstate(divide="ignore"):
        inverse = np.where(taken > 0, 1.0 / np.maximum(taken, 1e-30), 0.0)
    return SeenDepth(scaled_camera(camera, *size), torch.from_numpy(inverse.astype(np.float32)))


def depth_term(posed: Gaussians, seen: SeenDepth, binned: Callable[[Splats], Tiles] | None = None) -> Tensor:
    """Return the mean relative error of the inverse depths of what covers the pixels whose depth is known.

    A pixel's error is the root of the mean square over its splats, weighted as their colours are.

    Args:
        posed: N Gaussians at the time of the frame.
        seen: depth, on their device.
        binned: as in ``render.draw``.

    Returns:
        Scalar; gradients flow to all that places and covers.
    """
    camera = seen.camera
    shape = posed.quats, posed.scales, posed.opacities
    size = camera.width, camera.height
    splats = project(posed.means, *shape, camera.viewmat, camera.K, *size, sharpness=posed.sharpness)
    with one_piece():
        known = seen.inverse > 0
        typical = (seen.inverse.square().sum() / seen.inverse.sum().clamp_min(1e-12)).clamp_min(1e-6)
        inverse = 1.0 / (splats.depths.clamp_min(NEAREST) * typical)
        channels = torch.stack([inverse, inverse.square()], 1)
    image, alpha = composite(splats, channels, (binned or bin_splats)(splats))
    with one_piece():
        here = torch.where(known, seen.inverse / typical, 1.0)
        squares = (image[1] - 2.0 * here * image[0] + here.square() * alpha).clamp_min(0.0)
        squares = squares / here.clamp_min(LEAST_INVERSE).square()
        errors = (squares + SMOOTH**2).sqrt() - SMOOTH
        return torch.where(known, errors, 0.0).sum() / known.sum().clamp_min(1)


def depth_weight(step: int, config: TrainConfig) -> float:
    """Return the weight of the term at a main step; 0 in steps without it. It fades linearly until
    ``loss.depth_until``."""
    loss, until = config.loss, config.loss.depth_until * config.main_steps
    if not depth_applies(step, config) or step % EVERY:
        return 0.0
    return loss.depth * EVERY * (1.0 - step / until)


def depth_applies(step: int, config: TrainConfig) -> bool:
    """Return True during the main steps some of which compare depth."""
    return config.loss.depth > 0.0 and step < config.loss.depth_until * config.main_steps
