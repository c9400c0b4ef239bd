"""Fields shared by the ``transforms*.json`` layouts: poses, times, intrinsics and lenses.

Poses are camera-to-world, OpenGL (x right, y up, z backward), as NeRF's Blender scenes and nerfstudio write them.
"""

from __future__ import annotations

import math
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from ...errors import UserError
from ...geometry.rotation import OPENGL_TO_OPENCV, RIGID_TOLERANCE, is_rotation
from ...storage.json_files import as_number, numbers, read_json
from ...storage.safe_paths import inside
from ..images import header_sizes, is_reduced, size_text
from ..lens import BROWN4, Lens, make_lens, rescaled
from ..natural_order import by_name

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
LISTED_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Names of the parameters in ``distortion_params``, in nerfstudio's order."""
PERSPECTIVES = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Camera models (names of COLMAP and nerfstudio) that are a pinhole if all distortion is 0. The distortion is radial
and tangential; for FULL_OPENCV the radial part is a quotient of polynomials."""
FISHEYES = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
"""Camera models in which the distance from the centre is a polynomial of the angle to the optical axis."""
PRISM, PRISM_COUNT = "FISHEYE624", 12
"""nerfstudio's name of the lens of Project Aria, and the number of its parameters in ``distortion_params``: those of
COLMAP's RAD_TAN_THIN_PRISM_FISHEYE."""
STEP, STAMP = "timestep_index", "timestamp"
"""Fields of a frame that tell its time: the number of the instant, which the cameras of NeRSemble's heads share, and
the clock of NeRFCapture."""
MOST_SCALE = 1e6
"""Largest scale of a camera that is left out, and the inverse of the smallest one."""
CORNER = 0.95
"""Shares of width and height beyond which a principal point is that of larger images."""


def read_transforms(path: Path) -> dict[str, Any]:
    """Read the JSON object in ``path``; raise UserError if it lists no frame."""
    content = read_json(path, "this split needs it, or choose another split")
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{path}: 'frames' is missing, empty or not a list; list at least one frame there")
    for index, entry in enumerate(frames):
        if not isinstance(entry, dict):
            raise UserError(f"{path}: frames[{index}] is not an object; give file_path and transform_matrix")
    given = {**content, "frames": _timed([_given(entry) for entry in frames])}
    return _given(given)


def _given(fields: dict[str, Any]) -> dict[str, Any]:
    """Leave out fields without a value, which exporters write as null."""
    return {key: value for key, value in fields.items() if value is not None}


