"""The first stage of a capture: the picked frames, written as images."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Sequence
from itertools import islice, takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import UserError
from ..runtime.progress import ShowProgress
from ..storage.json_files import as_number
from ..storage.png_files import write_png
from . import moving, picking
from .bars import Bars, cut_off, find_bars
from .completeness import Incomplete
from .cut_out import is_cut_out
from .journal import Journal
from .request import CaptureRequest
from .source import Source
from .source_frame import SourceFrame

MAX_SECONDS = 1e9
"""Largest plausible time in a film, seconds."""
VIDEO_FRAMES = 150


class PickedFrames(NamedTuple):
    """The picked frames of a source."""

    indices: list[int]
    """Indices in the source."""
    seconds: list[float]
    names: list[str]
    """File names of the images of a folder; empty strings for a video."""
    span: tuple[float, float]
    """Times of the video, in seconds, that become times 0 and 1."""
    size: tuple[int, int]
    """(width, height)"""
    seen: int
    """Number of frames in the source."""
    blurred: int
    alike: int
    decoded: int = 0
    """Number of frames of an incomplete video that can be decoded."""
    announced: int = 0
    """Number of frames of an incomplete video according to its header; 0 if nothing is missing."""
    cut_out: bool = False
    """True if the frames are cut out by alpha."""
    turns: Sequence[int] = ()
    """Quarter turns of the images of a folder that were turned to have one size; empty if none was."""
    bars: Bars = Bars()
    """Black bars that were cut off; ``size`` is without them."""

    @property
    def incomplete(self) -> Incomplete | None:
        """What is there of an incomplete video."""
        return Incomplete(self.decoded, self.announced, self.span[1]) if self.announced else None

    @property
    def whole_size(self) -> tuple[int, int]:
        """(width, height) with the bars."""
        return self.size[0] + self.bars.left + self.bars.right, self.size[1] + self.bars.top + self.bars.bottom

    @property
    def files(self) -> list[str]:
        return [f"{moving.frame_name(index)}.png" for index in self.indices]


def pick_frames(request: CaptureRequest, source: Source, journal: Journal, show: ShowProgress) -> PickedFrames:
    """Pick the frames and write them."""
    folder = journal.work / "frames"

    def make() -> dict[str, Any]:
        chosen = choose(request, source, show)
        folder.mkdir(exist_ok=True)
        written = _Written(folder)
        with show(len(chosen.indices), "writing frames") as bar:
            wanted = set(chosen.indices)
            for still in islice(source.frames(request.size, wanted), len(wanted)):
                written.add(still)
                bar.advance()
        return written.finished(chosen)._asdict()

    settings = {key: getattr(request, key) for key in ("frames", "start", "end", "size")}
    stored = journal.stage("frames", settings, make, lambda: shutil.rmtree(folder, ignore_errors=True))
    frames = frames_of(stored)
    if frames is None:
        raise journal.damaged("frames")
    return frames


class _Written:
    """Frames in a folder, and what they have in common."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names: list[str] = []
        self.turns: list[int] = []
        self.cut_out = False
        self.brightest = np.zeros((0, 0), np.uint8)

    def add(self, still: SourceFrame) -> None:
        """Write a frame."""
        alpha = [] if still.alpha is None else [still.alpha]
        write_png(self.folder / f"{moving.frame_name(still.index)}.png", np.dstack([still.image, *alpha]))
        self.names.append(still.name)
        self.turns.append(still.turns)
        self.cut_out = self.cut_out or is_cut_out(still.alpha)
        bright = still.image.max(2)
        self.brightest = np.maximum(self.brightest, bright) if len(self.names) > 1 else bright

    def finished(self, chosen: PickedFrames) -> PickedFrames:
        """Cut off black bars; return the chosen frames with all that is known of them."""
        bars = Bars() if self.cut_out or not self.names else find_bars(self.brightest)
        if any(bars):
            cut_off(self.folder, chosen.files, bars)
        height, width = bars.cut(self.brightest).shape
        turns = self.turns if any(self.turns) else []
        return chosen._replace(size=(width, height), names=self.names, cut_out=self.cut_out, turns=turns, bars=bars)


def frames_of(stored: Any) -> PickedFrames | None:
    """Parse the picked frames from a journal; return None if the entry is malformed."""
    try:
        lists = {"span": tuple(stored["span"]), "size": tuple(stored["size"]), "bars": Bars(*stored.get("bars", ()))}
        frames = PickedFrames(**{**stored, **lists})
        totals = (frames.seen, frames.blurred, frames.alike, frames.decoded, frames.announced)
        counts = (*frames.indices, *frames.size, *totals, *frames.turns, *frames.bars)
        whole = all(isinstance(count, int) and 0 <= count < 2**31 for count in counts)
        numbers = [as_number(second) for second in (*frames.seconds, *frames.span)]
        times = all(number is not None and abs(number) <= MAX_SECONDS for number in numbers)
        names = len(frames.names) in (0, len(frames.indices)) and all(isinstance(name, str) for name in frames.names)
        lengths = len(frames.seconds) == len(frames.indices) and len(frames.span) == len(frames.size) == 2
        lengths = lengths and len(frames.turns) in (0, len(frames.indices)) and isinstance(frames.cut_out, bool)
    except (KeyError, TypeError, AttributeError):
        return None
    return frames if whole and times and names and lengths else None


def choose(request: CaptureRequest, source: Source, show: ShowProgress) -> PickedFrames:
    """Choose the frames to use; for a folder, all of them unless a number is given."""
    start, end = request.start or 0.0, math.inf if request.end is None else request.end
    with show(int(min(source.count, 1 + end * source.rate)), "looking at frames") as bar:
        within = (
            still
            for still in takewhile(lambda still: still.seconds <= end or not source.video, _shown(source, bar))
            if still.seconds >= start or not source.video
        )
        measures = picking.measure(within)
    if not len(measures.index):
        raise UserError(f"--start {start:g}: {source.path} ends before; give a second of the video")
    if source.video or request.frames is not None:
        picked = picking.pick(measures, request.frames or VIDEO_FRAMES)
    else:
        picked = picking.Selection(list(range(len(measures.index))), 0, 0)
    seconds = measures.seconds[picked.places].tolist()
    span = (float(measures.seconds[0]), float(measures.seconds[-1]))
    indices = measures.index[picked.places].tolist()
    there = (0, 0) if source.incomplete is None else source.incomplete[:2]
    return PickedFrames(indices, seconds, [], span, (0, 0), len(measures.index), picked.blurred, picked.alike, *there)


def _shown(source: Source, bar: Any) -> Iterator[SourceFrame]:
    for still in source.frames(picking.SHARPNESS_SIDE):
        yield still
        bar.advance()
