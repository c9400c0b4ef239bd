"""The data set: posed, timed frames of one split, with initial points and a background."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import overload

import torch
from torch import Tensor

from ..config.fields import BACKGROUND_COLORS
from ..errors import UserError
from ..types import Camera, Frame
from .cache import ImageCache, Pixels
from .images import size_text


def spread(count: int, most: int) -> list[int]:
    """Choose at most ``most`` of the indices 0 .. ``count`` - 1, evenly spaced from the first to the last."""
    if count <= most:
        return list(range(count))
    return [round(index * (count - 1) / max(most - 1, 1)) for index in range(most)]


@dataclass(frozen=True, eq=False)
class StoredFrame:
    """A frame whose pixels are read from disk on access."""

    camera: Camera
    time: float
    name: str
    read: Callable[[], Pixels]
    """Function that decodes the file; it returns the same pixels every time."""
    has_alpha: bool = False
    """True if the alpha of the file is used; otherwise it is ignored."""
    common_mask: Tensor | None = None
    """[H, W] bool, to be combined with the frame's own mask."""
    key: object = field(default_factory=object)
    """Key of the pixels in the cache."""
    depth: Callable[[], Tensor] | None = None
    """Function that reads the frame's depth map, as ``Frame.depth``; None without one."""
    covisible: Callable[[], Tensor] | None = None
    """Function that reads the mask of what training images show as well, [H, W] bool; None without one."""

    def frame(self, cache: ImageCache) -> Frame:
        """Read the pixels.

        Raises:
            UserError: the file is missing, unreadable, or has changed its size.
        """
        image, alpha, mask = cache.get(self.key, self.read)
        size = (self.camera.height, self.camera.width)
        if image.shape[:2] != size:
            raise UserError(
                f"{self.name}: its image has another size than when training began ({size_text(image.shape[1::-1])}, "
                f"then {size_text(size[::-1])}); restore the file"
            )
        if self.common_mask is not None:
            mask = self.common_mask if mask is None else mask & self.common_mask
        return Frame(self.camera, self.time, image, alpha if self.has_alpha else None, mask, self.name)


