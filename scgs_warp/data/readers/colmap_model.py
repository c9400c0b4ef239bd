"""COLMAP's sparse models, binary and text: cameras, poses of images and points, without observations.

The files are parsed here rather than by pycolmap, which keeps every observation in memory, requires rigs and frames
that agree with the images, and hangs on some truncated files. Every count is checked against the file's length first.
Format: https://colmap.github.io/format.html
"""

from __future__ import annotations

import functools
import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import UserError
from ...runtime.pycolmap_import import import_pycolmap
from ...storage.files import open_regular

MAX_NAME_BYTES = 4096


class ModelCamera(NamedTuple):
    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ModelImage(NamedTuple):
    name: str
    camera: int
    viewmat: np.ndarray
    """[4, 4] world-to-camera, OpenCV."""


class SparseModel(NamedTuple):
    cameras: dict[int, ModelCamera]
    images: list[ModelImage]
    points: np.ndarray
    """[P, 3] float64"""
    colors: np.ndarray
    """[P, 3] in [0, 1]"""


class _Damaged(Exception):
    """Error about a damaged file; the message describes the damage in a few words."""


def find_model(folder: Path) -> Path | None:
    """Find the folder of the model; if there are several models, that with the largest file of images. Return None
    without a model."""
    places = [folder, *(folder / name for name in ("sparse", "colmap/sparse", "colmap_sparse", "colmap"))]
    candidates = []
    for path in places:
        if path.is_dir():
            inner = sorted(p for p in path.iterdir() if p.is_dir() and p.name.isdigit()) if path != folder else []
            candidates += [path, *inner]
    sizes = {path: max((file.stat().st_size for file in _files(path, "images")), default=-1) for path in candidates}
    complete = [path for path in candidates if sizes[path] >= 0 and _files(path, "cameras")]
    return max(complete, key=lambda path: sizes[path], default=None)


def _files(folder: Path, name: str) -> list[Path]:
    return [folder / f"{name}{suffix}" for suffix in (".bin", ".txt") if (folder / f"{name}{suffix}").is_file()]


def read_model(folder: Path) -> SparseModel:
    """Read cameras, images and points of the model in ``folder``, binary if present, else text.

    Raises:
        UserError: a file is missing or damaged.
    """
    suffix = ".bin" if _files(folder, "cameras")[0].suffix == ".bin" and (folder / "images.bin").is_file() else ".txt"
    readers = _BINARY if suffix == ".bin" else _TEXT
    cameras = _read(folder / f"cameras{suffix}", readers[0])
    images = _read(folder / f"images{suffix}", readers[1])
    file = folder / f"points3D{suffix}"
    points, colors = _read(file, readers[2]) if file.is_file() else (np.zeros((0, 3)), np.zeros((0, 3)))
    if not images:
        raise UserError(f"{folder / f'images{suffix}'}: no image is registered; run COLMAP's mapper on better images")
    for image in images:
        if image.camera not in cameras:
            raise UserError(
                f"{folder / f'images{suffix}'}: {image.name} is of camera {image.camera}, which cameras{suffix} does "
                "not have; export the model again"
            )
    return SparseModel(cameras, images, points, colors)


def _read(file: Path, reader: Callable[[bytes], Any]) -> Any:
    try:
        with open_regular(file) as opened:
            content = opened.read()
        return reader(content)
    except FileNotFoundError:
        raise UserError(f"{file}: no such file, though the rest of the model is here; export the model again") from None
    except OSError as error:
        raise UserError(f"{file}: cannot be read ({error.strerror}); make the file readable") from None
    except _Damaged as error:
        raise UserError(f"{file}: {error}; export the model again") from None
    except (struct.error, ValueError, IndexError, OverflowError):
        raise UserError(f"{file}: truncated or damaged; export the model again") from None


def _pose(quaternion: np.ndarray, translation: np.ndarray, name: str) -> np.ndarray:
    """Return the world-to-camera matrix [4, 4] of a wxyz quaternion and a translation."""
    with np.errstate(over="ignore"):  # An infinite length is refused below.
        length = float(np.linalg.norm(quaternion))
    if not (np.isfinite(translation).all() and 0.99 < length < 1.01):  # False for NaN
        raise _Damaged(f"the pose of {name[:60]!r} is not a unit quaternion and a finite translation")
    w, x, y, z = quaternion / length
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = translation
    return viewmat


def _model_names() -> dict[int, str]:
    members = import_pycolmap().CameraModelId.__members__
    return {int(value): name for name, value in members.items() if name != "INVALID"}


@functools.cache
def _parameter_count(model: str) -> int:
    return len(import_pycolmap().Camera(model=model, width=1, height=1).params_info.split(","))


