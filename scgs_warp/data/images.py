"""Image files to planar float tensors: decoding, undistortion, reduction and compositing, in a pool of threads."""

from __future__ import annotations

import io
import re
import struct
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from numbers import Real
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
import torch

from ..config.fields import BACKGROUND_COLORS
from ..errors import UserError
from ..runtime import addresses, environment
from ..storage.files import open_regular
from ..storage.safe_paths import is_regular
from .borders import reduce_mask
from .cache import ImageCache, Pixels
from .lens import Lens, undistort, valid_pixels
from .mask_files import by_alpha, cut_out, marked
from .orientation import TAG, UPRIGHT, read_orientation, swaps_sides, upright

RESAMPLES = ("area", "bicubic")
SMALLEST_SIDE = 8
"""Smallest side in pixels after a reduction: the window of SSIM would not fit into a smaller image."""

TRUSTED_PIXELS, MAX_PIXELS_PER_BYTE = 2**25, 64
"""Limits on the size that a file's header may announce. Up to ``TRUSTED_PIXELS`` any size is trusted, beyond it at most
``MAX_PIXELS_PER_BYTE`` for each byte of the file: a megabyte of zeros may decompress to a gigabyte."""

JPEG_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]", re.DOTALL)
"""A marker of JPEG; within the data of a scan, neither a byte that is escaped nor a restart."""
JPEG_ALONE, JPEG_END = (0x01, 0xD8), 0xD9
"""Markers that no segment follows, and the one at the end."""

OPAQUE, CUT_OUT = 0.98, 1e-3
"""Alpha from which a pixel is opaque, and the share of other pixels above which a file is cut out. Programs that resize
images leave single pixels of alpha 254."""

LEAST_REDUCTION, MAX_ASPECT_ERROR = 1.5, 0.01
"""How many times smaller reduced images are at least, and the largest relative error of their proportions."""

INSPECTED = 1024
"""Number of bytes by which a file that is no image is recognised."""

# Only the orientation is read from EXIF data, so the warning would only clutter the terminal.
warnings.filterwarnings("ignore", "Corrupt EXIF data", UserWarning)

T = TypeVar("T")
R = TypeVar("R")


def size_text(size: Sequence[float]) -> str:
    """Format (width, height) as ``800 x 600 pixels``."""
    return f"{size[0]} x {size[1]} pixels"


def is_reduced(size: tuple[int, int], full: tuple[int, int]) -> bool:
    """Return whether an image of this size is a reduced one of the full size: the proportions are kept up to the
    rounding to whole pixels."""
    tolerance = max(1.0, MAX_ASPECT_ERROR * size[1])
    return size[0] * LEAST_REDUCTION <= full[0] and abs(size[1] - size[0] * full[1] / full[0]) <= tolerance


class Decoded(NamedTuple):
    pixels: Pixels
    """Composited pixels; ``alpha`` is None for a file without alpha, and ``mask`` is None if every pixel is valid."""
    source_size: tuple[int, int]
    """(width, height) of the file before the reduction."""
    transparent: bool
    """True if the file is cut out by alpha."""
    lens: Lens
    """Lens of the file."""


class ReadOptions(NamedTuple):
    """Options of reading a data set."""

    downscale: float = 1
    resample: str = "area"
    background: str = "black"
    progress: Callable[[int, int], None] | None = None
    """Called with (done, total) after each image."""
    cache: ImageCache | None = None
    """Cache of decoded images; None: a new one."""
    frames: str = ""
    """Instants to read, as ``A:B:C``; empty: all."""
    only_cameras: str = ""
    """Names of cameras to read, separated by commas; empty: all."""
    min_frames: int = 0
    """Smallest number of frames whose images exist; 0: half of them."""


def parallel_map(work: Callable[[T], R], items: Sequence[T], progress: Callable[[int, int], None] | None = None):
    """Apply ``work`` to every item, in order, in as many threads as the process may use; raise the first exception.

    Where addresses leave no room for threads, this one does it all.

    Args:
        progress: called with (done, total) after each item.
    """
    threads = environment.thread_count()
    results: list[R] = []
    with ExitStack() as stack:
        if addresses.fits(threads * addresses.THREAD):
            pool = stack.enter_context(ThreadPoolExecutor(threads, "decode"))
            stack.callback(pool.shutdown, cancel_futures=True)
            found = pool.map(work, items)
        else:
            found = map(work, items)
        for result in found:
            results.append(result)
            if progress is not None:
                progress(len(results), len(items))
    return results


