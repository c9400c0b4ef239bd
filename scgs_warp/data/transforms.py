"""What the ``transforms*.json`` layouts share: JSON, poses, times, intrinsics, and errors that name the field.

Poses are camera-to-world, OpenGL (x right, y up, z backward), as NeRF's Blender scenes and nerfstudio write them.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..errors import UserError
from ..types import Camera

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
RIGID_TOLERANCE = 1e-3
"""Largest entry of R^T R - I that passes as rounding."""
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
PINHOLES = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Camera models (COLMAP's and nerfstudio's names) that are a pinhole where all distortion is 0; a fisheye is not."""


def size_text(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]} pixels"


def read_transforms(path: Path) -> dict[str, Any]:
    """The JSON object in ``path``, with at least one frame; UserError otherwise."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; this split needs it, or choose another split") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read as UTF-8 text ({type(error).__name__}); restore the file") from None
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        raise UserError(
            f"{path}: not valid JSON, line {error.lineno} column {error.colno}: {error.msg}; restore or correct it"
        ) from None
    except ValueError:  # of Python, not of JSON: it converts no more than 4,300 digits
        raise UserError(f"{path}: holds a number of more than 4,300 digits; restore or correct the file") from None
    except RecursionError:
        raise UserError(f"{path}: JSON nested too deeply; restore the file") from None
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{path}: 'frames' is missing, empty or no list; list at least one frame there")
    for index, entry in enumerate(frames):
        if not isinstance(entry, dict):
            raise UserError(f"{path}: frames[{index}] is no object; give file_path and transform_matrix")
    return content


def as_number(value: Any) -> float | None:
    """A finite number as float; None for anything else (bool and strings too)."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def read_pose(path: Path, index: int, entry: dict[str, Any]) -> np.ndarray:
    """[4, 4] float64 world-to-camera, OpenCV."""
    where = f"{path}: frames[{index}].transform_matrix"
    if "transform_matrix" not in entry:
        raise UserError(f"{where} is missing; give the 4 x 4 camera-to-world matrix")
    try:
        matrix = np.array(entry["transform_matrix"], np.float64)
    except (ValueError, TypeError, OverflowError):
        raise UserError(f"{where} is not a matrix of numbers; give 4 rows of 4 numbers") from None
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4):
        raise UserError(f"{where} has shape {list(matrix.shape)}; give 4 rows of 4 numbers")
    if not np.isfinite(matrix).all():
        raise UserError(f"{where} holds NaN or infinity; correct the pose or drop the frame")
    rotation = matrix[:3, :3]
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if error > RIGID_TOLERANCE or np.linalg.det(rotation) < 0 or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise UserError(
            f"{where} is not rigid (scaled, sheared, mirrored, or last row not 0 0 0 1); "
            "give a rotation and a translation, or drop the frame"
        )
    return np.linalg.inv(matrix @ OPENGL_TO_OPENCV)


def read_times(path: Path, entries: list[dict[str, Any]]) -> list[float]:
    """Every frame's time in [0, 1]; where no frame has one, evenly spread in the order of the file."""
    given = ["time" in entry for entry in entries]
    if not any(given):
        last = max(len(entries) - 1, 1)
        return [index / last for index in range(len(entries))]
    times = []
    for index, entry in enumerate(entries):
        where = f"{path}: frames[{index}].time"
        if "time" not in entry:
            raise UserError(f"{where} is missing while other frames have one; give every frame a time, or none")
        time = as_number(entry["time"])
        if time is None:
            raise UserError(f"{where} is {str(entry['time'])[:40]!r}, not a number; give a number from 0 to 1")
        if not 0.0 <= time <= 1.0:
            raise UserError(f"{where} is {time:g}, outside [0, 1]; divide all times by the last one")
        times.append(time)
    return times


def find_image(path: Path, folder: Path, index: int, entry: dict[str, Any]) -> Path:
    """The frame's image; a name without suffix is completed."""
    name = entry.get("file_path")
    if not isinstance(name, str) or not name or "\0" in name:
        raise UserError(f"{path}: frames[{index}].file_path is missing or no text; name the image file")
    base = folder / name.replace("\\", "/")
    if base.suffix.lower() in SUFFIXES or base.is_file():
        return base
    candidates = [base.with_name(base.name + suffix) for suffix in SUFFIXES]
    return next((candidate for candidate in candidates if candidate.is_file()), candidates[0])


def check_distortion(path: Path, content: dict[str, Any]) -> None:
    """Images are taken as those of a pinhole camera. ``content``: the file's object, or one of its frames.

    Raises:
        UserError: another camera model, or lens distortion.
    """
    model = content.get("camera_model")
    if model is not None and (not isinstance(model, str) or model.upper() not in PINHOLES):
        raise UserError(
            f"{path}: camera_model is {str(model)[:40]!r}, which is not supported; "
            f"undistort the images to one of {', '.join(PINHOLES)}"
        )
    parameters = content.get("distortion_params")
    if parameters is not None and (
        not isinstance(parameters, list) or any(as_number(value) != 0.0 for value in parameters)
    ):
        raise UserError(
            f"{path}: distortion_params is {repr(parameters)[:60]}, lens distortion, which is not supported yet; "
            "undistort the images and leave it out"
        )
    for key in DISTORTION:
        value = content.get(key, 0)
        if as_number(value) != 0.0:
            raise UserError(
                f"{path}: {key} is {value!r}, lens distortion, which is not supported yet; "
                "undistort the images and set it to 0"
            )


def read_intrinsics(
    path: Path, fields: dict[str, Any], index: int, source: tuple[int, int]
) -> tuple[float, float, float, float]:
    """(fx, fy, cx, cy) in pixels of the file's full size."""

    def number(key: str, default: float | None = None, positive: bool = False) -> float:
        if key not in fields and default is not None:
            return default
        value = as_number(fields.get(key))
        if value is None or (positive and value <= 0):
            kind = "positive number" if positive else "number"
            raise UserError(f"{path}: {key} (frame {index}) is missing or no {kind}; give it in pixels")
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
    else:
        raise UserError(f"{path}: neither camera_angle_x nor fl_x is given; add the field of view in radians")
    return fx, fy, number("cx", 0.5 * width), number("cy", 0.5 * height)


def make_camera(
    viewmat: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    source: tuple[int, int],
    image: torch.Tensor,
) -> Camera:
    """The camera of an image [H, W, 3] that was reduced from ``source`` (width, height), whose intrinsics these are."""
    height, width = image.shape[:2]
    fx, fy, cx, cy = intrinsics
    sx, sy = width / source[0], height / source[1]
    K = torch.tensor([[fx * sx, 0.0, cx * sx], [0.0, fy * sy, cy * sy], [0.0, 0.0, 1.0]], dtype=torch.float32)
    return Camera(torch.from_numpy(viewmat).float(), K, width, height)
