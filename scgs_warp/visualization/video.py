"""Film writers: an .mp4, a .gif or a folder of PNGs, written frame by frame and renamed to its path when complete."""

from __future__ import annotations

import itertools
import os
import struct
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from ..storage.files import for_ffmpeg, new_beside
from ..storage.output_folders import check_replaceable, make_parent, replace_folder
from ..storage.png_files import write_png

SUFFIXES = (".mp4", ".gif", "")
"""Suffixes that ``film`` accepts; an empty one stands for a folder of PNGs."""
QUALITY = 18
"""x264's constant rate factor; 18 is visually almost lossless, and each 6 more halve the file."""
PALETTE_PIXELS = 400_000
"""Number of pixels, spread evenly over the film, from which a GIF's palette is chosen."""
PIXEL_BYTES = 64
"""Bytes per pixel of a frame in progress: colour, coverage and depth in float32, their bytes, the encoder's buffers."""
GIF_PIXEL_BYTES = 4
"""Bytes per pixel of each frame that a GIF keeps: colour and palette index."""
SLOWEST = 0.01
"""Least number of frames a second. A GIF's frame lasts at most 655 seconds, and an MP4's rate is a fraction with a
denominator of at most 1,000."""
MAX_FRAMES = 100_000
"""Largest number of frames that can be asked for: an hour of film, or its cameras, which are all made at first."""
FASTEST_GIF = 50
"""Largest number of frames a second of a GIF: browsers slow down what changes after less than 2 hundredths of one."""
FRAME_NAME = "frame_{:05d}.png"
FRAME_PATTERN = r"frame_\d{5,}\.png"


def check_path(path: str | Path) -> Path:
    """Check before rendering that a film can be written to ``path``.

    Raises:
        UserError: unknown suffix, a suffix without a name, a folder with other files, or one that cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.name.lower() in (".mp4", ".gif"):
        raise UserError(f"{path}: is a suffix without a name; put one before it")
    if suffix not in SUFFIXES:
        raise UserError(f"{path}: cannot write {path.suffix} films; end the name in .mp4 or .gif, or name a folder")
    if suffix and path.is_dir():
        raise UserError(f"{path}: is a folder; give another name for the film")
    if not suffix and path.exists():
        if not path.is_dir():
            raise UserError(f"{path}: is a file; end the name in .mp4 or .gif, or name a folder")
        check_frames(path)
    make_parent(path)
    return path


def check_frames(path: Path) -> Path:
    """Check that the frames of a film may replace a folder, as :func:`check_replaceable`."""
    return check_replaceable(path, FRAME_PATTERN, "a film's frames")


def size_step(path: str | Path) -> int:
    """Return the number of pixels of which the sides of a film should be multiples: H.264 needs even sides."""
    return 2 if Path(path).suffix.lower() == ".mp4" else 1


def frame_gib(size: int) -> float:
    """Return the memory in GiB that a square frame takes while it is rendered and written."""
    return PIXEL_BYTES * size**2 / 2**30


def require_memory(path: str | Path, width: int, height: int, frames: int, device: str) -> None:
    """Check before the first frame that the film fits into memory.

    Raises:
        NotEnoughMemory: with the figures.
    """
    from ..runtime import memory

    need, what = PIXEL_BYTES * width * height, f"{path}: a frame of {width} x {height}"
    memory.require(need, device, what, "give a smaller --size")
    if Path(path).suffix.lower() == ".gif":
        need += GIF_PIXEL_BYTES * width * height * frames
        what = f"{path}: a GIF of {frames} frames of {width} x {height}, all of which it keeps,"
        memory.require(need, "cpu", what, "give a smaller --size or write an .mp4")


@contextmanager
def _disk_errors_as_user_errors(path: Path) -> Iterator[None]:
    """Convert OSError, which includes PyAV's disk errors, to UserError."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"{path}: cannot be written ({reason}); free space or give another path") from None


class FilmWriter:
    """Writer that ``film`` yields; one subclass per format."""

    def __init__(self, path: Path, temporary: Path, fps: float, quality: int) -> None:
        self.path = path
        self.temporary = temporary
        self.fps = fps
        self.quality = quality
        self.frames = 0
        self._shape: tuple[int, ...] | None = None

    def write(self, frame: np.ndarray) -> None:
        """Append one frame.

        Args:
            frame: [H, W, 3] uint8 RGB; all frames have one size.

        Raises:
            ValueError: wrong shape, type or size.
        """
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise ValueError(f"frame must be [H, W, 3] uint8, got {list(frame.shape)} {frame.dtype}")
        if self._shape is not None and frame.shape != self._shape:
            raise ValueError(f"frame must be {list(self._shape)} like the first one, got {list(frame.shape)}")
        with _disk_errors_as_user_errors(self.path):
            if self._shape is None:
                self._shape = frame.shape
                self._open(frame)
            self._write(np.ascontiguousarray(frame))
        self.frames += 1

    def _open(self, frame: np.ndarray) -> None:
        """Open the output for frames of this size."""

    def _write(self, frame: np.ndarray) -> None:
        raise NotImplementedError

    def close(self) -> None:
        """Complete the temporary file."""

    def publish(self) -> None:
        """Rename the complete film to its final name."""
        os.replace(self.temporary, self.path)

    def discard(self) -> None:
        """Leave an incomplete film; safe to call at any time."""


