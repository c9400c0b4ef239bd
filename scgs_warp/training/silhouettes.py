"""Silhouettes in stage 1: the images' alpha draws spheres to where the subject is, and limits their size.

The photometric loss moves a sphere only as far as the sphere reaches. Where a thin or fast part has left its spheres,
this loss makes them transparent instead of moving them, and the part is lost. The distance between projected centres
and the silhouette has a gradient at any range.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt, label
from torch import Tensor

from ..data.dataset import Dataset
from ..geometry.normalisation import Normalisation
from ..kernels.silhouette import NEAREST_DEPTH
from ..ops.silhouette import silhouette
from ..runtime.device_copies import sent
from ..types import Camera

COVERED = 0.3
"""Alpha from which a pixel belongs to the silhouette. Below one half, because rods thinner than a pixel count, too."""
FILLED = 0.95
"""Share of covered pixels above which an image is taken for a filled one with an alpha channel, without silhouette."""
LONGEST_SIDE = 256
"""Silhouettes of larger images are reduced to at most this many pixels per side."""
KEPT_MIB, KEPT_ON_GPU_MIB = 64, 1024
"""Memory for the silhouettes of a run, so that a film of any length fits. On a CPU it holds 400 of 480 x 270 pixels;
others are found again at each use, which takes a few milliseconds. On a GPU that would hold up the steps."""
PIXELS = 512
"""Number of silhouette pixels that are compared in each step."""
MEASURED_VIEWS = 50
"""Largest number of images in which the subject's thickness is measured."""
THIN = 0.02
"""Half width of the silhouette, as a share of the image's width, below which a subject is thin."""
PART = 0.005
"""Share of the silhouette's pixels from which a connected region counts as a part."""
SELDOM = 0.05
"""Share of the silhouettes below which several regions say nothing about the subject."""
JUDGED_VIEWS = 20
"""Largest number of images from which thin subjects and separate parts are told."""


class Silhouette(NamedTuple):
    """The silhouette in one image. Lengths are in units of the image's width."""

    distances: Tensor
    """[h, w] distance of each pixel to the silhouette, 0 inside."""
    pixels: Tensor
    """[P, 2] centres (x, y) of the pixels inside, row by row, on the host."""
    size: Tensor
    """[2] width and height of ``distances``. Pixels of a reduced silhouette cover several of the image's."""

    @property
    def bytes(self) -> int:
        return sum(tensor.numel() * tensor.element_size() for tensor in self)

    def sample(self, random: torch.Generator) -> SilhouetteSample:
        """Choose ``PIXELS`` of the pixels at random, with replacement."""
        chosen = self.pixels[torch.randint(len(self.pixels), (PIXELS,), generator=random)]
        return SilhouetteSample(self.distances, sent(chosen, self.distances.device), self.size)


class SilhouetteSample(NamedTuple):
    """What a step compares with the spheres, on one device."""

    distances: Tensor
    """[h, w] as in :class:`Silhouette`."""
    pixels: Tensor
    """[PIXELS, 2] some of the silhouette's pixels."""
    size: Tensor
    """[2] as in :class:`Silhouette`."""


