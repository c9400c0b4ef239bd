"""Output of a capture: undistorted images, cameras and times in nerfstudio's layout, and points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

import cv2
import numpy as np

from ..data.held_out import held_out
from ..data.points import write_points
from ..geometry.rotation import OPENGL_TO_OPENCV
from ..storage.json_files import write_json
from ..storage.png_files import write_png
from .colmap import quiet
from .cut_out import HIDDEN, moved
from .features import FrameFiles
from .mapping import CameraSolution
from .similarity import upright
from .source import read_cut_out, read_rgb

Keep = Literal["all", "moving", "static"]
"""What the data set shows: the images; what moves, cut out by alpha; or what stands still, with movers masked."""

FILE = "transforms.json"
POINTS = "points.ply"
CLOCKWISE = np.array([[0.0, -1.0], [1.0, 0.0]])
"""A quarter turn of a camera's axes, x to the right and y down."""


class Pinhole(NamedTuple):
    """Intrinsics of the undistorted images."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


class CapturedScene(NamedTuple):
    """The captured scene as written to disk; world with z up."""

    pinhole: Pinhole
    viewmats: np.ndarray
    """[V, 4, 4] world-to-camera, OpenCV."""
    times: list[float]
    """[0, 1]"""
    seconds: list[float]
    """Times in the video, in seconds."""
    names: list[str]
    """File names in ``images``."""
    points: np.ndarray
    """[P, 3]"""
    colors: np.ndarray
    """[P, 3] uint8"""


class Calibrated(Protocol):
    """A camera with COLMAP's model and parameters."""

    @property
    def model(self) -> str: ...
    @property
    def params(self) -> tuple[float, ...]: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...


def pinhole_of(solved: Calibrated) -> tuple[Pinhole, np.ndarray, np.ndarray]:
    """Find the largest pinhole image without empty pixels inside the distorted one. Return its intrinsics, and the
    distorted coordinates of its pixels, x [H, W] and y [H, W] float32 in OpenCV's convention.

    It is moved by up to half a pixel, so that the pixels around the principal point, where the lens does not distort,
    are those of the distorted image: half a pixel aside they would lose their finest detail.
    """
    with quiet() as pycolmap:
        camera = pycolmap.Camera(model=solved.model, width=solved.width, height=solved.height)
        camera.params = list(solved.params)
        flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        fx, fy, cx, cy = (float(value) for value in flat.params)
        own = camera.calibration_matrix()
        cx, cy = own[0, 2] - round(own[0, 2] - cx), own[1, 2] - round(own[1, 2] - cy)
        x, y = np.meshgrid((np.arange(flat.width) + 0.5 - cx) / fx, (np.arange(flat.height) + 0.5 - cy) / fy)
        rays = np.stack([x, y, np.ones_like(x)], 2).reshape(-1, 3)
        pixels = np.asarray(camera.img_from_cam(rays)).reshape(*x.shape, 2).astype(np.float32) - 0.5
    return Pinhole(fx, fy, cx, cy, flat.width, flat.height), pixels[..., 0].copy(), pixels[..., 1].copy()


def undistort(
    frame_files: FrameFiles, solved: CameraSolution, folder: Path, done: Callable[[], object], keep: Keep = "all"
) -> Pinhole:
    """Write ``images/`` of the registered frames, and ``masks/`` if there are masks.

    Args:
        done: called after each frame.
        keep: ``moving`` gives the images an alpha channel, which is 0 where the masks are white.
    """
    pinhole, x, y = pinhole_of(solved)

    def undistorted(pixels: np.ndarray) -> np.ndarray:
        return cv2.remap(pixels, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    (folder / "images").mkdir(exist_ok=True)
    if frame_files.masks is not None:
        (folder / "masks").mkdir(exist_ok=True)
    for number in solved.places:
        name = frame_files.names[number]
        file = frame_files.folder / name
        image, alpha = read_cut_out(file) if frame_files.cut_out else (read_rgb(file), None)
        hidden = alpha is not None and alpha < HIDDEN
        image, alpha = moved(image, alpha, undistorted)
        if frame_files.masks is not None:
            mask = read_rgb(frame_files.masks / name)
            mask[hidden] = 255  # Training may know that nothing is there.
            write_png(
                folder / "masks" / name, cv2.remap(mask, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
            )
            if keep == "moving":
                still = cv2.remap(mask[..., 0], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                alpha = 255 - still if alpha is None else np.minimum(alpha, 255 - still)
        write_png(folder / "images" / name, image if alpha is None else np.dstack([image, alpha]))
        done()
    return pinhole


def as_held(viewmats: np.ndarray, turns: Sequence[int]) -> np.ndarray:
    """Return the world-to-camera matrices [V, 4, 4] that pictures would have without their quarter turns,
    counter-clockwise; all have none if ``turns`` is empty."""
    held = viewmats.copy()
    for view, count in zip(held, turns):
        view[:2] = np.linalg.matrix_power(CLOCKWISE, count) @ view[:2]
    return held


def scene_of(
    frame_files: FrameFiles,
    solved: CameraSolution,
    pinhole: Pinhole,
    seconds: Sequence[float],
    span: tuple[float, float],
    turns: Sequence[int] = (),
) -> CapturedScene:
    """Turn cameras and points upright, and map times from ``span`` (seconds of the video) to [0, 1].

    Args:
        turns: number of quarter turns, counter-clockwise, by which each frame was turned; empty if none was.
    """
    placed = upright(as_held(solved.viewmats, [turns[number] for number in solved.places if turns]), solved.points)
    length = max(span[1] - span[0], 1e-9)
    chosen = [seconds[number] for number in solved.places]
    return CapturedScene(
        pinhole,
        placed.viewmats(solved.viewmats),
        [min(max((second - span[0]) / length, 0.0), 1.0) for second in chosen],
        chosen,
        [frame_files.names[number] for number in solved.places],
        placed.points(solved.points),
        solved.colors,
    )


def write_scene(folder: Path, scene: CapturedScene, keep: Keep = "all") -> None:
    """Write ``points.ply`` and then ``transforms.json``, whose presence marks a complete folder.

    Args:
        keep: ``moving`` leaves out the points, which stand still; ``static`` names the masks of the frames.
    """
    if keep != "moving":
        write_points(folder / POINTS, scene.points, scene.colors)
    inside = [f"images/{name}" for name in scene.names]
    lists = {split: held_out(folder, range(len(inside)), split) for split in ("train", "test")}
    frames = [
        {
            "file_path": file,
            **({"mask_path": f"masks/{Path(file).name}"} if keep == "static" else {}),
            "transform_matrix": (np.linalg.inv(viewmat) @ OPENGL_TO_OPENCV).tolist(),
            "time": time,
            "seconds": second,
        }
        for file, viewmat, time, second in zip(inside, scene.viewmats, scene.times, scene.seconds)
    ]
    p = scene.pinhole
    content = {
        "camera_model": "PINHOLE",
        **{"w": p.width, "h": p.height, "fl_x": p.fx, "fl_y": p.fy, "cx": p.cx, "cy": p.cy},
        **({} if keep == "moving" else {"ply_file_path": POINTS}),
        "frames": frames,
        **{f"{split}_filenames": [inside[index] for index in chosen] for split, chosen in lists.items()},
    }
    write_json(folder / FILE, content)