class _Mp4(FilmWriter):
    """H.264, yuv420p, BT.709, which every player and browser supports; encoded as frames arrive."""

    _container: Any = None

    def _open(self, frame: np.ndarray) -> None:
        import av
        from av.video.reformatter import ColorRange, Colorspace

        height, width = frame.shape[:2]
        self._container = av.open(for_ffmpeg(self.temporary), "w", format="mp4", options={"movflags": "+faststart"})
        rate = Fraction(self.fps).limit_denominator(1000)
        # x264's macroblock tree reads uninitialised memory (AVX-512), which changes the bits of some films.
        options = {"crf": str(self.quality), "preset": "medium", "x264-params": "mbtree=0"}
        self._stream: Any = self._container.add_stream("libx264", rate=rate, options=options)
        # 4:2:0 needs even sides, so the last row or column of an odd side is repeated.
        self._padding = ((0, height % 2), (0, width % 2), (0, 0))
        self._stream.width, self._stream.height = width + width % 2, height + height % 2
        self._stream.pix_fmt = "yuv420p"
        # Without the tag in the file, players guess the colour space by size, and colours shift.
        context = self._stream.codec_context
        context.color_range = ColorRange.MPEG
        context.colorspace = context.color_primaries = context.color_trc = Colorspace.ITU709.value
        self._reformat = {
            "format": "yuv420p",
            "dst_colorspace": Colorspace.ITU709,
            "dst_color_range": ColorRange.MPEG,
        }

    def _write(self, frame: np.ndarray) -> None:
        import av

        picture = av.VideoFrame.from_ndarray(np.pad(frame, self._padding, "edge"), format="rgb24")
        picture = picture.reformat(**self._reformat)
        picture.pts = self.frames
        self._container.mux(self._stream.encode(picture))

    def close(self) -> None:
        container, self._container = self._container, None
        if container is not None:
            container.mux(self._stream.encode())
            container.close()

    def discard(self) -> None:
        container, self._container = self._container, None
        if container is not None:
            with suppress(OSError):
                container.close()


class _Gif(FilmWriter):
    """GIF with one palette for the whole film, to avoid flicker; frames are kept in memory until it is chosen."""

    def __init__(self, path: Path, temporary: Path, fps: float, quality: int) -> None:
        super().__init__(path, temporary, fps, quality)
        self._kept: list[np.ndarray] = []

    def _write(self, frame: np.ndarray) -> None:
        self._kept.append(frame.copy())

    def close(self) -> None:
        from PIL import Image

        pixels = np.concatenate([frame.reshape(-1, 3) for frame in self._kept[:: max(1, len(self._kept) // 16)]])
        sample = np.ascontiguousarray(pixels[:: max(1, len(pixels) // PALETTE_PIXELS)])
        palette = Image.fromarray(sample[None]).quantize(256, method=Image.Quantize.MEDIANCUT)
        pictures = [
            Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for frame in self._kept
        ]
        try:
            pictures[0].save(
                self.temporary, format="GIF", save_all=True, append_images=pictures[1:], loop=0,
                duration=gif_durations(len(pictures), self.fps),
            )  # fmt: skip
        except (OverflowError, struct.error):  # The duration of equal frames, which Pillow joins, has 16 bits.
            raise UserError(
                f"{self.path}: stands still for more than 655 s, the longest that a picture of a GIF can last; end the "
                "name in .mp4"
            ) from None


def gif_durations(frames: int, fps: float) -> list[int]:
    """Return how long each frame of a GIF is shown, in milliseconds. A GIF counts hundredths of a second; each frame
    ends at the one that is nearest to its end, so that rounding never adds up."""
    ends = [round(100 * k / fps) for k in range(frames + 1)]
    return [10 * (end - begin) for begin, end in itertools.pairwise(ends)]


class _Folder(FilmWriter):
    """Folder of numbered PNGs; the frames of an earlier film are replaced as a whole."""

    def _write(self, frame: np.ndarray) -> None:
        write_png(self.temporary / FRAME_NAME.format(self.frames), frame)

    def publish(self) -> None:
        check_frames(self.path)
        replace_folder(self.path, self.temporary)


@contextmanager
def film(path: str | Path, fps: float = 30, *, quality: int = QUALITY) -> Iterator[FilmWriter]:
    """Write a film frame by frame; an exception removes the unfinished film and keeps an earlier one.

    Args:
        path: ends in .mp4 (H.264) or .gif; without a suffix, a folder of PNGs. Missing parent folders are made.
        fps: frames per second.
        quality: x264's constant rate factor of an .mp4; 0 is lossless, 51 the worst.

    Yields:
        A writer; pass each frame to its ``write``.

    Raises:
        UserError: as ``check_path``; the disk is full, no frame was written, or ``fps`` is out of range (of a .gif:
            over 50), or a .gif stands still for too long.
        Exception: exceptions of the body of the ``with`` pass unchanged.
    """
    path = check_path(path)
    if not SLOWEST <= fps <= 1000:
        raise UserError(f"fps is {fps}; give {SLOWEST} to 1000 frames a second")
    if path.suffix.lower() == ".gif" and fps > FASTEST_GIF:
        raise UserError(
            f"{path}: a GIF shows at most {FASTEST_GIF} frames a second, and {fps:g} are asked for; give fewer (--fps, "
            "or film.fps in an edit), or end the name in .mp4"
        )
    writers = {".mp4": _Mp4, ".gif": _Gif, "": _Folder}
    kind = writers[path.suffix.lower()]
    with ExitStack() as left:
        with _disk_errors_as_user_errors(path):
            path = check_frames(path) if kind is _Folder else path
            temporary = left.enter_context(new_beside(path, folder=kind is _Folder))
        writer = kind(path, temporary, fps, quality)
        left.callback(writer.discard)
        yield writer
        if writer.frames == 0:
            raise UserError(f"{path}: a film needs at least one frame")
        with _disk_errors_as_user_errors(path):
            writer.close()
            writer.publish()
