"""Sources of frames: a video decoded by PyAV, or a folder of images. Frames are upright with square pixels."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Container, Iterator
from contextlib import suppress
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from ..data.images import INSPECTED, header_sizes, instead_of_image, is_complete, oversized_claim, size_text
from ..data.name_times import moments_in_names
from ..data.orientation import TURNS, read_orientation, upright
from ..errors import UserError
from ..storage.files import for_ffmpeg, open_regular
from ..storage.heif_files import heif_orientation, heif_size, is_heif, read_heif
from . import cut_out
from .animation import Animation, is_animation
from .as_shown import picture
from .completeness import Incomplete, header_of, incomplete, lost_in_gaps
from .digests import digest, digest_of_ends
from .folder_content import images_in
from .frame_times import REORDERED, rising
from .source_frame import SourceFrame

LONGEST = 1000
"""Largest time that names of images tell, as a multiple of that of images without gaps."""
OPAQUE_SUFFIXES = (".jpg", ".jpeg", ".bmp")
ALPHA_DECODERS = {"vp8": "libvpx", "vp9": "libvpx-vp9"}
"""Decoders of films with alpha in WebM, by the names of ffmpeg's own decoders, which leave out the alpha."""
SAMPLE = 100
"""Number of stored pictures that show whether they have times of display."""


class Source(Protocol):
    """A video or a folder of images."""

    path: Path
    video: bool
    """True for a video, whose frames are consecutive; images of a folder need not be."""
    count: int
    """Number of frames according to the file's header, which may be wrong."""
    rate: float
    """Frames per second according to the header; infinite for a folder, whose images are all at hand."""
    incomplete: Incomplete | None
    """What is there of an incomplete film, once all frames have been read."""

    def frames(self, longest: int, wanted: Container[int] | None = None) -> Iterator[SourceFrame]:
        """Yield all frames in order, or only the ``wanted`` ones by their index; larger frames are reduced so that the
        longer side has ``longest`` pixels.

        Raises:
            UserError: a frame cannot be decoded.
        """
        ...

    def digest(self, earlier: bool = False) -> str:
        """Return a hash that identifies the source; with ``earlier``, the one of earlier versions, which saw both ends
        of large files only."""
        ...


def open_source(path: Path) -> Source:
    """Open the video or the folder of images at ``path``.

    Raises:
        UserError: the path is missing or cannot be read.
    """
    if path.is_dir():
        return Folder(path)
    if not path.is_file():
        raise UserError(f"{path}: no such file or folder; give a video, or a folder of images")
    return Animation(path) if is_animation(path) else Video(path)


class Video:
    """A video file, decoded by ffmpeg's libraries."""

    video = True

    def __init__(self, path: Path) -> None:
        """
        Raises:
            UserError: the file is not a video.
        """
        self.path = path
        self.incomplete: Incomplete | None = None
        with self._opened() as container:
            stream = main_pictures(container)
            rate = rate_of(stream)
            seconds = float(container.duration or 0) / 1e6
            self.count = int(stream.frames) or max(1, round(seconds * rate))
            self.rate = rate
            self._header = header_of(container, stream)
            self._delay = REORDERED if _lacks_times(container, stream) else 0

    def _opened(self) -> Any:
        import av
        from av.error import FFmpegError

        try:
            container = av.open(for_ffmpeg(self.path))
        except (FFmpegError, OSError, ValueError) as error:  # ValueError: metadata that is not text
            raise UserError(f"{self.path}: {_no_video(self.path, error)}") from None
        if not container.streams.video:
            container.close()
            raise UserError(f"{self.path}: holds no pictures; give a video, or a folder of images")
        return container

    def frames(self, longest: int, wanted: Container[int] | None = None) -> Iterator[SourceFrame]:
        """Yield all frames in order, or only the ``wanted`` ones by their index; the others are not converted."""
        self.incomplete, read = None, _Read()
        with self._opened() as container:
            stream = main_pictures(container)
            stream.thread_type = "SLICE"  # Threads of frames lose more or fewer of those before a damaged one.
            shape = float(stream.sample_aspect_ratio or 1)
            size, last, times = None, 0.0, array("d")
            frames = rising(read.frames(container, stream), self.rate, self._delay)
            for index, (frame, seconds) in enumerate(frames):
                if wanted is None or index in wanted:
                    size = size or (frame.width, frame.height)
                    now = frame.width, frame.height
                    if size != now:
                        raise UserError(
                            f"{self.path}: its pictures are {size_text(size)}, but {size_text(now)} from second "
                            f"{seconds:.2f} on; give an --end before {last:.2f}, or save it in one size"
                        )
                    image, alpha = picture(frame, longest, shape)
                    yield SourceFrame(index, seconds, image, "", alpha)
                last = seconds
                times.append(seconds)
        if read.decoded == 0:
            raise UserError(f"{self.path}: no frame can be decoded; save it as .mp4, or give a folder of images")
        self.incomplete = incomplete(
            self._header,
            self.rate,
            decoded=read.decoded,
            hidden=read.hidden,
            seconds=last,
            latest=read.latest,
            lost=lost_in_gaps(times),
        )
        if self.incomplete is not None and self.incomplete.useless:
            raise UserError(f"{self.path}: only {self.incomplete.describe()}")

    def digest(self, earlier: bool = False) -> str:
        return digest_of_ends([self.path]) if earlier else digest([self.path])


