"""Reader of the nerfstudio layout: one ``transforms.json`` for all frames, with intrinsics, poses, and maybe points.

``fl_x, fl_y, cx, cy, w, h`` (pixels; for all frames or in each), per frame ``file_path``, ``transform_matrix``
(camera-to-world, OpenGL), ``time`` in [0, 1] and ``mask_path``; ``ply_file_path``, sparse points in the frame of the
poses; ``train_filenames``, ``val_filenames``, ``test_filenames``. Layout: Tancik et al., Nerfstudio, SIGGRAPH 2023.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import UserError
from ..types import Camera, Frame
from .borders import border_mask, reduce_mask
from .dataset import Dataset, spread
from .images import Decoded, decode, is_transparent, parallel_map, read_image, without_idle_alpha
from .transforms import (
    check_distortion,
    find_image,
    make_camera,
    read_intrinsics,
    read_pose,
    read_times,
    read_transforms,
    size_text,
)

FILE = "transforms.json"
HELD_OUT_EVERY = 8
HELD_OUT_FIRST = 4
"""Without lists, frames 4, 12, 20, ... are held out: never the first, so that nothing has to be extrapolated."""
BORDER_FRAMES = 24
"""At most so many frames, spread over the video, are looked at for a border: all of them are in memory at once."""


def recognises(folder: Path) -> bool:
    """Whether the folder holds this layout."""
    return (folder / FILE).is_file()


def read(
    folder: Path,
    split: str,
    *,
    downscale: float = 1,
    resample: str = "area",
    background: str = "black",
    progress: Callable[[int, int], None] | None = None,
) -> Dataset:
    """Read one split.

    Frames without a time are taken to be evenly spaced in the order of their names (9 before 10). Without lists of
    files every eighth frame is held out, for ``test`` and ``val`` alike; with lists that leave out one of these two, or
    leave it empty, it is the other. A frame's mask is False where ``mask_path`` is black, and on borders that
    undistortion left.

    Args:
        progress: called with (done, total) after each decoded image.

    Raises:
        UserError: one line naming the file, the field and the remedy, for anything in the data that cannot be used.
    """
    path = folder / FILE
    content = read_transforms(path)
    entries = content["frames"]
    files = [find_image(path, folder, index, entry) for index, entry in enumerate(entries)]
    times = _times(path, entries, files)
    for described in (content, *entries):
        check_distortion(path, described)
    chosen = _chosen(path, content, files, split)
    border = _border(files, times)

    def load(index: int) -> tuple[Decoded, np.ndarray | None]:
        return read_image(files[index], downscale, resample, background), _mask(path, folder, index, entries[index])

    loaded = parallel_map(load, chosen, progress)
    images = without_idle_alpha([decoded for decoded, _ in loaded])
    first = images[0].source_size
    frames = []
    for index, decoded, (_, own) in zip(chosen, images, loaded):
        if decoded.source_size != first:
            raise UserError(
                f"{files[index]}: is {size_text(decoded.source_size)}, but {files[chosen[0]].name} is "
                f"{size_text(first)}; give all images of a split one size"
            )
        intrinsics = read_intrinsics(path, {**content, **entries[index]}, index, decoded.source_size)
        viewmat = read_pose(path, index, entries[index])
        camera = make_camera(viewmat, intrinsics, decoded.source_size, decoded.image)
        mask = _combined(files[index], None if decoded.alpha is not None else border, own, decoded)
        frames.append(Frame(camera, times[index], decoded.image, decoded.alpha, mask, name=files[index].stem))
    points, colors = _points(path, folder, content, [frame.camera for frame in frames])
    return Dataset(frames, folder=folder, split=split, background=background, points=points, colors=colors)


def _natural(text: str) -> list[tuple[int, str]]:
    """A key that sorts frame_9 before frame_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", text) if part]


def _times(path: Path, entries: list[dict[str, Any]], files: list[Path]) -> list[float]:
    if any("time" in entry for entry in entries):
        return read_times(path, entries)
    order = sorted(range(len(files)), key=lambda index: _natural(files[index].as_posix()))
    last = max(len(files) - 1, 1)
    times = [0.0] * len(files)
    for place, index in enumerate(order):
        times[index] = place / last
    return times


