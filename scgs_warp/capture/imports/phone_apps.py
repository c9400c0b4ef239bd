"""Folders that apps of phones export, whose cameras come from ARKit: Polycam, Record3D, 3D Scanner App.

Polycam (raw data): ``keyframes/corrected_images/TIME.jpg`` with ``keyframes/corrected_cameras/TIME.json``, or
``images`` and ``cameras`` where poses were not optimised: ``fx, fy, cx, cy, width, height`` and the rows ``t_00`` to
``t_23`` of the camera-to-world matrix; ``keyframes/depth/TIME.png`` in millimetres, and ``keyframes/confidence``.

Record3D (EXR + RGB sequence, ``EXR_RGBD``): ``metadata.json`` with ``poses`` (quaternion x y z w, then position,
camera-to-world), ``K`` (nine numbers by columns) or ``perFrameIntrinsicCoeffs`` (fx, fy, cx, cy), ``w, h`` and
``frameTimestamps``; ``rgb/0.jpg`` and so on; ``depth/0.exr`` in metres. An unpacked .r3d has ``metadata`` and
``rgbd/0.jpg``, with ``rgbd/0.depth``, float32 in metres, and ``rgbd/0.conf``, uint8, both of ``dh`` rows of ``dw``
numbers, compressed by LZFSE.

3D Scanner App (all data): ``frame_00000.json`` with ``cameraPoseARFrame`` (16 numbers by rows, camera-to-world),
``intrinsics`` (nine by rows) and ``time``, beside ``frame_00000.jpg``; ``depth_00000.png`` in millimetres, and
``conf_00000.png``.

Confidence 0 is the lowest of three levels, whose depth is a guess. Layouts: PolyCam/polyform's README; nerfstudio's
readers; laanlabs/3dScannerApp_samples.
Camera axes are OpenGL's, and y is up in the world; both are converted.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ...data.images import header_sizes
from ...data.natural_order import natural
from ...errors import UserError
from ...storage.exr_files import INSTALL, read_exr, reads_exr
from ...storage.json_files import as_number, read_json
from ...storage.lzfse_files import INSTALL as INSTALL_LZFSE
from ...storage.lzfse_files import read_lzfse, reads_lzfse
from ..folder_content import is_shown
from .monst3r import quaternion_matrix
from .scene import ImportedFrame, ImportedScene, from_arkit, intrinsics, rigid

MILLIMETRE = 0.001
MAX_DEPTH_PIXELS = 1 << 24
R3D_SHAPES = ((256, 192), (960, 720))
"""Rows and columns of depth in an .r3d that does not state them: by LiDAR, and by the camera that sees faces."""
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
Reader = Callable[[Path], ImportedScene]


def is_polycam(path: Path) -> bool:
    """Return whether the folder is a raw capture of Polycam."""
    return any(path.glob("keyframes/*cameras"))


def read_polycam(path: Path) -> ImportedScene:
    """Read a raw capture of Polycam, with the optimised cameras if there are any.

    Raises:
        UserError: a file is missing, damaged or does not fit; one line names it.
    """
    base = path / "keyframes"
    corrected = (base / "corrected_cameras").is_dir() and (base / "corrected_images").is_dir()
    cameras, images = (base / f"{'corrected_' if corrected else ''}{name}" for name in ("cameras", "images"))
    frames, files = [], _files(cameras, "*.json")
    for file in files:
        content = read_json(file, "export the capture again")
        rows = [[_number(file, content, f"t_{row}{column}") for column in range(4)] for row in range(3)]
        K = _pinhole(*(_number(file, content, key) for key in ("fx", "fy", "cx", "cy")))
        image = _image(images, file.stem)
        if image is None:
            continue
        stated = (_number(file, content, "width"), _number(file, content, "height"))
        frames.append(
            ImportedFrame(
                image,
                from_arkit(rigid(np.array(rows), f"{file}: t_00 to t_23")),
                _fitted(file, intrinsics(K, f"{file}: fx, fy, cx, cy"), stated, image),
                float(int(file.stem)) if file.stem.isdigit() and len(file.stem) < 19 else float(len(frames)),
                depth_of(*(base / kind / f"{file.stem}.png" for kind in ("depth", "confidence"))),
            )
        )
    missing = len(files) - len(frames)
    note = f"{missing} of {len(files)} cameras have no image in {images.name}, and are left out" if missing else None
    return ImportedScene("Polycam", frames, gravity=True, note=note)


def is_record3d(path: Path) -> bool:
    """Return whether the folder is an export of Record3D."""
    return _record3d_place(path) is not None


def _record3d_place(path: Path) -> tuple[Path, Path] | None:
    """Return the file of metadata and the folder of images, in the folder itself or in its ``EXR_RGBD``."""
    for base in (path, path / "EXR_RGBD"):
        for name, images in (("metadata.json", "rgb"), ("metadata", "rgbd")):
            if (base / name).is_file() and (base / images).is_dir():
                return base / name, base / images
    return None


def read_record3d(path: Path) -> ImportedScene:
    """Read an EXR + RGB sequence of Record3D, or an unpacked .r3d.

    Raises:
        UserError: a file is missing, damaged or does not fit; one line names it.
    """
    place = _record3d_place(path)
    if place is None:
        raise UserError(f"{path}: is no export of Record3D (metadata.json and rgb); export the capture again")
    file, folder = place
    content = read_json(file, "export the capture again")
    poses = _table(file, content, "poses", 7)
    if len(poses) > 1 and (poses == poses[0]).all():
        raise UserError(
            f"{file}: all poses are the same, because the app knows none of the camera that sees faces; find them by "
            f"the images in its folder {folder.name}: scgs-warp capture FOLDER --output DIR"
        )
    images = _paired(file, folder, len(poses))
    if "perFrameIntrinsicCoeffs" in content:
        lenses = _table(file, content, "perFrameIntrinsicCoeffs", 4)
        Ks = [_pinhole(*row) for row in lenses]
    else:
        Ks = [_row(file, content, "K", 9).reshape(3, 3).T] * len(poses)
    if len(Ks) != len(poses):
        raise UserError(f"{file}: has {len(poses)} poses, but {len(Ks)} intrinsics; export it again")
    moments = np.arange(len(poses), dtype=np.float64)
    if "frameTimestamps" in content:
        moments = _row(file, content, "frameTimestamps", len(poses))
    stated = (_number(file, content, "w"), _number(file, content, "h"))
    frames, maps, readable = [], folder.parent / "depth", reads_exr()
    for index, (row, K, image) in enumerate(zip(poses, Ks, images)):
        if image is None:
            continue
        where = f"{file}: poses[{index}]"
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = quaternion_matrix(row[[3, 0, 1, 2]], where), row[4:]
        lens = _fitted(file, intrinsics(K, f"{file}: intrinsics of frame {index}"), stated, image)
        depth = maps / f"{image.stem}.exr"
        load = partial(read_exr, depth) if readable and depth.is_file() else _depth_of_r3d(file, content, image)
        frames.append(ImportedFrame(image, from_arkit(rigid(pose, where)), lens, float(moments[index]), load))
    missing = len(poses) - len(frames)
    notes = [f"{missing} of {len(poses)} poses have no image in {folder.name}, and are left out"] if missing else []
    if not readable and any(maps.glob("*.exr")):
        notes.append(f"depth was not read: {INSTALL}")
    if not reads_lzfse() and any(folder.glob("*.depth")):
        notes.append(f"depth was not read: {INSTALL_LZFSE}")
    return ImportedScene("Record3D", frames, gravity=True, note="; ".join(notes) or None)


def _depth_of_r3d(file: Path, content: dict[str, Any], image: Path) -> Callable[[], np.ndarray] | None:
    """Return a function that reads the depth beside the image of an unpacked .r3d, 0 where it is least sure; None
    without it."""
    depth, sureness = image.with_suffix(".depth"), image.with_suffix(".conf")
    if not depth.is_file() or not reads_lzfse():
        return None
    shapes = R3D_SHAPES
    if "dw" in content or "dh" in content:
        rows, columns = (_number(file, content, key) for key in ("dh", "dw"))
        if not 1 <= min(rows, columns) or rows * columns > MAX_DEPTH_PIXELS:
            raise UserError(f"{file}: dw and dh are {columns:g} and {rows:g}; export the capture again")
        shapes = ((int(rows), int(columns)),)

    def load() -> np.ndarray:
        values = read_lzfse(depth, "<f4", shapes).astype(np.float64)
        if not sureness.is_file() or not sureness.stat().st_size:
            return values
        return np.where(read_lzfse(sureness, "u1", (values.shape,)) > 0, values, 0.0)

    return load


def _paired(file: Path, folder: Path, count: int) -> list[Path | None]:
    """Return the image of each of ``count`` poses, None for some that have none. Images are numbered as the poses.

    Raises:
        UserError: there are images without a pose, or fewer than half of the poses have one.
    """
    images = [image for image in _files(folder, "*") if image.suffix.lower() in IMAGE_SUFFIXES]
    if len(images) == count:
        return list(images)
    numbered = {int(image.stem): image for image in images if image.stem.isdecimal()}
    if len(numbered) < len(images) or not 2 * len(images) >= count or max(numbered, default=count) >= count:
        raise UserError(f"{file}: has {count} poses, but {folder} holds {len(images)} images; export it again")
    return [numbered.get(index) for index in range(count)]


def is_scanner(path: Path) -> bool:
    """Return whether the folder is an export of 3D Scanner App."""
    return any(path.glob("frame_[0-9]*.json"))


def read_scanner(path: Path) -> ImportedScene:
    """Read the raw data of 3D Scanner App; frames without an image are left out.

    Raises:
        UserError: a file is missing, damaged or does not fit; one line names it.
    """
    frames = []
    for file in _files(path, "frame_[0-9]*.json"):
        image = _image(path, file.stem)
        if image is None:
            continue
        content = read_json(file, "export the scan again")
        pose = rigid(_row(file, content, "cameraPoseARFrame", 16).reshape(4, 4), f"{file}: cameraPoseARFrame")
        K = intrinsics(_row(file, content, "intrinsics", 9).reshape(3, 3), f"{file}: intrinsics")
        moment = _number(file, content, "time") if "time" in content else float(len(frames))
        number = file.stem.split("_")[-1]
        depth = depth_of(path / f"depth_{number}.png", path / f"conf_{number}.png")
        frames.append(ImportedFrame(image, from_arkit(pose), K, moment, depth))
    return ImportedScene("3D Scanner App", frames, gravity=True)


def _files(folder: Path, pattern: str) -> list[Path]:
    return sorted(filter(is_shown, folder.glob(pattern)), key=lambda file: natural(file.name))


def _image(folder: Path, stem: str) -> Path | None:
    """Return the image of a frame; None if it has none."""
    return next((file for suffix in IMAGE_SUFFIXES if (file := folder / f"{stem}{suffix}").is_file()), None)


def _number(file: Path, content: dict[str, Any], key: str) -> float:
    value = as_number(content.get(key))
    if value is None:
        raise UserError(f"{file}: {key} is missing or no number; export it again")
    return value


def _row(file: Path, content: dict[str, Any], key: str, count: int) -> np.ndarray:
    """Return ``count`` numbers."""
    values = content.get(key)
    if isinstance(values, list) and len(values) == count:
        numbers = [as_number(value) for value in values]
        known = [number for number in numbers if number is not None]
        if len(known) == count:
            return np.array(known)
    raise UserError(f"{file}: {key} is missing or no list of {count} numbers; export it again")


def _table(file: Path, content: dict[str, Any], key: str, columns: int) -> np.ndarray:
    """Return rows of ``columns`` numbers."""
    rows = content.get(key)
    if not isinstance(rows, list) or not rows:
        raise UserError(f"{file}: {key} is missing or no list; export it again")
    return np.stack(
        [_row(file, {f"{key}[{index}]": row}, f"{key}[{index}]", columns) for index, row in enumerate(rows)]
    )


def _pinhole(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _fitted(file: Path, K: np.ndarray, stated: tuple[float, float], image: Path) -> np.ndarray:
    """Scale K from the stated size (width, height) to that of the image, which apps may have reduced.

    Raises:
        UserError: the proportions differ.
    """
    size = next(iter(header_sizes(image)), None)
    if size is None:
        return K
    sx, sy = size[0] / max(stated[0], 1e-9), size[1] / max(stated[1], 1e-9)
    if not 0.01 < sx < 100 or abs(sx / sy - 1.0) > 0.02:
        raise UserError(
            f"{file}: is of {stated[0]:g} x {stated[1]:g} pixels, but {image.name} is {size[0]} x {size[1]}; export "
            "the images as they were recorded"
        )
    return K * np.array([[sx], [sy], [1.0]])


def depth_of(path: Path, sureness: Path) -> Callable[[], np.ndarray] | None:
    """Return a function that reads depth in metres from a 16-bit image in millimetres, 0 where the image ``sureness``
    is 0 if there is one; None without the file."""
    if not path.is_file():
        return None

    def load() -> np.ndarray:
        depth = _grey(path).astype(np.float64) * MILLIMETRE
        if not sureness.is_file():
            return depth
        levels = _grey(sureness)
        if levels.shape != depth.shape:
            raise UserError(f"{sureness}: is of another size than {path.name}; remove it, or export it again")
        return np.where(levels > 0, depth, 0.0)

    return load


def _grey(path: Path) -> np.ndarray:
    """Read an image [h, w] of one channel."""
    sizes = header_sizes(path)
    if not sizes or sizes[0][0] * sizes[0][1] > MAX_DEPTH_PIXELS:
        raise UserError(f"{path}: is no depth image; remove it, or export it again")
    try:
        values = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, OSError):
        values = None
    if values is None or values.ndim != 2:
        raise UserError(f"{path}: is no depth image of one channel; remove it, or export it again")
    return values


LAYOUTS: tuple[tuple[Callable[[Path], bool], Reader], ...] = (
    (is_polycam, read_polycam),
    (is_record3d, read_record3d),
    (is_scanner, read_scanner),
)