def _no_video(path: Path, error: Exception) -> str:
    """Say what is in a file that is no video, and what to do."""
    reason = getattr(error, "strerror", None) or type(error).__name__
    with suppress(OSError), open_regular(path) as file:
        start = file.read(INSPECTED)
        other = instead_of_image(start, "video") if start else "is empty; copy it again from where it was recorded"
        if other is not None:
            return other
    return f"is not a video that decodes ({reason}); save it as .mp4, or give a folder of images"


def main_pictures(container: Any) -> Any:
    """Return the stream of pictures that players show, which a cover or a preview may precede."""
    return container.streams.best("video") or container.streams.video[0]


def rate_of(stream: Any) -> float:
    """Return the frames per second of a video stream; 30 if it is unknown. Raw DV states the rate of its clock."""
    ticks = stream.average_rate is not None and stream.average_rate * stream.time_base == 1
    return float((ticks and stream.guessed_rate) or stream.average_rate or 30)


class _Read:
    """Count of the pictures of a video that have been read."""

    def __init__(self) -> None:
        self.decoded = 0
        self.hidden = 0
        """Number of stored pictures that are not to be shown."""
        self.latest = 0.0
        """Largest time on the file's clock, seconds."""

    def frames(self, container: Any, stream: Any) -> Iterator[tuple[Any, float | None]]:
        """Yield all frames that can be decoded, with their times on the file's clock."""
        from av.error import FFmpegError

        decoder = _decoder(stream)
        for packet in container.demux(stream):
            self.hidden += bool(packet.size and packet.is_discard)
            try:
                decoded = packet.decode() if decoder is None else decoder.decode(packet)
            except FFmpegError:  # Later packets may be intact.
                continue
            for frame in decoded:
                seconds = None if frame.time is None else float(frame.time)
                self.decoded += 1
                self.latest = max(self.latest, seconds or 0.0)
                yield frame, seconds


def _decoder(stream: Any) -> Any:
    """Return the decoder that a film with alpha needs; None if the usual one does."""
    import av

    usual = stream.codec_context
    if usual is None or stream.metadata.get("alpha_mode") != "1":
        return None
    name = ALPHA_DECODERS.get(usual.name)
    if name not in av.codecs_available:
        return None
    decoder: Any = av.CodecContext.create(name, "r")
    decoder.extradata = usual.extradata
    return decoder


def _lacks_times(container: Any, stream: Any) -> bool:
    """Return whether the times of a video are those of decoding, although its order of display is another: they never
    fall, as times of display would. H.264 in .avi is stored so."""
    from av.error import FFmpegError

    if stream.codec_context is None or not stream.codec_context.has_b_frames:  # None: an unknown codec
        return False
    try:
        times = [packet.pts for packet in islice(container.demux(stream), SAMPLE)]
    except FFmpegError:
        return False
    known = [time for time in times if time is not None]
    return known == sorted(known)


