"""One time line for all cameras of a rig: instants within the time that all of them recorded, and the frames nearest to
them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import UserError
from ...storage.files import for_ffmpeg
from ..completeness import Incomplete, header_of, incomplete, lost_in_gaps
from ..source import main_pictures, rate_of

SAME_MOMENT = 0.08
"""Difference from an instant, as a share of the time between two frames, that is attributed to the error of the
synchronisation: the frame then belongs to the instant itself."""
MAX_SECONDS, MAX_RATE = 1e9, 1e6
"""Largest plausible length of a film, and largest plausible number of frames per second."""
MIN_INSTANTS = 6
RIG_INSTANTS = 150
"""Number of instants unless the user gives one."""
SAME_RATE = 0.98
"""Ratio of the times between frames, of two cameras, above which these have one rate, as 30 and 29.97 frames a
second."""

FAR_LONGER = 1.25
"""Ratio of the times in common, without and with a camera, above which this camera is worth a note."""
HALF_A_FRAME = 0.75
"""Share of the time between two frames below which stored pictures are the fields of one."""


@dataclass(frozen=True)
class TimeLine:
    """Frames of C cameras at T instants."""

    seconds: np.ndarray
    """[T] instants on the common clock, from 0."""
    frames: np.ndarray
    """[C, T] index of each camera's nearest frame."""
    moments: np.ndarray
    """[C, T] second at which that frame was taken."""

    def times(self, cameras: Sequence[int]) -> np.ndarray:
        """Return the moments [C, T], scaled to go from 0 at the first of the given cameras to 1 at their last."""
        used = self.moments[list(cameras)]
        first, last = float(used.min()), float(used.max())
        return (self.moments - first) / max(last - first, 1e-9)


class _Stored(NamedTuple):
    """A stored picture."""

    stamp: int | None
    key: bool
    corrupt: bool


class Recorded(NamedTuple):
    """What a video's stored pictures say without being decoded."""

    seconds: np.ndarray
    """[V] moments of the frames, counted from the first one."""
    timed: bool
    """False if the moments are those of an even rate, because the file does not say them."""
    incomplete: Incomplete | None
    """What is there of an incomplete video."""


