"""Scenes in one ``.npz`` with images, depth, intrinsics and poses: MegaSaM's, VGGT's, MapAnything's, Depth Anything
3's, SpatialTrackerV2's.

MegaSaM (``NAME_sgd_cvd_hr.npz``, ``NAME_droid.npz``): ``images [N, H, W, 3]`` bytes, ``depths [N, H, W]``, ``intrinsic
[3, 3]``, ``cam_c2w [N, 4, 4]`` camera-to-world. VGGT (``predictions.npz`` of its demo): ``images [N, 3, H, W]`` in [0,
1], ``depth [N, H, W, 1]``, ``depth_conf [N, H, W]``, ``intrinsic [N, 3, 3]``, ``extrinsic [N, 3, 4]`` world-to-camera,
perhaps ``world_points [N, H, W, 3]``. MapAnything (``predictions.npz`` of its demo): as VGGT, but images ``[N, H, W,
3]``, ``conf``, and ``extrinsic [N, 4, 4]`` camera-to-world. Depth Anything 3 (format ``npz``): ``image [N, H, W, 3]``
bytes, ``depth``, ``conf [N, H, W]``, ``intrinsics [N, 3, 3]``, ``extrinsics [N, 3, 4]`` world-to-camera;
``predictions.npz`` of its app calls the first two ``images`` and ``depths``. SpatialTrackerV2 (``result.npz``): ``video
[N, 3, H, W]`` in [0, 1], ``depths``, ``unc_metric [N, H, W]`` (a confidence), ``intrinsics [N, 3, 3]``, ``extrinsics
[N, 4, 4]`` world-to-camera. Scenes of DUSt3R, which has no file of its own, fit if they are saved under MegaSaM's
names. Cameras are OpenCV's.
Layouts: Li et al., MegaSaM, CVPR 2025; Wang et al., VGGT, CVPR 2025; Keetha et al., MapAnything, 2025; Lin et al.,
Depth Anything 3, 2025; Xiao et al., SpatialTrackerV2, ICCV 2025.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...data.dataset import spread
from ...errors import UserError
from ...storage.numpy_files import read_npy
from .scene import ImportedFrame, ImportedScene, intrinsics, rigid, surer
from .stacks import InOrder, Stack, floats, image_size, members, open_maps, picture


class Layout(NamedTuple):
    """Names of the arrays of one program."""

    program: str
    poses: str
    """Name of the array of poses."""
    camera_to_world: bool
    images: str
    depth: str
    lens: str
    confidence: str
    """Empty if there is none."""


LAYOUTS = (
    Layout("MegaSaM", "cam_c2w", True, "images", "depths", "intrinsic", ""),
    Layout("VGGT", "extrinsic", False, "images", "depth", "intrinsic", "depth_conf"),
    Layout("MapAnything", "extrinsic", True, "images", "depth", "intrinsic", "conf"),
    Layout("Depth Anything 3", "extrinsics", False, "image", "depth", "intrinsics", "conf"),
    Layout("Depth Anything 3", "extrinsics", False, "images", "depths", "intrinsics", "conf"),
    Layout("SpatialTrackerV2", "extrinsics", False, "video", "depths", "intrinsics", "unc_metric"),
)
POINTS = "world_points"
"""Name of the array of the points that the pixels show, [N, H, W, 3] in the world, which VGGT and MapAnything write."""
COMPARED = 4
"""Number of frames whose points tell the direction of the poses."""
FAR_BETTER = 0.5
"""Largest ratio of the errors of the two directions at which the points overrule the direction of the program."""


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
    layout = max(posed, key=lambda layout: len(names.intersection(layout)))
    for name, what in ((layout.images, "images"), (layout.lens, "intrinsics")):
        if name not in names:
            raise UserError(f"{path}: holds no {what} ({name}), which {layout.program} writes; export it again")
    images = Stack(path, layout.images)
    height, width, channels_first = image_size(images)
    count = images.shape[0]
    poses, K = read_npy(path, layout.poses), read_npy(path, layout.lens)
    if poses.ndim != 3 or len(poses) != count:
        raise UserError(f"{path}: {layout.poses} is {list(poses.shape)}, but there are {count} images; export it again")
    if K.shape not in ((3, 3), (count, 3, 3)):
        raise UserError(f"{path}: {layout.lens} is {list(K.shape)}, not [3, 3] or [{count}, 3, 3]; export it again")
    Ks = np.broadcast_to(K, (count, 3, 3))
    pictures, depth_at = InOrder(images), _depths(path, layout, names, (count, height, width))
    frames = []
    rigids = [rigid(poses[index], f"{path}: {layout.poses}[{index}]") for index in range(count)]
    camera_to_world = layout.camera_to_world
    if POINTS in names and depth_at is not None:
        camera_to_world = _camera_to_world(path, layout, rigids, Ks, depth_at, (height, width))
    for index, pose in enumerate(rigids):
        frames.append(
            ImportedFrame(
                lambda index=index: picture(pictures.at(index), channels_first, f"{path}: {layout.images}[{index}]"),
                np.linalg.inv(pose) if camera_to_world else pose,
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
    depths = InOrder(open_maps(path, layout.depth, shape))
    sureness = InOrder(open_maps(path, layout.confidence, shape)) if layout.confidence in names else None

    def at(index: int) -> np.ndarray:
        depth = floats(depths.at(index)).reshape(shape[1:])
        if sureness is None:
            return depth
        confidence = floats(sureness.at(index)).reshape(shape[1:])
        return surer(depth, confidence, f"{path}: {layout.confidence}[{index}]")

    return at


def _camera_to_world(
    path: Path,
    layout: Layout,
    poses: list[np.ndarray],
    Ks: np.ndarray,
    depth_at: Callable[[int], np.ndarray],
    size: tuple[int, int],
) -> bool:
    """Return whether the poses are camera-to-world. Programs built on VGGT write its arrays with either direction; the
    points that the file also holds tell which: they lie where depth and pose put the pixels.

    Args:
        poses: [4, 4] each.
        size: height and width of the images.
    """
    stack = Stack(path, POINTS)
    if stack.shape != (len(poses), *size, 3):
        return layout.camera_to_world
    points = InOrder(stack)
    x, y = np.meshgrid(np.arange(size[1]) + 0.5, np.arange(size[0]) + 0.5)
    errors = {True: 0.0, False: 0.0}
    for index in spread(len(poses), COMPARED):
        depth, given = depth_at(index), floats(points.at(index))
        known = np.isfinite(depth) & (depth > 0.0) & np.isfinite(given).all(axis=-1)
        if known.any():
            local = (
                np.stack([x, y, np.ones_like(x)], axis=-1)[known] @ np.linalg.inv(Ks[index]).T * depth[known][:, None]
            )
            for forth in errors:
                pose = poses[index] if forth else np.linalg.inv(poses[index])
                away = np.linalg.norm(local @ pose[:3, :3].T + pose[:3, 3] - given[known], axis=-1)
                errors[forth] += float(np.median(away))
    other = not layout.camera_to_world
    return other if errors[other] < FAR_BETTER * errors[layout.camera_to_world] else layout.camera_to_world
