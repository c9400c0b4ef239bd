"""A data set: posed, timed frames of one split, and what they have in common."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import overload

import torch
from torch import Tensor

from ..types import Camera, Frame

BACKGROUND_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "random": (0.0, 0.0, 0.0)}
"""What RGBA images are composited on when they are read. With ``random`` the trainer composites, once per step."""


def spread(count: int, most: int) -> list[int]:
    """At most ``most`` of the indices below ``count``, evenly from the first to the last."""
    if count <= most:
        return list(range(count))
    return [round(index * (count - 1) / max(most - 1, 1)) for index in range(most)]


class Dataset(Sequence[Frame]):
    """Frames of one split, in the order of the file that lists them.

    With ``background == "random"`` every image is premultiplied colour on black, and ``alpha`` is what is needed to
    put it on any colour: ``image + (1 - alpha) * color``.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        *,
        folder: Path,
        split: str,
        background: str = "black",
        points: Tensor | None = None,
        colors: Tensor | None = None,
    ) -> None:
        self._frames = tuple(frames)
        self.folder = folder
        self.split = split
        self.background = background
        """``black``, ``white`` or ``random``."""
        self.points = points
        """[P, 3] initial points, world units, where the data has some."""
        self.colors = colors
        """[P, 3] their colours in [0, 1], where the data has those, too."""

    def with_frames(self, frames: Sequence[Frame]) -> Dataset:
        """The same data set of other frames."""
        return Dataset(
            frames,
            folder=self.folder,
            split=self.split,
            background=self.background,
            points=self.points,
            colors=self.colors,
        )

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Frame, ...]: ...
    def __getitem__(self, index: int | slice) -> Frame | tuple[Frame, ...]:
        return self._frames[index]

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._frames)

    @property
    def background_color(self) -> Tensor:
        """[3] the colour that the images were composited on."""
        return torch.tensor(BACKGROUND_COLORS[self.background])

    @property
    def fingerprint(self) -> str:
        """Of the frames' names, times, sizes and background, without any path: a run resumes on the same frames."""
        listed = [(frame.name, frame.time, *frame.image.shape) for frame in self._frames]
        return hashlib.sha256(repr((self.background, listed)).encode()).hexdigest()[:16]

    @property
    def cameras(self) -> list[Camera]:
        return [frame.camera for frame in self._frames]

    @property
    def times(self) -> Tensor:
        """[V] in [0, 1]."""
        return torch.tensor([frame.time for frame in self._frames], dtype=torch.float32)

    @property
    def extent(self) -> float:
        """Largest distance of a camera centre from the centres' mean, world units (official SC-GS: no 1.1 factor)."""
        centres = torch.stack([camera.position.double().cpu() for camera in self.cameras])
        return float((centres - centres.mean(0)).norm(dim=1).max())