def _binary_cameras(data: bytes) -> dict[int, ModelCamera]:
    names, cameras = _model_names(), {}
    (count,), offset = struct.unpack_from("<Q", data), 8
    for _ in range(_plausible_count(count, len(data) - offset, 24)):
        identity, model, width, height = struct.unpack_from("<iiQQ", data, offset)
        if model not in names:
            raise _Damaged(f"camera {identity} is of model {model}, which is not known")
        params = struct.unpack_from(f"<{_parameter_count(names[model])}d", data, offset + 24)
        offset += 24 + 8 * len(params)
        cameras[identity] = ModelCamera(names[model], width, height, params)
    return cameras


def _binary_images(data: bytes) -> list[ModelImage]:
    images = []
    (count,), offset = struct.unpack_from("<Q", data), 8
    for _ in range(_plausible_count(count, len(data) - offset, 73)):
        values = struct.unpack_from("<i7di", data, offset)
        offset += 64
        end = data.index(b"\0", offset, offset + MAX_NAME_BYTES)
        name = data[offset:end].decode("utf-8")
        (observations,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + 24 * _plausible_count(observations, len(data) - end - 9, 24)
        images.append(ModelImage(name, values[8], _pose(np.array(values[1:5]), np.array(values[5:8]), name)))
    return images


def _binary_points(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    (count,), offset = struct.unpack_from("<Q", data), 8
    count = _plausible_count(count, len(data) - offset, 51)
    points, colors = np.empty((count, 3)), np.empty((count, 3))
    unpack = struct.Struct("<Q3d3BdQ").unpack_from
    for index in range(count):
        values = unpack(data, offset)
        points[index], colors[index] = values[1:4], values[4:7]
        offset += 51 + 8 * _plausible_count(values[8], len(data) - offset - 51, 8)
    return points, colors / 255.0


def _plausible_count(count: int, left: int, least: int) -> int:
    """Return ``count`` if ``left`` bytes suffice for that many entries of at least ``least`` bytes; raise otherwise."""
    if count * least > left:
        raise _Damaged(f"truncated or damaged: lists {count} entries, more than the file holds")
    return count


def _lines(data: bytes) -> Iterator[str]:
    return (line for line in data.decode("utf-8-sig").removesuffix("\n").split("\n") if not line.startswith("#"))


def _text_cameras(data: bytes) -> dict[int, ModelCamera]:
    cameras, names = {}, set(_model_names().values())
    for words in (line.split() for line in _lines(data) if line.strip()):
        if len(words) < 4 or words[1] not in names:
            raise _Damaged(f"camera {words[0][:20]!r} is of no model that is known")
        params = tuple(float(word) for word in words[4:])
        if len(params) != _parameter_count(words[1]):
            raise _Damaged(f"camera {words[0][:20]!r} has {len(params)} parameters, but {words[1]} another number")
        cameras[int(words[0])] = ModelCamera(words[1], int(words[2]), int(words[3]), params)
    return cameras


def _text_images(data: bytes) -> list[ModelImage]:
    """Parse lines of images. Each is followed by its observations, a line that may be empty; editors and scripts that
    drop empty lines leave no such lines."""
    images, whole, observed = [], True, False
    lines = list(_lines(data))
    for number, line in enumerate(lines):
        if observed or not line.strip():
            observed = False
            continue
        words = line.split(maxsplit=9)
        values = np.array([float(word) for word in words[1:8]])
        images.append(ModelImage(words[9].strip(), int(words[8]), _pose(values[:4], values[4:], words[9])))
        follows = lines[number + 1] if number + 1 < len(lines) else None
        observed = follows is not None and not _names_image(follows)
        if follows is None and whole:
            raise _Damaged(f"truncated after {words[9][:60]!r}: its line of observations is missing")
        whole = whole and observed
    return images


def _names_image(line: str) -> bool:
    """Return whether a line ends with a name. Observations end with the number of a point."""
    words = line.split()
    return len(words) >= 10 and re.fullmatch(r"-?[0-9]+", words[-1]) is None


def _text_points(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    rows = [[float(word) for word in line.split(maxsplit=8)[1:7]] for line in _lines(data) if line.strip()]
    table = np.array(rows, np.float64).reshape(len(rows), 6)
    colors = table[:, 3:] / 255.0
    return table[:, :3], np.where(np.isfinite(colors), colors, 0.5).clip(0.0, 1.0)


_BINARY: tuple[Callable[[bytes], Any], ...] = (_binary_cameras, _binary_images, _binary_points)
_TEXT: tuple[Callable[[bytes], Any], ...] = (_text_cameras, _text_images, _text_points)