class Folder:
    """A folder of images, in the natural order of their names."""

    video = False
    rate = math.inf
    incomplete: Incomplete | None = None

    def __init__(self, path: Path) -> None:
        """
        Raises:
            UserError: the folder holds no images.
        """
        self.path = path
        self.files = images_in(path)
        self.count = len(self.files)
        self.moments = _moments([file.name for file in self.files])

    def frames(self, longest: int, wanted: Container[int] | None = None) -> Iterator[SourceFrame]:
        """Yield all images, or only the ``wanted`` ones by their index. Those of a camera that was held upright for
        some and not for others are turned to have the size of most, so that all have one lens."""
        usual = self._usual
        size, turned = read_rgb(usual).shape[1::-1], turns_of(usual)
        for index, file in enumerate(self.files):
            if wanted is not None and index not in wanted:
                continue
            image, alpha = read_cut_out(file)
            turns = 0
            if image.shape[1::-1] == size[::-1] != size:
                turns = (turned - turns_of(file)) % 4
                turns = turns if turns % 2 else 1
                image, alpha = np.rot90(image, turns), None if alpha is None else np.rot90(alpha, turns)
            if image.shape[1::-1] != size:
                raise UserError(
                    f"{file}: is {size_text(image.shape[1::-1])}, but {usual.name} is {size_text(size)}; "
                    "give images of one camera and one size"
                )
            image, alpha = cut_out.reduced(np.ascontiguousarray(image), alpha, longest)
            yield SourceFrame(index, self.moments[index], image, file.name, alpha, turns)

    @cached_property
    def _usual(self) -> Path:
        """First image of the size, as displayed, that most have."""
        sizes = [(heif_size(file),) if is_heif(file) else tuple(header_sizes(file)[-1:]) for file in self.files]
        return self.files[sizes.index(Counter(sizes).most_common(1)[0][0])]

    def digest(self, earlier: bool = False) -> str:
        if earlier:
            return digest_of_ends(self.files)
        return digest(self.files, [file.name for file in self.files])


def turns_of(file: Path) -> int:
    """Return the number of quarter turns, counter-clockwise, by which viewers turn a photograph."""
    orientation = heif_orientation(file) if is_heif(file) else read_orientation(_bytes_of(file).data)
    return TURNS.get(orientation, (0, False))[0]


def _moments(names: list[str]) -> list[float]:
    """Return the times of images in the order of their names, the usual time between two of them being 1: those in the
    names if these rise without a gap that makes the others one moment, else the index."""
    moments = moments_in_names(names)
    steps = sorted(after - before for before, after in pairwise(moments or []))
    if moments is None or steps[0] <= 0 or sum(steps) > LONGEST * len(names) * steps[len(steps) // 2]:
        return [float(index) for index in range(len(names))]
    return [float((moment - moments[0]) / steps[len(steps) // 2]) for moment in moments]


def read_rgb(file: Path) -> np.ndarray:
    """Read [H, W, 3] uint8 RGB, rotated by its EXIF tags; raise UserError if the file is not an image."""
    if is_heif(file):
        return np.ascontiguousarray(read_heif(file)[..., :3])
    return cv2.cvtColor(read_image(file, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_cut_out(file: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Read an image as ``read_rgb`` does, and its alpha [H, W] uint8, None if all is opaque; what alpha hides is
    black."""
    if is_heif(file):
        pixels = read_heif(file)
        return (pixels, None) if pixels.shape[2] == 3 else cut_out.split(pixels)
    image = read_rgb(file)
    whole = None if file.suffix.lower() in OPAQUE_SUFFIXES else read_image(file, cv2.IMREAD_UNCHANGED)
    if whole is None or whole.ndim != 3 or whole.shape[2] != 4 or whole.dtype.kind != "u":
        return image, None
    alpha = (whole[..., 3] >> (8 * whole.dtype.itemsize - 8)).astype(np.uint8)
    alpha = upright(alpha, read_orientation(_bytes_of(file).data))
    return cut_out.split(np.dstack([image, alpha])) if alpha.shape == image.shape[:2] else (image, None)


def is_hidden(file: Path) -> np.ndarray:
    """Return [H, W] bool, True where the alpha of an image hides it."""
    image, alpha = read_cut_out(file)
    return np.zeros(image.shape[:2], bool) if alpha is None else alpha < cut_out.HIDDEN


def read_image(file: Path, flags: int) -> np.ndarray:
    """Read an image as OpenCV does with these flags; raise UserError if the file is not an image."""
    data = _bytes_of(file)
    claim = oversized_claim(data.data)
    if claim is not None:
        raise UserError(f"{file}: says it is {claim} in {data.size} bytes; save it again, smaller")
    other = instead_of_image(data[:INSPECTED].tobytes())
    if other is not None:
        raise UserError(f"{file}: {other}")
    try:
        image = cv2.imdecode(data, flags) if is_complete(data) else None
    except cv2.error:
        image = None
    if image is None:
        raise UserError(f"{file}: is not an image that decodes; save it again as PNG or JPEG, or take it out")
    return image


def _bytes_of(file: Path) -> np.ndarray:
    try:
        return np.fromfile(file, np.uint8)
    except OSError as error:
        raise UserError(f"{file}: cannot be read ({error.strerror}); make the file readable") from None