def silhouette_of(alpha: Tensor, device: str = "cpu") -> Silhouette | None:
    """Find the silhouette in coverage [H, W]; None if nothing or almost everything is covered."""
    covered = alpha.detach().cpu() >= COVERED
    if float(covered.float().mean()) > FILLED:
        return None
    reduction = -(-max(covered.shape) // LONGEST_SIDE)
    # A reduced pixel is covered if any of its pixels is, so thin parts stay.
    inside = F.max_pool2d(covered[None].float(), reduction, ceil_mode=True)[0] > 0
    if not inside.any():
        return None
    pixel = reduction / covered.shape[1]
    distances = torch.from_numpy(_distances((~inside).numpy()) * pixel).float()
    centres = (inside.nonzero().flip(1).float() + 0.5) * pixel
    size = centres.new_tensor(distances.shape).flip(0) * pixel
    return Silhouette(distances.to(device), centres, size.to(device))


def _distances(mask: np.ndarray) -> np.ndarray:
    """Return the distance of each True pixel to the nearest False one, pixels. OpenCV's transform is not used, because
    its last bits differ from call to call."""
    return np.asarray(distance_transform_edt(mask))


def silhouette_term(means: Tensor, camera: Camera, sample: SilhouetteSample) -> Tensor:
    """Return the mean distance of projected centres to the silhouette, plus the mean distance of its pixels to the
    nearest centre.

    Args:
        means: [N, 3] centres at the time of the image, normalised.
        camera: camera of the image, normalised.
        sample: of the image's silhouette, on the device of the centres.

    Returns:
        Scalar, in units of the image's width. Gradients flow to ``means``.
    """
    return silhouette(means, camera, sample.distances, sample.size, sample.pixels)


class Silhouettes:
    """Silhouettes of the training images, each found at its first use and kept if there is room."""

    def __init__(self, device: str) -> None:
        self.device = device
        self.room = (KEPT_MIB if torch.device(device).type == "cpu" else KEPT_ON_GPU_MIB) * 2**20
        """Bytes that further silhouettes may take."""
        self._found: dict[Hashable, Silhouette | None] = {}

    def of(self, key: Hashable, alpha: Callable[[], Tensor]) -> Silhouette | None:
        """Return the silhouette of an image, None if it has none; the same key must stand for the same image.

        Args:
            alpha: returns the image's coverage [H, W]; called only if the silhouette is not kept.
        """
        if key in self._found:
            return self._found[key]
        found = silhouette_of(alpha(), self.device)
        size = 0 if found is None else found.bytes
        if size <= self.room:
            self._found[key] = found
            self.room -= size
        return found


def is_thin(data: Dataset) -> bool:
    """Decide whether the subject is thin: the median over images of the silhouette's half width is below ``THIN``."""
    shares = [width / data.entries[index].camera.width for index, width in _half_widths(data, JUDGED_VIEWS)]
    return bool(shares) and float(np.median(shares)) < THIN


def is_in_parts(data: Dataset) -> bool:
    """Decide whether the subject consists of separate parts: at least half of the silhouettes do."""
    return _share_in_parts(data, JUDGED_VIEWS) >= 0.5


def is_one_piece(data: Dataset) -> bool:
    """Decide whether the subject may be one body that never falls apart, since its silhouettes do not. A few may, where
    something thin is lost between pixels."""
    return _share_in_parts(data, MEASURED_VIEWS) < SELDOM


def _share_in_parts(data: Dataset, most: int) -> float:
    """Return the share of at most about ``most`` silhouettes that consist of several regions; NaN without any."""
    separate = []
    for _, covered in _covered(data, most):
        regions: Any = label(covered, structure=np.ones((3, 3)))
        sizes = np.bincount(regions[0].ravel())[1:]
        separate.append(int((sizes >= PART * sizes.sum()).sum()) >= 2)
    return float(np.mean(separate)) if separate else math.nan


def half_thickness(data: Dataset, normalisation: Normalisation) -> float:
    """Measure half the typical thickness of the subject, normalised: the median over images of the silhouette's half
    width.

    Returns:
        Infinity if no frame has a silhouette.
    """
    found = []
    for index, width in _half_widths(data, MEASURED_VIEWS):
        camera = normalisation.apply_camera(data.entries[index].camera)
        # The subject surrounds the origin of the normalised scene.
        depth = max(float(camera.viewmat[2, 3]), NEAREST_DEPTH)
        found.append(width * depth / float(camera.K[0, 0]))
    return float(np.median(found)) if found else float("inf")


def _half_widths(data: Dataset, most: int) -> Iterator[tuple[int, float]]:
    """Measure the silhouette's half width, pixels, in at most about ``most`` images; yield it with the image's index.

    In a strip of half width w, pixels are w / 2 from the border on average.
    """
    for index, covered in _covered(data, most):
        yield index, 2.0 * (float(_distances(covered)[covered].mean()) - 0.5)


def _covered(data: Dataset, most: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the silhouettes [H, W] of at most about ``most`` images, with their indices."""
    for index in data.with_alpha[:: max(1, len(data.with_alpha) // most)]:
        alpha = data[index].alpha
        assert alpha is not None
        covered = (alpha.cpu() >= COVERED).numpy()
        if 0.0 < covered.mean() <= FILLED:
            yield index, covered