def _chosen(path: Path, content: dict[str, Any], files: list[Path], split: str) -> list[int]:
    """Indices of the frames of this split, in the order of the file."""
    lists = {name: content[f"{name}_filenames"] for name in ("train", "val", "test") if f"{name}_filenames" in content}
    for name in ("val", "test"):  # exporters write all three lists, whether or not they hold frames out twice
        if lists.get(name) == []:
            del lists[name]
    if not lists:
        order = sorted(range(len(files)), key=lambda index: _natural(files[index].as_posix()))
        held_out = set(order[min(HELD_OUT_FIRST, len(order) - 1) :: HELD_OUT_EVERY])
        chosen = [index for index in range(len(files)) if (index in held_out) != (split == "train")]
        if not chosen:
            raise UserError(f"{path}: one frame cannot be both trained on and held out; list at least two frames")
        return chosen
    substitute = {"val": "test", "test": "val"}.get(split, split)
    name = split if split in lists else substitute
    if name not in lists:
        raise UserError(f"{path}: {split}_filenames is missing while other splits are listed; list the files there")
    listed = lists[name]
    if not isinstance(listed, list) or not listed or not all(isinstance(item, str) for item in listed):
        raise UserError(f"{path}: {name}_filenames is empty or no list of file names; name at least one frame's file")
    known = {entry["file_path"]: index for index, entry in enumerate(content["frames"])}
    for item in listed:
        if item not in known:
            raise UserError(
                f"{path}: {name}_filenames names {item!r}, which no frame has as file_path; write it as the frame does"
            )
    return sorted({known[item] for item in listed})


def _border(files: list[Path], times: list[float]) -> np.ndarray | None:
    """[H, W] bool, False on the black border of the video, if it has one; the same whichever split is read."""
    order = sorted(range(len(files)), key=lambda index: times[index])
    looked_at = [files[order[place]] for place in spread(len(order), BORDER_FRAMES)]
    images = parallel_map(decode, [file for file in looked_at if file.is_file()])
    if any(is_transparent(image) for image in images):
        return None  # alpha says it better
    return border_mask([image[..., :3] for image in images])


def _mask(path: Path, folder: Path, index: int, entry: dict[str, Any]) -> np.ndarray | None:
    """[H, W] bool of the file's full size, True where the frame's own mask is not black."""
    if entry.get("mask_path") is None:
        return None
    name = entry["mask_path"]
    if not isinstance(name, str) or not name or "\0" in name:
        raise UserError(f"{path}: frames[{index}].mask_path is no text; name the mask's file or leave it out")
    pixels = decode(folder / name.replace("\\", "/"))
    mask = pixels[..., :3].max(axis=2) > 0
    if not mask.any():
        raise UserError(f"{folder / name}: a mask that is all black leaves nothing to look at; drop the frame")
    return mask


def _combined(file: Path, border: np.ndarray | None, own: np.ndarray | None, decoded: Decoded) -> Tensor | None:
    """[h, w] bool at the reduced size, True where both masks are; None where there is none.

    Raises:
        UserError: the mask has another size than the image, or no pixel is left.
    """
    width, height = decoded.source_size
    if own is not None and own.shape != (height, width):
        raise UserError(
            f"{file}: is {size_text(decoded.source_size)}, but its mask is {size_text(own.shape[::-1])}; "
            "give the mask the image's size"
        )
    masks = [mask for mask in (border, own) if mask is not None and mask.shape == (height, width)]
    if not masks:
        return None
    size = (decoded.image.shape[1], decoded.image.shape[0])
    mask = reduce_mask(np.logical_and.reduce(masks), size)
    if not mask.any():  # neither a step nor a score could say anything of such a frame
        raise UserError(
            f"{file}: no pixel is left by its mask, the video's border and the reduction to {size_text(size)}; "
            "correct mask_path, give a smaller downscale or drop the frame"
        )
    return torch.from_numpy(mask)


