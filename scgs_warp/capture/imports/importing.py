"""The import itself: choose the layout, and write images, cameras, times, points and depth in nerfstudio's layout."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...data.dataset import spread
from ...data.depth_cloud import depth_cloud
from ...data.held_out import held_out
from ...data.images import size_text
from ...data.orientation import UPRIGHT, read_orientation
from ...data.points import write_points
from ...errors import UserError
from ...geometry.rotation import OPENGL_TO_OPENCV
from ...runtime.progress import ShowProgress, progress
from ...storage.files import read_bytes
from ...storage.output_folders import paths_in, write_folder_atomically
from ...storage.png_files import write_png
from ..similarity import Similarity, upright
from ..source import read_rgb
from . import agreement, arrays, frame_folders, monst3r, phone_apps, pi3, stray_scanner, vipe
from .archives import unpacked
from .depth_writing import DepthWriter, checked_depth, known_depth
from .scene import MAX_NUMBER, ImportedFrame, ImportedScene

FILE, POINTS = "transforms.json", "points.ply"
MIN_FRAMES = 2
POINT_FRAMES = 24
"""Number of frames whose depth gives points."""
POINT_COUNT = 40_000
"""Number of points, from all these frames together."""

MAX_MOMENT = 1e19
"""Largest time of a frame, in the unit of the file: microseconds since 1970 are below it."""

LAYOUTS: tuple[tuple[Callable[[Path], bool], Callable[[Path], ImportedScene]], ...] = (
    *((module.recognises, module.read) for module in (vipe, pi3, arrays, monst3r, stray_scanner)),
    *frame_folders.LAYOUTS,
    *phone_apps.LAYOUTS,
)
"""What recognises a file or folder of a layout, and its reader, in the order in which they are tried."""


class ImportResult(NamedTuple):
    """Result of an import."""

    program: str
    frames: int
    points: int
    """Number of points that depth gave; 0 without depth."""
    pose_error: float | None
    """Distance of static features from the epipolar lines of the poses, pixels; None if too few are in common."""
    note: str | None
    """Line about what was left out."""


def read_scene(path: Path) -> ImportedScene:
    """Read the scene of another program.

    Raises:
        UserError: the layout is unknown, or a file does not fit it; one line says what.
    """
    if not path.exists():
        raise UserError(f"--poses {path}: no such file or folder; give what the other program exported")
    for recognises, read in LAYOUTS:
        if recognises(path):
            return read(path)
    if (path / FILE).is_file():
        raise UserError(f"--poses {path}: is in nerfstudio's layout already; python apps/train.py --data {path}")
    raise UserError(
        f"--poses {path}: is no scene of MegaSaM, VGGT, MapAnything, Depth Anything 3, SpatialTrackerV2 or Pi3 "
        f"(.npz), MonST3R ({monst3r.TRAJECTORY}), ViPE (pose, rgb), CUT3R (camera, color), DA3-Streaming "
        f"({frame_folders.POSES}), Uni4D (0000.npz), Polycam (keyframes), Record3D (.r3d; metadata.json, rgb), 3D "
        f"Scanner App (frame_00000.json) or Stray Scanner ({stray_scanner.TRACK}); export one of these"
    )


def import_scene(path: Path, folder: Path, show: ShowProgress = progress) -> ImportResult:
    """Make a data set of the scene at ``path``, a folder, a file or a zip archive. The folder appears when it is
    complete.

    Args:
        folder: must not exist, or be empty.
        show: ``show(total, text)`` is a context manager that shows progress; its value has ``advance()``.

    Raises:
        UserError: the scene is invalid, or the folder holds something.
    """
    if folder.exists() and (not folder.is_dir() or paths_in(folder)):
        raise UserError(f"{folder}: exists and holds something else; give another --output, or remove it")
    with unpacked(path, folder, show) as place:
        return _import(read_scene(place), place, folder, show)


def _import(scene: ImportedScene, path: Path, folder: Path, show: ShowProgress) -> ImportResult:
    """Write the data set of a scene that was read from ``path``."""
    if len(scene.frames) < MIN_FRAMES:
        raise UserError(f"{path}: has {len(scene.frames)} frames with an image, but two are needed; export it again")
    latest = max(abs(frame.moment) for frame in scene.frames)
    if not latest < MAX_MOMENT:
        raise UserError(f"{path}: a frame has the time {latest:g}; export the scene again")
    made: list[_Written] = []
    write_folder_atomically(folder, lambda work: made.append(_write(work, path, scene, show)))
    notes = [scene.note] if scene.note else []
    if made[0].without_depth:
        share = f"{made[0].without_depth} of {len(scene.frames)} frames"
        notes.append(f"{share} have no depth map, or one that is empty or of other proportions than the image")
    return ImportResult(scene.program, len(scene.frames), made[0].points, made[0].pose_error, "; ".join(notes) or None)


class _Written(NamedTuple):
    """What was written."""

    points: int
    pose_error: float | None
    without_depth: int
    """Number of frames without a depth map in a scene that has depth."""


def _write(work: Path, path: Path, scene: ImportedScene, show: ShowProgress) -> _Written:
    """Write the folder."""
    (work / "images").mkdir()
    frames = scene.frames
    chosen = set(spread(len(frames), POINT_FRAMES))
    share = POINT_COUNT // len(chosen)
    names, sizes, clouds, maps, depths = [], [], [], [], DepthWriter(work)
    with show(len(frames), f"importing from {scene.program}") as bar:
        for index, frame in enumerate(frames):
            image, name = _write_image(work / "images", frame, f"frame_{index:05d}")
            names.append(f"images/{name}")
            sizes.append((image.shape[1], image.shape[0]))
            if sizes[-1] != sizes[0]:
                where = frame.image if isinstance(frame.image, Path) else f"frame {index}"
                raise UserError(
                    f"{where}: is {size_text(sizes[-1])}, but the first image is {size_text(sizes[0])}; export images "
                    "of one size"
                )
            if frame.depth is not None:
                depth = checked_depth(frame.depth(), f"frame {index}")
                maps.append(depths.write(Path(name).stem, depth, sizes[-1]))
                if index in chosen:
                    clouds.append(depth_cloud(known_depth(depth), image, frame.K, frame.viewmat, share))
            else:
                maps.append(None)
            bar.advance()
    points = np.concatenate([np.zeros((0, 3)), *(cloud[0] for cloud in clouds)])
    colors = np.concatenate([np.zeros((0, 3), np.uint8), *(cloud[1] for cloud in clouds)])
    viewmats = np.stack([frame.viewmat for frame in frames])
    moved = Similarity(1.0, np.eye(3), np.zeros(3)) if scene.gravity else upright(viewmats, points)
    viewmats, points = moved.viewmats(viewmats), moved.points(points)
    if not (np.abs(viewmats).max() < MAX_NUMBER and np.abs(points).max(initial=0.0) < MAX_NUMBER**2):
        raise UserError(f"{path}: the cameras of this scene are too close together for its depth; export it again")
    if len(points):
        write_points(work / POINTS, points, colors)
    content = _transforms(work, frames, names, sizes, viewmats, bool(len(points)))
    for entry, depth_file in zip(content["frames"], maps):
        if depth_file is not None:
            entry["depth_file_path"] = depth_file
            content["depth_unit_scale_factor"] = depths.unit * moved.scale
    (work / FILE).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    with show(len(agreement.pairs(len(frames))), "comparing the poses with the images") as bar:
        lenses = [frame.K for frame in frames]
        error = agreement.pose_error(lambda index: read_rgb(work / names[index]), viewmats, lenses, bar.advance)
    has_depth = any(frame.depth is not None for frame in frames)
    return _Written(len(points), error, maps.count(None) if has_depth else 0)


def _write_image(folder: Path, frame: ImportedFrame, stem: str) -> tuple[np.ndarray, str]:
    """Write or copy a frame's image; return it, [H, W, 3] uint8 RGB, and its name."""
    if isinstance(frame.image, Path):
        name = f"{stem}{frame.image.suffix.lower()}"
        image = read_rgb(frame.image)
        if read_orientation(read_bytes(frame.image, "export the scene again")) != UPRIGHT:
            raise UserError(f"{frame.image}: is turned by its EXIF tag, but its camera is not; export it upright")
        shutil.copyfile(frame.image, folder / name)
        return image, name
    image = frame.image()
    write_png(folder / f"{stem}.png", image)
    return image, f"{stem}.png"


def _transforms(
    work: Path, frames: list[ImportedFrame], names: list[str], sizes: list[tuple[int, int]], viewmats: np.ndarray,
    has_points: bool,
) -> dict[str, Any]:  # fmt: skip
    """Make the content of ``transforms.json``."""
    moments = np.array([frame.moment for frame in frames])
    first, last = float(moments.min()), float(moments.max())
    times = (moments - first) / (last - first) if last > first else np.linspace(0.0, 1.0, len(frames))
    entries = []
    for frame, name, (width, height), viewmat, time in zip(frames, names, sizes, viewmats, times.tolist()):
        K = frame.K
        entries.append(
            {
                "file_path": name,
                "transform_matrix": (np.linalg.inv(viewmat) @ OPENGL_TO_OPENCV).tolist(),
                "time": min(max(time, 0.0), 1.0),
                **{"w": width, "h": height, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]},
            }
        )
    order = np.argsort(times, kind="stable").tolist()
    lists = {split: held_out(work, order, split) for split in ("train", "test")}
    return {
        "camera_model": "PINHOLE",
        **({"ply_file_path": POINTS} if has_points else {}),
        "frames": entries,
        **{f"{split}_filenames": [names[index] for index in chosen] for split, chosen in lists.items()},
    }