def check_options(downscale: float, resample: str, background: str) -> None:
    """Raise UserError for an invalid option."""
    if not (isinstance(downscale, Real) and 1 <= downscale < float("inf")):
        raise UserError(f"downscale is {downscale!r:.80}; give a number >= 1 (2 halves width and height)")
    if not isinstance(resample, str) or resample not in RESAMPLES:
        raise UserError(f"resample is {resample!r:.80}; give one of {', '.join(RESAMPLES)}")
    if not isinstance(background, str) or background not in BACKGROUND_COLORS:
        raise UserError(f"background is {background!r:.80}; give one of {', '.join(BACKGROUND_COLORS)}")


def reduced_size(width: int, height: int, downscale: float, path: Path) -> tuple[int, int]:
    """Return (width, height) after ``downscale``, rounded; raise UserError if a side becomes too small."""
    size = (max(1, round(width / downscale)), max(1, round(height / downscale)))
    if downscale != 1 and min(size) < SMALLEST_SIDE:
        largest = max(1, min(width, height) // SMALLEST_SIDE)
        raise UserError(
            f"{path}: downscale {downscale:g} leaves {size[0]} x {size[1]} of {width} x {height} pixels; "
            f"give a downscale of at most {largest}"
        )
    return size


def read_image(
    path: Path,
    options: ReadOptions,
    lens_of: Callable[[tuple[int, int]], Lens],
    mask_path: Path | None = None,
    states_size: bool = True,
    masked_by_alpha: bool = False,
    mask_excludes: bool = False,
    cut_out_by: Path | None = None,
) -> Decoded:
    """Decode one file, undistort it, reduce it, and composite it on the background once.

    ``area`` averages colour premultiplied by alpha over each target pixel, in float. ``bicubic`` follows the official
    SC-GS: composite, truncate to 8 bits, then apply Pillow's bicubic filter to colour and alpha separately.
    With ``random`` the image stays premultiplied, on black.

    Args:
        lens_of: function from the (width, height) of the file to the lens; raises UserError if the size does not fit.
        mask_path: an image that is black where the frame is not valid, and not black everywhere.
        states_size: whether the camera states the size of its images.
        masked_by_alpha: whether pixels that are not opaque are not valid, instead of transparent.
        mask_excludes: whether the mask is black where the frame is valid instead.
        cut_out_by: an image whose brightness is the alpha of the file.

    Raises:
        UserError: a file is missing or does not decode, or the mask has another size than the image.
    """
    pixels, lens = _as_the_camera_sees(path, lens_of, states_size)
    if cut_out_by is not None:
        pixels = cut_out(path, pixels, cut_out_by, decode(cut_out_by))
    height, width = pixels.shape[:2]
    size = reduced_size(width, height, options.downscale, path)
    mask = None if mask_path is None else read_mask(mask_path, path, (width, height), mask_excludes)
    if masked_by_alpha:
        pixels, mask = by_alpha(pixels, mask, OPAQUE)
    if lens.distorted:
        moved = valid_pixels(lens, width, height)
        mask = moved if mask is None else moved & (undistort(mask.astype(np.float32), lens) > 1.0 - 1e-4)
    color = np.asarray(BACKGROUND_COLORS[options.background], np.float32)
    if options.resample == "bicubic" and size != (width, height):
        rgb, alpha = _bicubic(undistort(pixels, lens) if lens.distorted else pixels, size, color)
    else:
        rgb, alpha = _area(pixels, size, color, lens if lens.distorted else None)
    planar = torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1)))
    alpha_tensor = None if alpha is None else torch.from_numpy(np.ascontiguousarray(alpha))
    mask_tensor = None if mask is None else torch.from_numpy(reduce_mask(mask, size))
    reduced = Pixels(planar.permute(1, 2, 0), alpha_tensor, mask_tensor)
    return Decoded(reduced, (width, height), is_transparent(pixels), lens)