def _points(
    path: Path, folder: Path, content: dict[str, Any], cameras: list[Camera]
) -> tuple[Tensor | None, Tensor | None]:
    """Points [P, 3] in the frame of the poses and their colours [P, 3], where the file names any."""
    name = content.get("ply_file_path")
    if name is None:
        return None, None
    if not isinstance(name, str) or not name or "\0" in name:
        raise UserError(f"{path}: ply_file_path is no text; name the file of points or leave it out")
    points, colors = read_ply(folder / name.replace("\\", "/"))
    moved = _applied(path, content, points)
    # Writers disagree whether the transform that was applied to the poses was applied to the points, too.
    if moved is not None and _seen(moved, cameras) > _seen(points, cameras):
        points = moved
    kept = _finite(points)  # once more: the transform may have led beyond what float32 holds
    return torch.from_numpy(points[kept]).float(), None if colors is None else torch.from_numpy(colors[kept]).float()


def _applied(path: Path, content: dict[str, Any], points: np.ndarray) -> np.ndarray | None:
    """The points after ``applied_transform`` and ``applied_scale``; None where the file has neither."""
    if "applied_transform" not in content and "applied_scale" not in content:
        return None
    try:
        matrix = np.array(content.get("applied_transform", np.eye(4)), np.float64)
        scale = float(content.get("applied_scale", 1.0))
    except (ValueError, TypeError, OverflowError):
        matrix, scale = np.zeros(0), 0.0
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all() or not (np.isfinite(scale) and scale > 0):
        raise UserError(
            f"{path}: applied_transform must be 3 or 4 rows of 4 numbers, and applied_scale a positive number; "
            "correct them or leave them out"
        )
    return (points @ matrix[:3, :3].T + matrix[:3, 3]) * scale


def _seen(points: np.ndarray, cameras: list[Camera]) -> int:
    """In how many (point, camera) pairs the point falls into the image."""
    total = 0
    for camera in cameras:
        viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
        local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        ahead = local[local[:, 2] > 1e-9]
        pixels = ahead @ K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        total += int(((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1).sum())
    return total


def _finite(points: np.ndarray) -> np.ndarray:
    """[P] bool: which points [P, 3] float64 are finite in float32, as training takes them."""
    with np.errstate(over="ignore"):
        return np.all(np.isfinite(points.astype(np.float32)), axis=1)


def _unit_colors(vertices: np.ndarray) -> np.ndarray | None:
    """[P, 3] in [0, 1], grey where the file says nothing finite; None where it has no colours.

    Whole numbers are shares of their type's largest; others of 1, or of 255 where any is above 1.
    """
    names = ("red", "green", "blue")
    if not all(name in (vertices.dtype.names or ()) for name in names):
        return None
    raw = np.stack([np.asarray(vertices[name]) for name in names], axis=1)
    if np.issubdtype(raw.dtype, np.integer):
        return (raw / np.iinfo(raw.dtype).max).clip(0.0, 1.0)
    colors = raw.astype(np.float64)
    finite = np.isfinite(colors)
    most = 255.0 if (colors[finite] > 1.0).any() else 1.0
    return np.where(finite, colors / most, 0.5).clip(0.0, 1.0)


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Vertices [P, 3] float64 of a PLY file, and their colours [P, 3] in [0, 1] where it has some.

    Points that are not finite in float32 are left out.

    Raises:
        UserError: the file is missing, no PLY, has no vertices with x, y, z, or claims more than fit into memory.
    """
    from plyfile import PlyData, PlyParseError

    try:
        elements = PlyData.read(path)
        vertices = elements["vertex"].data
        points = np.stack([np.asarray(vertices[axis], np.float64) for axis in "xyz"], axis=1)
        colors = _unit_colors(vertices)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file, though ply_file_path names it; restore it or drop the field") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); make the file readable") from None
    except (PlyParseError, KeyError, ValueError, TypeError):
        raise UserError(f"{path}: no PLY file of vertices with x, y, z; export the points again") from None
    except (MemoryError, OverflowError):
        raise UserError(f"{path}: says it has more points than fit into memory; export the points again") from None
    kept = _finite(points)
    return points[kept], None if colors is None else colors[kept]
