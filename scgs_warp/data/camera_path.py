"""Camera paths of films: nerfstudio's camera_path.json, and the frames of a transforms.json."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp

from ..errors import UserError
from ..geometry.cameras import Overview, image_size
from ..storage.json_files import as_array, as_number, read_json
from ..types import Camera
from .readers.transforms import read_intrinsics, read_pose

MOST_CAMERAS = 100_000
FARTHEST = 1e9
"""Largest coordinate of a camera."""
NARROWEST, WIDEST = 1e-3, 3.1
"""Limits of the vertical field of view in radians."""


class PathCamera(NamedTuple):
    """A camera of a path."""

    viewmat: np.ndarray
    """[4, 4] float64 world-to-camera, OpenCV."""
    fov: float
    """Vertical field of view in radians."""
    time: float | None
    """Time in [0, 1]; None if the path does not say."""
    stretch: float = 1.0
    """Focal length across divided by that upwards."""
    centre: tuple[float, float] = (0.5, 0.5)
    """Principal point, as shares of the picture's width and height."""


class CameraPath(NamedTuple):
    """Cameras in their order, and the proportions of the pictures."""

    cameras: list[PathCamera]
    aspect: float
    """Width divided by height."""

    def film(self, frames: int | None, size: int, step: int = 2) -> list[tuple[Camera, float | None]]:
        """Return the cameras of a film and their times.

        Args:
            frames: number of cameras, spread evenly over the path and interpolated; None: those of the path.
            size: longer side of the pictures in pixels.
            step: as for ``cameras.image_size``.
        """
        chosen = self.cameras if frames is None else resampled(self.cameras, frames)
        width, height = image_size(Overview((0, 0, 0), (0, 0, 1), 1.0, 60.0, 0.0, aspect=self.aspect), size, step)
        made = []
        for viewmat, fov, time, stretch, (across, down) in chosen:
            focal = 0.5 * height / math.tan(0.5 * fov)
            K = torch.tensor([[focal * stretch, 0.0, across * width], [0.0, focal, down * height], [0.0, 0.0, 1.0]])
            made.append((Camera(torch.from_numpy(viewmat).float(), K, width, height), time))
        return made


def resampled(cameras: list[PathCamera], count: int) -> list[PathCamera]:
    """Interpolate ``count`` cameras along a path: positions, intrinsics and times linearly, rotations on the shortest
    arc."""
    if len(cameras) == 1:
        return cameras * count
    knots, wanted = np.arange(len(cameras)), np.linspace(0.0, len(cameras) - 1.0, count)
    poses = np.stack([np.linalg.inv(camera.viewmat) for camera in cameras])
    turns = Slerp(knots, Rotation.from_matrix(poses[:, :3, :3]))(wanted).as_matrix()
    places = np.stack([np.interp(wanted, knots, poses[:, axis, 3]) for axis in range(3)], axis=1)
    fovs = np.interp(wanted, knots, [camera.fov for camera in cameras])
    stretches = np.interp(wanted, knots, [camera.stretch for camera in cameras])
    centres = [np.interp(wanted, knots, [camera.centre[axis] for camera in cameras]) for axis in range(2)]
    given = [camera.time for camera in cameras]
    times = None if None in given else np.interp(wanted, knots, np.array(given, np.float64))
    made = []
    for index in range(count):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turns[index], places[index]
        time = None if times is None else float(times[index])
        centre = float(centres[0][index]), float(centres[1][index])
        made.append(PathCamera(np.linalg.inv(pose), float(fovs[index]), time, float(stretches[index]), centre))
    return made


def read_camera_path(path: Path, overview: Overview) -> CameraPath:
    """Read a camera path.

    Args:
        path: JSON with ``camera_path`` (``camera_to_world`` as 16 numbers, ``fov`` in degrees), as nerfstudio's viewer
            writes it, or with ``frames`` (``transform_matrix``), as transforms.json. Poses are camera-to-world, OpenGL.
        overview: gives the field of view and the proportions that the file does not state.

    Raises:
        UserError: the file is missing, or a field is wrong.
    """
    content = read_json(path, "give a camera path, or a transforms.json")
    key = "camera_path" if "camera_path" in content else "frames"
    entries = content.get(key)
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise UserError(f"{path}: holds no list camera_path or frames; give a camera path, or a transforms.json")
    if len(entries) > MOST_CAMERAS:
        raise UserError(f"{path}: {key} has {len(entries):,} cameras; give at most {MOST_CAMERAS:,}")
    kind = content.get("camera_type") or "perspective" if key == "camera_path" else "perspective"
    if not isinstance(kind, str) or kind.lower() != "perspective":
        raise UserError(f"{path}: camera_type is {str(kind)[:40]}; films are perspective: export a perspective path")
    aspect = _aspect(path, content, overview)
    read = _nerfstudio if key == "camera_path" else _frame
    return CameraPath(
        [read(path, content, index, entry, overview, aspect) for index, entry in enumerate(entries)], aspect
    )