def _as_the_camera_sees(
    path: Path, lens_of: Callable[[tuple[int, int]], Lens], states_size: bool
) -> tuple[np.ndarray, Lens]:
    """Decode a file and find its lens.

    A photograph with an EXIF orientation is turned if only the turned image has the size of its camera, or if the
    camera states no size. If both sizes fit, its pixels stay as they are stored, as for COLMAP and nerfstudio.
    """
    data = _read(path)
    pixels = _decoded(path, data)
    stored = (pixels.shape[1], pixels.shape[0])
    orientation = read_orientation(data.data)
    if orientation == UPRIGHT:
        return pixels, lens_of(stored)
    if not states_size:
        turned = upright(pixels, orientation)
        return turned, lens_of((turned.shape[1], turned.shape[0]))
    try:
        return pixels, lens_of(stored)
    except UserError:
        if not swaps_sides(orientation):
            raise
        try:
            lens = lens_of(stored[::-1])
        except UserError:
            lens = None
        if lens is None:  # the stored size is the one that the user knows
            raise
        return upright(pixels, orientation), lens


def read_mask(path: Path, image: Path, size: tuple[int, int], excludes: bool = False) -> np.ndarray:
    """Read a mask: [H, W] bool, True where it is not black or, if it ``excludes``, where it is black. ``size``: (width,
    height) of its image.

    Raises:
        UserError: the file is missing or does not decode, leaves no pixel, has another size, or may mean either.
    """
    mask = marked(path, decode(path))
    if excludes:
        mask = ~mask
    if not mask.any():
        raise UserError(
            f"{path}: the mask is all {'white' if excludes else 'black'}, so no pixel is valid; drop the frame"
        )
    if mask.shape[::-1] != size:
        raise UserError(
            f"{image}: is {size_text(size)}, but its mask is {size_text(mask.shape[::-1])}; "
            "give the mask the image's size"
        )
    return mask


def is_transparent(pixels: np.ndarray) -> bool:
    """Return whether a file [H, W, 3 or 4] is cut out by alpha."""
    if pixels.shape[2] == 3:
        return False
    return float((pixels[..., 3] < OPAQUE * np.iinfo(pixels.dtype).max).mean()) > CUT_OUT


def decode(path: Path) -> np.ndarray:
    """Decode a file to RGB(A) [H, W, 3 or 4], uint8 or uint16, as it is stored; raise UserError if it is missing or not
    an image."""
    return _decoded(path, _read(path))


def _read(path: Path) -> np.ndarray:
    """Read the bytes of an image file; raise UserError if it is missing or claims to be too large."""
    try:
        if not is_regular(path):
            raise UserError(f"{path}: is not a regular file; give an image, or drop the frame")
        data = np.fromfile(path, np.uint8)
    except FileNotFoundError:
        raise UserError(f"{path}: no such image, though a frame names it; restore the file or drop the frame") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); make the file readable") from None
    claim = oversized_claim(data.data)
    if claim is not None:
        raise UserError(f"{path}: says it is {claim} in {data.size} bytes; save it again, smaller")
    return data


def _decoded(path: Path, data: np.ndarray) -> np.ndarray:
    other = instead_of_image(data[:INSPECTED].tobytes())
    if other is not None:
        raise UserError(f"{path}: {other}")
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if is_complete(data) else None
    except cv2.error:
        pixels = None
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise UserError(f"{path}: not an image that decodes to 8 or 16 bits; save it again as PNG or JPEG")
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    code = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}.get(channels)
    if code is None:
        raise UserError(f"{path}: has {channels} channels; save it as grey, RGB or RGBA")
    return cv2.cvtColor(pixels, code)


def instead_of_image(start: bytes, what: str = "image") -> str | None:
    """Say what came in place of an image, or of something else, by the file's first bytes; None for other files."""
    if start.startswith(b"version https://git-lfs.github.com"):
        return f"is a pointer of Git LFS, not the {what}; run 'git lfs pull' in its repository"
    if any(mark in start.lower() for mark in (b"<!doctype html", b"<html")):
        return f"is a web page, not the {what}; download the {what} itself"
    return None