class Dataset(Sequence[Frame]):
    """Frames of one split, in the order of the file that lists them.

    Pixels are read when a frame is accessed, and cached while ``cache`` has room. Iterate over frames one by one, and
    use ``entries`` for everything but pixels.

    With ``background == "random"``, every image holds premultiplied colour on black; ``image + (1 - alpha) * color``
    composites it on any colour.
    """

    def __init__(
        self,
        frames: Sequence[Frame | StoredFrame],
        *,
        folder: Path,
        split: str,
        background: str = "black",
        points: Tensor | None = None,
        colors: Tensor | None = None,
        cache: ImageCache | None = None,
        notes: Sequence[str] = (),
        bounds: tuple[float, float] | None = None,
    ) -> None:
        self.entries = tuple(frames)
        """Camera, time and name of each frame, without pixels unless the frame is in memory."""
        self.folder = folder
        self.split = split
        self.background = background
        """``black``, ``white`` or ``random``."""
        self.points = points
        """[P, 3] initial points, world units; None if the data has none."""
        self.colors = colors
        """[P, 3] colours of the initial points in [0, 1]; None if the data has none."""
        self.cache = cache if cache is not None else ImageCache()
        self.notes = tuple(notes)
        """Lines on what was left out, for the user."""
        self.bounds = bounds
        """Nearest and farthest depth of the content, world units; None if the data does not tell."""

    def _with(self, entries: Sequence[Frame | StoredFrame]) -> Dataset:
        return Dataset(
            entries,
            folder=self.folder,
            split=self.split,
            background=self.background,
            points=self.points,
            colors=self.colors,
            cache=self.cache,
            notes=self.notes,
            bounds=self.bounds,
        )

    def with_cameras(self, cameras: Sequence[Camera]) -> Dataset:
        """Return the data set with other cameras, one for each frame; ValueError: there are more or fewer."""
        if len(cameras) != len(self):
            raise ValueError(f"cameras must be one for each of the {len(self)} frames, got {len(cameras)}")
        return self._with([dataclasses.replace(entry, camera=camera) for entry, camera in zip(self.entries, cameras)])

    def subset(self, indices: Sequence[int]) -> Dataset:
        """Return a data set of the given frames, in the given order."""
        return self._with([self.entries[index] for index in indices])

    def without_points(self) -> Dataset:
        """Return the data set without initial points."""
        data = self._with(self.entries)
        data.points = data.colors = None
        return data

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Frame, ...]: ...
    def __getitem__(self, index: int | slice) -> Frame | tuple[Frame, ...]:
        if isinstance(index, slice):
            return tuple(self._frame(entry) for entry in self.entries[index])
        return self._frame(self.entries[index])

    def _frame(self, entry: Frame | StoredFrame) -> Frame:
        return entry if isinstance(entry, Frame) else entry.frame(self.cache)

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[Frame]:
        return (self._frame(entry) for entry in self.entries)

    def expect(self, index: int) -> None:
        """Start to read a frame in the background, before it is accessed."""
        entry = self.entries[index]
        if isinstance(entry, StoredFrame):
            self.cache.expect(entry.key, entry.read)

    def depth(self, index: int) -> Tensor | None:
        """Return the depth map of a frame, as ``Frame.depth``. It is read anew at each access.

        Raises:
            UserError: the file is missing or no depth map, or does not fit its image.
        """
        depth = self.entries[index].depth
        return depth() if callable(depth) else depth

    def covisible(self, index: int) -> Tensor | None:
        """Return [H, W] bool, True where training images show what a frame shows; None if the data do not tell.

        Raises:
            UserError: the file is missing or no mask, or does not fit its image.
        """
        entry = self.entries[index]
        return entry.covisible() if isinstance(entry, StoredFrame) and entry.covisible is not None else None

    @property
    def with_depth(self) -> list[int]:
        """Indices of the frames with a depth map."""
        return [index for index, entry in enumerate(self.entries) if entry.depth is not None]

    @property
    def with_alpha(self) -> list[int]:
        """Indices of the frames with alpha."""
        return [
            index
            for index, entry in enumerate(self.entries)
            if (entry.has_alpha if isinstance(entry, StoredFrame) else entry.alpha is not None)
        ]

    @property
    def background_color(self) -> Tensor:
        """[3] colour on which the images are composited."""
        return torch.tensor(BACKGROUND_COLORS[self.background])

    @property
    def fingerprint(self) -> str:
        """Hash of the background and of the frames' names, times and sizes. A run resumes only on a data set with the
        same hash."""
        listed = [(entry.name, entry.time, entry.camera.height, entry.camera.width, 3) for entry in self.entries]
        return hashlib.sha256(repr((self.background, listed)).encode()).hexdigest()[:16]

    @property
    def cameras(self) -> list[Camera]:
        return [entry.camera for entry in self.entries]

    @property
    def times(self) -> Tensor:
        """[V] times of the frames in [0, 1]."""
        return torch.tensor([entry.time for entry in self.entries], dtype=torch.float32)

    @property
    def extent(self) -> float:
        """Largest distance of a camera centre from the mean of the centres, world units (official SC-GS, without its
        factor of 1.1)."""
        centres = torch.stack([camera.position.double().cpu() for camera in self.cameras])
        return float((centres - centres.mean(0)).norm(dim=1).max())


def neighbors_in_time(data: Dataset) -> Tensor:
    """Return [V, 2] indices of the frames before and after each frame, among those of the same camera if the cameras
    stand still."""
    poses = [tuple(camera.viewmat.flatten().tolist()) for camera in data.cameras]
    still = len(set(poses)) <= len(poses) // 2
    groups: dict[object, list[int]] = {}
    for index in sorted(range(len(poses)), key=lambda index: float(data.times[index])):
        groups.setdefault(poses[index] if still else None, []).append(index)
    neighbors = torch.zeros(len(poses), 2, dtype=torch.long)
    for group in groups.values():
        for place, index in enumerate(group):
            neighbors[index, 0] = group[max(place - 1, 0)]
            neighbors[index, 1] = group[min(place + 1, len(group) - 1)]
    return neighbors