def _timed(frames: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return frames that have no ``time`` with that of another field, if all have it. The clocks of several cameras,
    whose images are in several folders, are not compared."""
    names = [frame.get("file_path") for frame in frames]
    folders = {PurePosixPath(name.replace("\\", "/")).parent for name in names if isinstance(name, str)}
    for key in (STEP, STAMP) if len(folders) == 1 else (STEP,):
        values = [as_number(frame.get(key)) for frame in frames]
        telling = key == STEP or len(set(values)) > 1 or len(values) == 1
        if telling and None not in values and all(frame.get("time") is None for frame in frames):
            return [{**frame, "time": value} for frame, value in zip(frames, values)]
    return frames


def read_pose(path: Path, index: int, entry: dict[str, Any]) -> np.ndarray:
    """Return world-to-camera [4, 4] float64, OpenCV. The scale of a camera, which Blender exports, is left out: it
    changes nothing of what the camera sees."""
    where = f"{path}: frames[{index}].transform_matrix"
    if "transform_matrix" not in entry:
        raise UserError(f"{where} is missing; give the 4 x 4 camera-to-world matrix")
    matrix = numbers(entry["transform_matrix"])
    if matrix is None:
        raise UserError(f"{where} is not a matrix of numbers; give 4 rows of 4 numbers")
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4):
        raise UserError(f"{where} has shape {list(matrix.shape)}; give 4 rows of 4 numbers")
    if not np.isfinite(matrix).all():
        raise UserError(f"{where} holds NaN or infinity; correct the pose or drop the frame")
    matrix[:3, :3] = _unscaled(matrix[:3, :3])
    if not is_rotation(matrix[:3, :3]) or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise UserError(
            f"{where} is not rigid (sheared, mirrored, scaled unevenly, or last row not 0 0 0 1); "
            "give a rotation and a translation, or drop the frame"
        )
    return np.linalg.inv(matrix @ OPENGL_TO_OPENCV)


def _unscaled(matrix: np.ndarray) -> np.ndarray:
    """Divide a matrix [3, 3] by its scale, if that is the same along all axes."""
    if np.abs(matrix).max() > MOST_SCALE:
        return matrix
    lengths = np.linalg.norm(matrix, axis=0)
    scale = float(lengths.mean())
    even = scale > 1.0 / MOST_SCALE and np.abs(lengths / scale - 1.0).max() <= RIGID_TOLERANCE
    return matrix / scale if even and abs(scale - 1.0) > RIGID_TOLERANCE else matrix


class Times(NamedTuple):
    times: list[float]
    """Times in [0, 1]."""
    notes: tuple[str, ...]
    """Lines that the user should read."""


def read_times(path: Path, entries: list[dict[str, Any]], others: list[dict[str, Any]] | None = None) -> Times:
    """Return every frame's time; if no frame has a time, times are evenly spaced in the order of the file.

    Times beyond [0, 1], such as seconds or numbers of frames, are scaled to go from 0 to 1.

    Args:
        others: frames of other files, on the same scale of time; None without others.
    """
    given = [entry.get("time") is not None for entry in entries]
    if not any(given):
        last = max(len(entries) - 1, 1)
        return Times([index / last for index in range(len(entries))], ())
    times = []
    for index, entry in enumerate(entries):
        where = f"{path}: frames[{index}].time"
        if not given[index]:
            raise UserError(f"{where} is missing, but other frames have one; give a time to every frame or to no frame")
        time = as_number(entry["time"])
        if time is None:
            raise UserError(f"{where} is {str(entry['time'])[:40]!r}, not a number; give a number from 0 to 1")
        times.append(time)
    elsewhere = [as_number(entry.get("time")) for entry in others or []]
    known = [*times, *(time for time in elsewhere if time is not None)]
    first, last = min(known), max(known)
    if 0.0 <= first and last <= 1.0:
        return Times(times, ())
    length = last - first
    if not length < math.inf:
        raise UserError(f"{path}: the times of frames go from {first:g} to {last:g}; give numbers from 0 to 1")
    scaled = [(time - first) / length if length > 0.0 else 0.0 for time in times]
    return Times(scaled, (f"{path}: times from {first:.10g} to {last:.10g} are scaled to go from 0 to 1",))


def moments_of(files: list[Path]) -> list[int]:
    """Return the number of each image's moment, by the order of names. Of several folders whose images have the same
    names, those of one name are of one moment: the folders are cameras that record at once."""
    named: dict[str, set[Path]] = {}
    for file in files:
        named.setdefault(file.stem, set()).add(file.parent)
    shared = sum(len(folders) > 1 for folders in named.values())
    if 2 * shared > len(named):
        names = [Path(name) for name in named]
        ranks = {names[index].name: rank for rank, index in enumerate(by_name(names))}
        return [ranks[file.stem] for file in files]
    moments = [0] * len(files)
    for rank, index in enumerate(by_name(files)):
        moments[index] = rank
    return moments


def find_mask(path: Path, folder: Path, index: int, entry: dict[str, Any], key: str = "mask_path") -> Path | None:
    """Return the file of a frame's mask; None if it names none.

    Raises:
        UserError: the name is no text, or leads out of the folder.
    """
    mask = entry.get(key)
    if mask is None or mask == "":
        return None
    if not isinstance(mask, str):
        raise UserError(f"{path}: frames[{index}].{key} is not text; name the mask's file or leave it out")
    return inside(folder, mask, f"{path}: frames[{index}].{key}", "mask")


def read_distortion(path: Path, fields: dict[str, Any]) -> tuple[str, tuple[float, ...]]:
    """Return the camera model, COLMAP's or ``BROWN4``, and its parameters after (fx, fy, cx, cy).

    Args:
        fields: the fields of the file, overridden by those of a frame.

    Raises:
        UserError: the camera model is unknown, or the file has parameters that the model does not have.
    """
    name = _camera_model(fields)
    if isinstance(name, str) and name.upper() == PRISM:
        return "RAD_TAN_THIN_PRISM_FISHEYE", _prism(path, fields.get("distortion_params"))
    if name is not None and (not isinstance(name, str) or name.upper() not in (*PERSPECTIVES, *FISHEYES)):
        raise UserError(
            f"{path}: camera_model is {str(name)[:40]!r}, which is not supported; "
            f"undistort the images to one of {', '.join((*PERSPECTIVES, *FISHEYES, PRISM))}"
        )
    values = {key: _parameter(path, key, fields.get(key, 0.0)) for key in DISTORTION}
    listed = fields.get("distortion_params")
    if listed is not None:
        if not isinstance(listed, list) or len(listed) > len(LISTED_DISTORTION):
            raise UserError(
                f"{path}: distortion_params is {repr(listed)[:60]}; give up to six numbers, "
                f"{', '.join(LISTED_DISTORTION)}"
            )
        values |= {
            key: _parameter(path, f"distortion_params ({key})", value) for key, value in zip(LISTED_DISTORTION, listed)
        }
    k1, k2, k3, k4, k5, k6, p1, p2 = values.values()
    if not any(values.values()) and (name is None or name.upper() in PERSPECTIVES) and not fields.get("is_fisheye"):
        return "PINHOLE", ()
    if fields.get("is_fisheye") or (name is not None and name.upper() in FISHEYES):
        kind, unused = "OPENCV_FISHEYE", ("k5", "k6", "p1", "p2")
    elif k4 != 0.0 and (listed is not None if name is None else name.upper() == "OPENCV"):
        kind, unused = BROWN4, ("k5", "k6")  # nerfstudio's k4 belongs to the polynomial, OpenCV's to a quotient
    else:
        kind, unused = "FULL_OPENCV", () if name is not None and name.upper() == "FULL_OPENCV" else ("k4", "k5", "k6")
    for key in unused:
        if values[key] != 0.0:
            raise UserError(
                f"{path}: {key} is {values[key]:g}, a lens distortion that camera_model {name} does not have; "
                "name the model that was calibrated, or undistort the images and set it to 0"
            )
    if kind == "OPENCV_FISHEYE":
        return kind, (k1, k2, k3, k4)
    return kind, (k1, k2, p1, p2, k3, k4) if kind == BROWN4 else (k1, k2, p1, p2, k3, k4, k5, k6)


def _prism(path: Path, listed: Any) -> tuple[float, ...]:
    """Return the parameters of a lens of Project Aria."""
    if not isinstance(listed, list) or len(listed) != PRISM_COUNT:
        raise UserError(
            f"{path}: distortion_params is {repr(listed)[:60]}; give the {PRISM_COUNT} numbers of {PRISM}: k0 to k5, "
            "p0, p1, s0 to s3"
        )
    return tuple(_parameter(path, f"distortion_params[{index}]", value) for index, value in enumerate(listed))


def _camera_model(fields: dict[str, Any]) -> Any:
    """Return the name of the camera model; None without one. Spectacular AI writes it as ``model``, and OpenCV's eight
    parameters under ``OPENCV``."""
    other = fields.get("model")
    if "camera_model" in fields or not isinstance(other, str) or other.upper() not in (*PERSPECTIVES, *FISHEYES):
        return fields.get("camera_model")
    return "FULL_OPENCV" if other.upper() == "OPENCV" else other


def _parameter(path: Path, key: str, value: Any) -> float:
    number = as_number(value)
    if number is None:
        raise UserError(f"{path}: {key} is {str(value)[:40]!r}, not a number; give the lens distortion, or 0")
    return number


def reduced_from(fields: dict[str, Any], source: tuple[int, int]) -> tuple[int, int] | None:
    """Return the size that a frame states, if images of the size ``source`` are reduced ones of it; else None."""
    width, height = as_number(fields.get("w")), as_number(fields.get("h"))
    if width is None or height is None or not 1.0 <= min(width, height) <= max(width, height) < MOST_SCALE:
        return None
    full = (round(width), round(height))
    return full if full == (width, height) and is_reduced(source, full) else None


def note_reduced(path: Path, fields: dict[str, Any], file: Path) -> list[str]:
    """Return a note if the image of a frame is smaller than the frame states."""
    for source in header_sizes(file):
        full = reduced_from(fields, source)
        if full is not None:
            return [
                f"{path}: images are {size_text(source)}, the cameras {size_text(full)}; the cameras are scaled to "
                "the images"
            ]
    return []


def read_lens(path: Path, fields: dict[str, Any], index: int, source: tuple[int, int]) -> Lens:
    """Return the lens at the size of the file, ``source`` (width, height). It may be a reduced one of the size that is
    stated.

    Args:
        fields: the fields of the file, overridden by those of a frame.

    Raises:
        UserError: intrinsics are missing or invalid, or belong to images of a size other than ``source``.
    """
    full = reduced_from(fields, source) or source
    fx, fy, cx, cy = read_intrinsics(path, fields, index, full)
    model, further = read_distortion(path, fields)
    if model == "PINHOLE":
        sx, sy = source[0] / full[0], source[1] / full[1]
        return Lens(fx * sx, fy * sy, cx * sx, cy * sy)
    try:
        lens = make_lens(model, (fx, fy, cx, cy, *further))
        return lens if full == source else rescaled(lens, full, source)
    except ValueError as error:
        raise UserError(f"{path}: frames[{index}]: {error}; correct the lens, or undistort the images") from None


def read_intrinsics(
    path: Path, fields: dict[str, Any], index: int, source: tuple[float, float]
) -> tuple[float, float, float, float]:
    """Return (fx, fy, cx, cy) in pixels of the file's full size."""

    def number(key: str, default: float | None = None, positive: bool = False) -> float:
        if key not in fields and default is not None:
            return default
        value = as_number(fields.get(key))
        if value is None or (positive and value <= 0):
            kind = "positive number" if positive else "number"
            raise UserError(f"{path}: {key} (frame {index}) is missing or not a {kind}; give it in pixels")
        return value

    width, height = source
    for key, actual in (("w", width), ("h", height)):
        if key in fields and number(key) != actual:
            raise UserError(
                f"{path}: {key} is {fields[key]}, but the images are {size_text(source)}; "
                "correct w and h together with the intrinsics, or resize the images"
            )
    if "fl_x" in fields:
        fx = number("fl_x", positive=True)
        fy = number("fl_y", fx, positive=True)
    elif "camera_angle_x" in fields:
        angle = as_number(fields["camera_angle_x"])
        if angle is None or not 0.0 < angle < math.pi:
            raise UserError(f"{path}: camera_angle_x is {fields['camera_angle_x']!r}; give radians between 0 and pi")
        fx = fy = 0.5 * width / math.tan(0.5 * angle)
        if "camera_angle_y" in fields:
            angle = as_number(fields["camera_angle_y"])
            if angle is None or not 0.0 < angle < math.pi:
                raise UserError(
                    f"{path}: camera_angle_y is {fields['camera_angle_y']!r}; give radians between 0 and pi"
                )
            fy = 0.5 * height / math.tan(0.5 * angle)
    else:
        raise UserError(f"{path}: neither camera_angle_x nor fl_x is given; add the field of view in radians")
    cx, cy = number("cx", 0.5 * width), number("cy", 0.5 * height)
    _check_units(path, index, (fx, fy, cx, cy), source)
    return fx, fy, cx, cy


def _check_units(
    path: Path, index: int, intrinsics: tuple[float, float, float, float], source: tuple[float, float]
) -> None:
    """Refuse intrinsics in shares of the image's size, or of images of another size: cameras would see next to
    nothing.

    Raises:
        UserError: the intrinsics are not those of images of this size.
    """
    fx, _, cx, cy = intrinsics
    if 0.0 < cx <= 1.0 and 0.0 < cy <= 1.0 and fx < 10.0 and min(source) > 16:
        raise UserError(
            f"{path}: frame {index} has fl_x {fx:g}, cx {cx:g} and cy {cy:g}, shares of the images' size; "
            f"give them for images of {size_text(source)}"
        )
    if cx > CORNER * source[0] and cy > CORNER * source[1]:
        raise UserError(
            f"{path}: frame {index} has cx {cx:g} and cy {cy:g}, the lower right corner of images of "
            f"{size_text(source)}; give the intrinsics of images of this size"
        )