def _aspect(path: Path, content: dict[str, Any], overview: Overview) -> float:
    for width, height in (("render_width", "render_height"), ("w", "h")):
        if width in content or height in content:
            w, h = as_number(content.get(width)), as_number(content.get(height))
            if w is None or h is None or not (w >= 1 and h >= 1 and 0.01 <= w / h <= 100):
                raise UserError(f"{path}: {width} or {height} is missing or no size in pixels; correct or remove both")
            return w / h
    return overview.aspect


def _time(where: str, entry: dict[str, Any]) -> float | None:
    name = "time" if entry.get("time") is not None else "render_time"  # nerfstudio's
    if entry.get(name) is None:
        return None
    time = as_number(entry[name])
    if time is None or not 0.0 <= time <= 1.0:
        raise UserError(f"{where}.{name} is {str(entry[name])[:40]}; give a number from 0 to 1, or leave it out")
    return time


def _fov(where: str, value: Any, degrees: bool) -> float:
    number = as_number(value)
    angle = math.radians(number) if degrees and number is not None else number
    if angle is None or not NARROWEST < angle < WIDEST:
        raise UserError(f"{where} is {str(value)[:40]}, no field of view; correct it or leave it out")
    return angle


def _usual_fov(overview: Overview, aspect: float) -> float:
    return 2.0 * math.atan(math.tan(math.radians(overview.fov_x) / 2.0) / aspect)


def _nerfstudio(
    path: Path, content: dict[str, Any], index: int, entry: dict[str, Any], overview: Overview, aspect: float
) -> PathCamera:
    where = f"{path}: camera_path[{index}]"
    matrix = as_array(entry.get("camera_to_world"), (16,), (4, 4))
    if matrix is None:
        raise UserError(f"{where}.camera_to_world is not 16 finite numbers; export the path again")
    viewmat = read_pose(path, index, {"transform_matrix": matrix.reshape(4, 4).tolist()})
    fov = _fov(f"{where}.fov", entry["fov"], True) if "fov" in entry else _usual_fov(overview, aspect)
    return _checked(where, PathCamera(viewmat, fov, _time(where, entry)))


def _frame(
    path: Path, content: dict[str, Any], index: int, entry: dict[str, Any], overview: Overview, aspect: float
) -> PathCamera:
    where = f"{path}: frames[{index}]"
    fields = {**content, **entry}
    viewmat, time = read_pose(path, index, entry), _time(where, entry)
    if "w" in fields and ("fl_x" in fields or "camera_angle_x" in fields):
        width = as_number(fields["w"])
        height = as_number(fields["h"]) if "h" in fields else width and width / aspect
        if width is None or height is None or width < 1 or height < 1:
            raise UserError(f"{where}: w or h is no size in pixels; correct both")
        fx, fy, cx, cy = read_intrinsics(path, fields, index, (width, height))
        shown = width / aspect  # the film's height in pixels of the frame, whose proportions may be others
        centre = cx / width, 0.5 + (cy - 0.5 * height) / shown
        return _checked(where, PathCamera(viewmat, 2.0 * math.atan(0.5 * shown / fy), time, fx / fy, centre))
    across = math.radians(overview.fov_x)
    if "camera_angle_x" in fields:
        across = _fov(f"{path}: camera_angle_x", fields["camera_angle_x"], False)
    return _checked(where, PathCamera(viewmat, 2.0 * math.atan(math.tan(across / 2.0) / aspect), time))


def _checked(where: str, camera: PathCamera) -> PathCamera:
    """Refuse a camera that no picture could be made with."""
    if not np.abs(camera.viewmat).max() < FARTHEST:
        raise UserError(f"{where}: the camera is farther than {FARTHEST:g} units away; correct its pose")
    if not NARROWEST < camera.fov < WIDEST:
        raise UserError(f"{where}: a field of view of {math.degrees(camera.fov):.3g} degrees; correct the intrinsics")
    return camera
