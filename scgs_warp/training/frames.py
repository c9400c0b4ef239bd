"""Training views: normalised cameras, planar images on the device, and the random order of the frames."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..config.presets import TrainConfig
from ..data.cache import Pixels
from ..data.dataset import Dataset
from ..errors import FrameError, UserError
from ..geometry.normalisation import Normalisation
from ..runtime.device_copies import sent
from ..seeding import Purpose, generator
from ..types import Camera, Frame
from .depth import Depths, FrameDepths
from .device_images import DeviceImages
from .flow import Flows
from .silhouettes import Silhouette, Silhouettes
from .stereo_depth import StereoDepths

PROGRESSIVE_SHARE = 0.2
"""Share of the frames with which progressive pre-training begins and by which it grows."""
LEAST_HALVED_SIDE = 64
"""Shorter side in pixels below which images are not halved."""


def first_frames(data: Dataset) -> Dataset:
    """Return the first fifth of the frames by time, with which progressive pre-training begins."""
    ordered = sorted(range(len(data)), key=lambda index: data.entries[index].time)
    return data.subset(ordered[: max(1, round(PROGRESSIVE_SHARE * len(ordered)))])


def view_number(step: int, config: TrainConfig, view: int) -> int:
    """Number the views of all steps. The order of frames and a view's random draws depend on this number rather than on
    the process that renders the view."""
    return step * config.batch + view


def _half(frame: Frame) -> Pixels:
    """Average image and alpha over 2 x 2 pixels; a pixel is valid where all four were."""

    def pool(image: Tensor) -> Tensor:
        return F.avg_pool2d(image[None], 2)[0]

    image = pool(frame.image.permute(2, 0, 1))
    alpha = None if frame.alpha is None else pool(frame.alpha[None])[0]
    mask = None if frame.mask is None else pool(frame.mask[None].float())[0] == 1.0
    return Pixels(image.permute(1, 2, 0), alpha, mask)


class Parts(NamedTuple):
    """What a frame has beside its colours."""

    alpha: bool
    mask: bool


class Loaded(NamedTuple):
    """A view of a training frame."""

    camera: Camera
    """Normalised, on the host."""
    background: Tensor
    """[3] on the host."""
    truth: Tensor
    """[3, H, W] on the device, composited on that background."""
    mask: Tensor | None
    """[H, W] bool on the device. None: all pixels are valid."""
    silhouette: Silhouette | None
    """None: not asked for, or the frame has no alpha."""


class Frames:
    """Training frames in random order without replacement: the order is the same for the same seed and differs between
    epochs."""

    def __init__(
        self,
        data: Dataset,
        normalisation: Normalisation,
        config: TrainConfig,
        device: str,
        stereo: StereoDepths | None = None,
    ) -> None:
        """
        Args:
            stereo: depth of frames without depth maps.
        """
        self.data = data
        self.config, self.device = config, torch.device(device)
        self.views = [normalisation.apply_camera(frame.camera) for frame in data.entries]
        """Normalised cameras, on the host."""
        self.background = data.background_color
        self.images = DeviceImages(self.device)
        self.random_background = data.background == "random"
        self.silhouettes = Silhouettes(device)
        self.flows = Flows(data, self.views)
        maps = Depths(data, self.views, normalisation.scale)
        if config.loss.depth > 0.0 and maps.available:
            maps.read()
        self.depths: FrameDepths = stereo if stereo is not None and not maps.available else maps
        self._parts: dict[tuple[int, bool], Parts] = {}
        self._order: tuple[tuple[int, int], list[int]] = ((-1, 0), [])
        self.by_time = sorted(range(len(self.data)), key=lambda i: data.entries[i].time)
        self.interrupted: Callable[[], bool] = lambda: False
        """Called between the views of a step; if it returns True, the step ends without effect (``multi_view``)."""

    def __len__(self) -> int:
        return len(self.data)

    def index_at(self, step: int, progressive: bool, view: int = 0) -> int:
        """Return the index of the frame of this step's ``view``.

        Args:
            progressive: draw from the first 20 % of the frames by time at first, and add another 20 % every
                ``progressive_every`` steps. With ``progressive_by`` fifth, these are added at once. With frame, they
                are added one by one, and every other view is one of the newest 20 %, so that the spheres follow a
                moving limb before views of its earlier positions make them transparent.
        """
        first, allowed, number = 0, len(self.data), view_number(step, self.config, view)
        if progressive:
            pretrain = self.config.pretrain
            by_frame = pretrain.progressive_by == "frame"
            added = step / pretrain.progressive_every if by_frame else step // pretrain.progressive_every
            allowed = min(allowed, max(1, round(PROGRESSIVE_SHARE * (1.0 + added) * allowed)))
            if by_frame and number % 2 and allowed < len(self.data):
                first = max(0, allowed - max(1, round(PROGRESSIVE_SHARE * len(self.data))))
        count = allowed - first
        epoch, position = divmod(number, count)
        if self._order[0] != (epoch, count):
            order = torch.randperm(count, generator=generator(self.config.seed, Purpose.FRAME_ORDER, epoch, count))
            self._order = ((epoch, count), order.tolist())
        return self.by_time[first + self._order[1][position]]

    def halves(self, index: int, step: int) -> bool:
        """Return whether this step uses the frame at half its size."""
        camera = self.views[index]
        return step < self.config.half_size and min(camera.width, camera.height) >= LEAST_HALVED_SIDE

    def camera(self, index: int, halved: bool) -> Camera:
        """Return the frame's normalised camera, on the host."""
        camera = self.views[index]
        if not halved:
            return camera
        intrinsics = camera.K * camera.K.new_tensor([0.5, 0.5, 1.0])[:, None]
        return Camera(camera.viewmat, intrinsics, camera.width // 2, camera.height // 2)

    def pixels(self, index: int, halved: bool) -> Pixels:
        """Read the frame's image, at half the size if asked: each pixel is then the mean of four.

        Raises:
            FrameError: the frame's file is no longer readable.
        """
        try:
            if halved:
                found = self.data.cache.get((self, index), lambda: _half(self.data[index]))
            else:
                frame = self.data[index]
                found = Pixels(frame.image, frame.alpha, frame.mask)
        except UserError as error:
            raise FrameError(str(error)) from error
        self._parts[index, halved] = Parts(found.alpha is not None, found.mask is not None)
        return found

    def expect(self, step: int, progressive: bool, view: int = 0) -> None:
        """Start to read the frame of this step's ``view`` in the background, unless it is in memory."""
        index = self.index_at(step, progressive, view)
        if (self, index) not in self.data.cache and not any(self.images.hold((index, half)) for half in (False, True)):
            self.data.expect(index)

    def load(self, index: int, step: int, random_background: bool, sought: bool, view: int = 0) -> Loaded:
        """Load the images of this step's ``view``. A file whose images are on the device is not read.

        Args:
            sought: whether the silhouette is needed.

        Raises:
            FrameError: the frame's file is no longer readable.
        """
        halved = self.halves(index, step)
        key = index, halved
        pixels = cache(lambda: self.pixels(index, halved))
        truth = self.images.planar(key, lambda: pixels().image)
        has_alpha, has_mask = self._parts[key]
        background = self.background
        if has_alpha and (random_background or self.random_background):
            random = generator(self.config.seed, Purpose.BACKGROUND, view_number(step, self.config, view))
            color = torch.rand(3, generator=random)
            uncovered = 1.0 - self.images.plane(("alpha", *key), lambda: present(pixels().alpha))
            truth = truth + uncovered * sent(color - background, self.device)[:, None, None]
            background = color
        mask = self.images.plane(("mask", *key), lambda: present(pixels().mask)) if has_mask else None
        silhouette = self.silhouettes.of(key, lambda: present(pixels().alpha)) if sought and has_alpha else None
        return Loaded(self.camera(index, halved), background, truth, mask, silhouette)


def present(plane: Tensor | None) -> Tensor:
    """Return a plane that is known to be there."""
    assert plane is not None
    return plane