def oversized_claim(data: bytes | memoryview) -> str | None:
    """Return the size announced by an image file if the file has too few bytes for it, else None."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "WEBP", "TIFF", "BMP")) as image:
            size = image.size
    except Image.DecompressionBombError:
        return "hundreds of megapixels"
    except (OSError, ValueError, SyntaxError, TypeError, struct.error):
        return None  # The decoder reports the damage.
    count = size[0] * size[1]
    return size_text(size) if count > TRUSTED_PIXELS and count > MAX_PIXELS_PER_BYTE * len(data) else None


def is_complete(data: np.ndarray) -> bool:
    """Return whether a JPEG or PNG, given as bytes, is complete.

    Truncation must be detected here: older versions of OpenCV fill the missing part of a JPEG with grey, and all
    versions allocate as many bytes as a PNG announces.
    """
    content = data.tobytes()
    if content.startswith(b"\xff\xd8"):
        return _jpeg_ends(content)
    if content.startswith(b"\x89PNG\r\n\x1a\n"):
        at = 8
        while at + 8 <= len(content):
            if content[at + 4 : at + 8] == b"IEND":
                return True
            at += 12 + int.from_bytes(content[at : at + 4], "big")
        return False
    return len(content) > 0


def _jpeg_ends(content: bytes) -> bool:
    """Return whether a JPEG's end marker is reached from its beginning; what follows it, such as the film of a motion
    photo, does not count."""
    at = 2
    while (found := JPEG_MARKER.search(content, at)) is not None:
        kind, at = found[0][1], found.end()
        if kind == JPEG_END:
            return True
        if kind not in JPEG_ALONE:
            at += int.from_bytes(content[at : at + 2], "big")
    return False


def header_sizes(path: Path) -> list[tuple[int, int]]:
    """Return (width, height) from the file's header, and that of the turned image if its EXIF orientation swaps the
    sides; an empty list if the file is missing or its header is unreadable."""
    from PIL import Image

    try:
        with open_regular(path) as file, Image.open(file) as image:
            turned = image.format in ("JPEG", "WEBP") and swaps_sides(image.getexif().get(TAG, UPRIGHT))
            return [image.size, image.size[::-1]] if turned else [image.size]
    except (OSError, ValueError, SyntaxError, TypeError, KeyError, struct.error, Image.DecompressionBombError):
        return []


def _area(
    pixels: np.ndarray, size: tuple[int, int], color: np.ndarray, lens: Lens | None
) -> tuple[np.ndarray, np.ndarray | None]:
    floats = pixels.astype(np.float32) * np.float32(1.0 / np.iinfo(pixels.dtype).max)
    if floats.shape[2] == 4:
        floats[..., :3] *= floats[..., 3:]
    if lens is not None:
        floats = undistort(floats, lens)
    if size != (floats.shape[1], floats.shape[0]):
        floats = cv2.resize(floats, size, interpolation=cv2.INTER_AREA)
    if floats.shape[2] == 3:
        return floats, None
    alpha = floats[..., 3].clip(0.0, 1.0)
    rgb = floats[..., :3]
    if color.any():
        rgb = rgb + (1.0 - alpha[..., None]) * color
    return rgb.clip(0.0, 1.0), alpha


def _bicubic(pixels: np.ndarray, size: tuple[int, int], color: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    from PIL import Image

    def reduce(array: np.ndarray) -> np.ndarray:
        reduced = Image.fromarray(array).resize(size, Image.Resampling.BICUBIC)
        return np.asarray(reduced, np.float32) / np.float32(255.0)

    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    if pixels.shape[2] == 3:
        return reduce(np.ascontiguousarray(pixels)), None
    floats = pixels.astype(np.float64) / 255.0
    composited = floats[..., :3] * floats[..., 3:] + color * (1.0 - floats[..., 3:])
    rgb = reduce((composited * 255.0).astype(np.uint8))
    return rgb, reduce(np.ascontiguousarray(pixels[..., 3]))