def recorded(path: Path) -> Recorded:
    """Read the moments of a video's frames; only the first pictures are decoded, unless fields are stored one by one.

    Raises:
        UserError: the file is no video.
    """
    import av
    from av.error import FFmpegError

    try:
        with av.open(for_ffmpeg(path)) as container:
            if not container.streams.video:
                raise UserError(f"{path}: holds no pictures; take it out of the folder")
            stream = main_pictures(container)
            rate = rate_of(stream)
            header, hidden, packets = header_of(container, stream), 0, []
            for packet in container.demux(stream):
                if packet.size and packet.is_discard:
                    hidden += 1
                elif packet.size:
                    packets.append(_Stored(packet.pts, packet.is_keyframe, packet.is_corrupt))
            unit = float(stream.time_base)
    except (FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or type(error).__name__
        raise UserError(f"{path}: is not a video that decodes ({reason}); save it as .mp4, or take it out") from None
    if packets and packets[-1].corrupt:  # as the last one of a copy that was cut off
        packets.pop()
    stamps = [packet.stamp for packet in packets]
    if stamps and not packets[0].key:  # nothing is shown before the first key frame
        begin = next((frame.pts for frame in _shown(path)), None)
        stamps = [stamp for stamp in stamps if begin is None or stamp is None or stamp >= begin]
    stamps = _of_frames(path, stamps)
    known = sorted(stamp for stamp in stamps if stamp is not None)
    if not stamps or not 0.0 < rate < MAX_RATE:
        raise UserError(f"{path}: holds no frame that can be timed; save it as .mp4, or take it out")
    if 2 * len(known) < len(stamps):
        return Recorded(np.arange(len(stamps)) / rate, False, None)
    known = _filled(stamps, round(1.0 / (rate * unit)))
    seconds = (np.array(known, np.float64) - known[0]) * unit
    if not np.isfinite(seconds).all() or seconds[-1] > MAX_SECONDS:
        raise UserError(f"{path}: its frames are {seconds[-1]:g} seconds apart; save it as .mp4, or take it out")
    length, latest = float(seconds[-1]), float(known[-1] * unit)
    lost = lost_in_gaps(seconds)
    there = incomplete(header, rate, decoded=len(stamps), hidden=hidden, seconds=length, latest=latest, lost=lost)
    return Recorded(seconds, True, there)


def _shown(path: Path) -> Iterator[Any]:
    """Yield the frames that a video shows, as far as they can be decoded."""
    import av
    from av.error import FFmpegError

    with av.open(for_ffmpeg(path)) as container:
        stream = main_pictures(container)
        stream.thread_type = "SLICE"  # as the frames are decoded later
        for packet in container.demux(stream):
            with suppress(FFmpegError):  # later packets may be intact
                yield from packet.decode()


def _of_frames(path: Path, stamps: Sequence[int | None]) -> list[int | None]:
    """Return the time stamps of the frames, given those of the stored pictures. These are the same, unless a film is
    interlaced and some of its fields are stored one by one, as many camcorders do: only decoding then tells which."""
    known = sorted(stamp for stamp in stamps if stamp is not None)
    first = [frame for frame in islice(_shown(path), 3) if frame.pts is not None]
    interval = min((after.pts - before.pts for before, after in pairwise(first)), default=0)
    even = all(after - before > HALF_A_FRAME * interval for before, after in pairwise(known))
    if not any(frame.interlaced_frame for frame in first) or (even and len(known) == len(stamps)):
        return list(stamps)
    return [frame.pts for frame in _shown(path)]


def _filled(stamps: Sequence[int | None], step: int) -> list[int]:
    """Return the time stamps in ascending order; those that are unknown follow the one before by a step."""
    filled: list[int] = []
    for stamp in stamps:
        known = next(each for each in stamps if each is not None) if not filled else filled[-1] + step
        filled.append(known if stamp is None else stamp)
    return sorted(filled)


def time_line(
    names: Sequence[str],
    starts: Sequence[float],
    own: Sequence[np.ndarray],
    count: int | None,
    begin: float | None = None,
    end: float | None = None,
) -> TimeLine:
    """Choose instants and frames.

    Instants are moments of frames of the first camera, evenly spread, or of the slowest one: slower cameras than that
    would have one frame for several instants.

    Args:
        names: names of the cameras, for the message.
        starts: seconds at which the cameras begin.
        own: moments of each camera's frames, counted from its first frame.
        count: number of instants; None: ``RIG_INSTANTS``, or all frames if there are fewer.
        begin, end: part of the common time to use, counted from the moment at which all cameras record.

    Raises:
        UserError: the cameras have too little time in common.
    """
    moments = [start + seconds for start, seconds in zip(starts, own)]
    first, last = max(own[0] for own in moments), min(own[-1] for own in moments)
    if first >= last:
        late, early = (int(np.argmax([m[0] for m in moments])), int(np.argmin([m[-1] for m in moments])))
        raise UserError(
            f"{names[late]} begins when {names[early]} has ended; take one of them out, or correct --offsets"
        )
    low = first + (begin or 0.0)
    high = last if end is None else min(last, first + end)
    intervals = np.array([float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0 for seconds in own])
    slowest = int((intervals >= SAME_RATE * intervals.max()).argmax())
    slack = SAME_MOMENT * intervals[slowest]
    reference = moments[slowest][(moments[slowest] >= low - slack) & (moments[slowest] <= high + slack)]
    if len(reference) < MIN_INSTANTS:
        raise UserError(
            f"the cameras have {len(reference)} frames in common ({max(high - low, 0.0):.2f} s); give longer videos, "
            "or correct --offsets, --start and --end"
        )
    wanted = min(count or RIG_INSTANTS, len(reference))
    chosen = reference[np.round(np.linspace(0, len(reference) - 1, wanted)).astype(int)]
    interval = float(np.median(np.diff(reference)))
    frames = np.stack([_nearest(own, chosen) for own in moments])
    taken = np.stack([own[index] for own, index in zip(moments, frames)])
    taken = np.where(np.abs(taken - chosen) <= SAME_MOMENT * interval, chosen, taken)
    return TimeLine(chosen - chosen[0], frames, taken - chosen[0])


def shortened_by(names: Sequence[str], starts: Sequence[float], own: Sequence[np.ndarray]) -> list[str]:
    """Name the camera without which the others have far more time in common: it was stopped early, or begun late.

    Args:
        names, starts, own: as for :func:`time_line`.
    """
    first, last = (np.array([start + seconds[end] for start, seconds in zip(starts, own)]) for end in (0, -1))
    common = float(last.min() - first.max())
    without = [float(np.delete(last, k).min() - np.delete(first, k).max()) for k in range(len(names))]
    worst = int(np.argmax(without))
    if len(names) < 3 or without[worst] < FAR_LONGER * common:
        return []
    return [
        f"note: {names[worst]} limits the time in common to {common:.2f} s; without its video, it is "
        f"{without[worst]:.2f} s"
    ]


def _nearest(moments: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the index [T] of the moment nearest to each wanted one."""
    after = np.searchsorted(moments, wanted).clip(0, len(moments) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(moments[before] - wanted) <= np.abs(moments[after] - wanted), before, after)
