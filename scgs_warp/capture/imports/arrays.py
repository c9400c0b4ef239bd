"""Scenes in one ``.npz`` with images, depth, intrinsics and poses: MegaSaM's, VGGT's, Depth Anything 3's.

MegaSaM (``NAME_sgd_cvd_hr.npz``, ``NAME_droid.npz``): ``images [N, H, W, 3]`` bytes, ``depths [N, H, W]``,
``intrinsic [3, 3]``, ``cam_c2w [N, 4, 4]`` camera-to-world. VGGT (``predictions.npz`` of its demo): ``images
[N, 3, H, W]`` in [0, 1], ``depth [N, H, W, 1]``, ``depth_conf [N, H, W]``, ``intrinsic [N, 3, 3]``, ``extrinsic
[N, 3, 4]`` world-to-camera. Depth Anything 3 (format ``npz``): ``image [N, H, W, 3]`` bytes, ``depth``, ``conf
[N, H, W]``, ``intrinsics [N, 3, 3]``, ``extrinsics [N, 3, 4]`` world-to-camera; ``predictions.npz`` of its app calls
the first two ``images`` and ``depths``. Scenes of DUSt3R, which has no file of its own, fit if they are saved under
MegaSaM's names. Cameras are OpenCV's.
Layouts: Li et al., MegaSaM, CVPR 2025; Wang et al., VGGT, CVPR 2025; Lin et al., Depth Anything 3, 2025.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import UserError
from ...storage.numpy_files import read_npy
from .scene import ImportedFrame, ImportedScene, intrinsics, rigid, surer
from .stacks import Stack, members

SMALLEST = 8
"""Smallest side of an image, pixels."""
OVERSHOOT = 0.1
"""How far colours may leave [0, 1], as resampling makes them."""


class Layout(NamedTuple):
    """Names of the arrays of one program."""

    program: str
    poses: str
    """Name of the array of poses, which no other program writes."""
    camera_to_world: bool
    images: str
    depth: str
    lens: str
    confidence: str
    """Empty if there is none."""


LAYOUTS = (
    Layout("MegaSaM", "cam_c2w", True, "images", "depths", "intrinsic", ""),
    Layout("VGGT", "extrinsic", False, "images", "depth", "intrinsic", "depth_conf"),
    Layout("Depth Anything 3", "extrinsics", False, "image", "depth", "intrinsics", "conf"),
    Layout("Depth Anything 3", "extrinsics", False, "images", "depths", "intrinsics", "conf"),
)


def recognises(path: Path) -> bool:
    """Return whether the file holds such a scene."""
    return path.suffix.lower() == ".npz" and path.is_file()


def read(path: Path) -> ImportedScene:
    """Read a scene; images and depth stay in the file until they are asked for.

    Raises:
        UserError: an array is missing, misshapen or damaged; one line names it.
    """
    names = members(path)
    posed = [layout for layout in LAYOUTS if layout.poses in names]
    if not posed:
        known, programs = (dict.fromkeys(getattr(layout, key) for layout in LAYOUTS) for key in ("poses", "program"))
        raise UserError(
            f"{path}: holds no poses ({', '.join(known)}); give an .npz of {', '.join(programs)}, or one with images, "
            "depths, intrinsic and cam_c2w"
        )
    layout = next((layout for layout in posed if layout.images in names), posed[0])
    for name, what in ((layout.images, "images"), (layout.lens, "intrinsics")):
        if name not in names:
            raise UserError(f"{path}: holds no {what} ({name}), which {layout.program} writes; export it again")
    images = Stack(path, layout.images)
    height, width, channels_first = _image_size(images)
    count = images.shape[0]
    poses, K = read_npy(path, layout.poses), read_npy(path, layout.lens)
    if poses.ndim != 3 or len(poses) != count:
        raise UserError(f"{path}: {layout.poses} is {list(poses.shape)}, but there are {count} images; export it again")
    if K.shape not in ((3, 3), (count, 3, 3)):
        raise UserError(f"{path}: {layout.lens} is {list(K.shape)}, not [3, 3] or [{count}, 3, 3]; export it again")
    Ks = np.broadcast_to(K, (count, 3, 3))
    pictures, depth_at = _InOrder(images), _depths(path, layout, names, (count, height, width))
    frames = []
    for index in range(count):
        pose = rigid(poses[index], f"{path}: {layout.poses}[{index}]")
        frames.append(
            ImportedFrame(
                lambda index=index: _picture(pictures.at(index), channels_first, f"{path}: {layout.images}[{index}]"),
                np.linalg.inv(pose) if layout.camera_to_world else pose,
                intrinsics(Ks[index], f"{path}: {layout.lens}[{index}]"),
                float(index),
                None if depth_at is None else lambda index=index: depth_at(index),
            )
        )
    return ImportedScene(layout.program, frames, gravity=False)


def _depths(
    path: Path, layout: Layout, names: set[str], shape: tuple[int, int, int]
) -> Callable[[int], np.ndarray] | None:
    """Return a function that reads the depth [H, W] of a frame by its index; None if the file holds none."""
    if layout.depth not in names:
        return None
    depths = _InOrder(_maps(path, layout.depth, shape))
    sureness = _InOrder(_maps(path, layout.confidence, shape)) if layout.confidence in names else None

    def at(index: int) -> np.ndarray:
        depth = _floats(depths.at(index)).reshape(shape[1:])
        if sureness is None:
            return depth
        confidence = _floats(sureness.at(index)).reshape(shape[1:])
        return surer(depth, confidence, f"{path}: {layout.confidence}[{index}]")

    return at


def _maps(path: Path, name: str, shape: tuple[int, int, int]) -> Stack:
    """Open an array [N, H, W], perhaps with a further axis of length 1."""
    stack = Stack(path, name)
    if tuple(side for side in stack.shape[1:] if side != 1) != shape[1:] or stack.shape[0] != shape[0]:
        raise UserError(
            f"{path}: {name} is {list(stack.shape)}, which does not fit {shape[0]} images of {shape[2]} x {shape[1]} "
            "pixels; export it again"
        )
    return stack


def _image_size(images: Stack) -> tuple[int, int, bool]:
    """Return height, width, and whether the channels come first."""
    path, name, shape = images.path, images.member, images.shape
    if len(shape) == 4 and shape[3] == 3:
        height, width, first = shape[1], shape[2], False
    elif len(shape) == 4 and shape[1] == 3:
        height, width, first = shape[2], shape[3], True
    else:
        raise UserError(f"{path}: {name} is {list(shape)}, not [N, H, W, 3] or [N, 3, H, W]; export it again")
    if images.kind.kind != "f" and images.kind != np.uint8:
        raise UserError(f"{path}: {name} holds {images.kind}, not bytes or numbers in [0, 1]; export it again")
    if min(height, width) < SMALLEST:
        raise UserError(f"{path}: {name} are {width} x {height} pixels; export larger ones")
    return height, width, first


def _picture(values: np.ndarray, channels_first: bool, place: str) -> np.ndarray:
    """Return a picture [H, W, 3] uint8 of bytes, or of numbers in [0, 1]; ``place`` names it in an error."""
    image = np.moveaxis(values, 0, 2) if channels_first else values
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    finite = np.nan_to_num(_floats(image), nan=0.0, posinf=1.0, neginf=0.0)
    least, most = float(finite.min()), float(finite.max())
    if least < -OVERSHOOT or most > 1.0 + OVERSHOOT:
        raise UserError(f"{place} goes from {least:g} to {most:g}; export bytes, or numbers in [0, 1]")
    return np.ascontiguousarray(np.rint(finite.clip(0.0, 1.0) * 255.0).astype(np.uint8))


def _floats(values: np.ndarray) -> np.ndarray:
    """Convert to float64."""
    with np.errstate(invalid="ignore"):  # signalling NaN would warn
        return values.astype(np.float64)


class _InOrder:
    """Frames of a stack by their index; asked for in ascending order, each is read once."""

    def __init__(self, stack: Stack) -> None:
        self._stack = stack
        self._next = 0
        self._frames: Iterator[np.ndarray] | None = None
        self._last: np.ndarray | None = None

    def at(self, index: int) -> np.ndarray:
        """Return a frame."""
        if self._frames is None or index < self._next - 1:
            self._frames, self._next, self._last = self._stack.frames(), 0, None
        while self._next <= index:
            self._last = next(self._frames)
            self._next += 1
        assert self._last is not None
        return self._last
