"""Data sets rendered from moving subjects: pictures in the D-NeRF layout, with the true motion of their surface.

A ``Subject`` poses and renders itself; it is the built-in figure (``builtin``) or a glTF file (``mesh``). This file
lets the subject render the planned pictures, and writes the folder that a reader expects.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import cv2
import numpy as np
import torch
from torch import Tensor

from ...types import Camera
from .orbit_cameras import PlannedPicture, camera_of

ROOM_RADIUS = 1.3
"""World radius of the ball around the origin that contains a subject at all times, as in D-NeRF's scenes."""
SURFACE_POINTS = 2000
GROUND_TRUTH_TIMES = 51

Background = Literal["transparent", "black", "white"]


class Subject(Protocol):
    """A moving subject. Times are in [0, 1]; the subject stays inside the ball of radius ``ROOM_RADIUS`` (world, z
    up)."""

    device: str

    def pose(self, time: float) -> Any:
        """Pose the subject for the methods below; the result has an attribute ``vertices`` [P, 3]."""
        ...

    def render(self, posed: Any, camera: Camera, samples: int) -> Tensor:
        """Render [H, W, 4] premultiplied colour and coverage in [0, 1] with ``samples`` x ``samples`` rays per
        pixel."""
        ...

    def visible(self, posed: Any, camera: Camera, points: Tensor) -> Tensor:
        """Return [P] bool, True for surface points [P, 3] that the camera sees."""
        ...

    def sample(self, count: int, rng: np.random.Generator) -> Any:
        """Sample surface points evenly by area, in the form that ``track`` accepts."""
        ...

    def track(self, points: Any, times: Sequence[float]) -> np.ndarray:
        """Return world positions [T, P, 3] float64 of surface points."""
        ...


class SurfacePoints(NamedTuple):
    """Points attached to triangles of a mesh."""

    face: np.ndarray
    """[P] index of the triangle."""
    shares: np.ndarray
    """[P, 3] barycentric coordinates; rows sum to 1."""


@dataclass(frozen=True)
class Optics:
    """Camera and output settings common to all pictures of a scene."""

    fov: float
    """Horizontal field of view, radians."""
    width: int
    height: int
    samples: int
    """Number of rays per pixel along each axis."""
    background: Background = "transparent"


def pick_on_triangles(
    corners: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sample points evenly by area over triangles [F, 3, 3]: return triangles [P] and coordinates u, v, each [P, 1].

    The point in triangle a, b, c is ``a + u (b - a) + v (c - a)``.
    """
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    cumulative = np.cumsum(areas / areas.sum())
    steps = (np.arange(count) + rng.uniform(size=count)) / count
    face = np.minimum(np.searchsorted(cumulative, steps), len(areas) - 1)
    u, v = rng.uniform(size=(2, count, 1))
    flip = u + v > 1.0
    return face, np.where(flip, 1.0 - u, u), np.where(flip, 1.0 - v, v)


def points_on_triangles(
    positions: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator
) -> SurfacePoints:
    """Sample points evenly by area over a mesh of vertices [P, 3] and triangles [F, 3]."""
    face, u, v = pick_on_triangles(positions[faces], count, rng)
    return SurfacePoints(face, np.concatenate([1.0 - u - v, u, v], axis=1))


def write_rgba(path: Path, image: np.ndarray) -> None:
    """Write a premultiplied picture [H, W, 4] in [0, 1] as an 8-bit PNG with straight alpha.

    Raises:
        OSError: the file cannot be written.
    """
    alpha = image[..., 3:]
    color = np.where(alpha > 0, image[..., :3] / np.maximum(alpha, 1e-6), 0.0)
    pixels = np.concatenate([color, alpha], axis=-1).clip(0.0, 1.0) * 255.0
    write_png(path, np.rint(pixels).astype(np.uint8))


def over_gray(image: np.ndarray, gray: float) -> np.ndarray:
    """Composite a premultiplied picture [H, W, 4] on grey; return [H, W, 3]."""
    return image[..., :3] + (1.0 - image[..., 3:]) * gray


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write [H, W, 3] uint8 RGB, or [H, W, 4] with straight alpha; raise OSError if that fails. The compression is
    OpenCV's own, on which the bytes of a data set depend."""
    swapped = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR if pixels.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)
    ok, data = cv2.imencode(".png", swapped)
    if not ok:
        raise OSError(0, "PNG encoding failed")
    path.write_bytes(data.tobytes())


def write_picture(path: Path, image: np.ndarray, background: Background) -> None:
    """Write a premultiplied picture [H, W, 4]: with its alpha, or composited on the background and without alpha."""
    if background == "transparent":
        write_rgba(path, image)
        return
    pixels = over_gray(image, 1.0 if background == "white" else 0.0).clip(0.0, 1.0) * 255.0
    write_png(path, np.rint(pixels).astype(np.uint8))


class Watcher(Protocol):
    """Callback that receives each picture after it is rendered."""

    def __call__(
        self, split: str, index: int, planned: PlannedPicture, camera: Camera, image: np.ndarray, seen: Any
    ) -> None: ...


def write_pictures(
    folder: Path,
    subject: Subject,
    points: Any,
    pictures: Mapping[str, Sequence[PlannedPicture]],
    optics: Optics,
    done: Callable[[], None],
    watch: Watcher | None = None,
) -> None:
    """Render and write ``SPLIT/r_000.png`` and ``transforms_SPLIT.json`` of every split, and ``ground_truth.npz``.

    Args:
        points: surface points from ``subject.sample``; their visibility is recorded for the training pictures.
        done: called after each picture.
        watch: receives each picture; ``seen`` is (positions [P, 3], visible [P]) for training pictures, else None.

    Raises:
        OSError: a file cannot be written.
    """
    visible = []
    for split, split_pictures in pictures.items():
        (folder / split).mkdir()
        entries, time, posed = [], float("nan"), None
        for index, planned in enumerate(split_pictures):
            if planned.time != time:
                time, posed = planned.time, subject.pose(planned.time)
            camera = camera_of(planned.camera_to_world, optics.fov, optics.width, optics.height)
            image = subject.render(posed, camera, optics.samples).cpu().numpy()
            name = f"{split}/r_{index:03d}"
            write_picture(folder / f"{name}.png", image, optics.background)
            seen = None
            if split == "train":
                places = subject.track(points, [time])[0]
                tensor = torch.from_numpy(places.astype(np.float32)).to(subject.device)
                seen = places, subject.visible(posed, camera, tensor).cpu().numpy()
                visible.append(seen[1])
            entries.append(
                {"file_path": f"./{name}", "time": time, "transform_matrix": planned.camera_to_world.tolist()}
            )
            if watch is not None:
                watch(split, index, planned, camera, image, seen)
            done()
        content = {"camera_angle_x": optics.fov, "frames": entries}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    times = np.linspace(0.0, 1.0, GROUND_TRUTH_TIMES)
    np.savez(
        folder / "ground_truth.npz",
        points=subject.track(points, times.tolist()).astype(np.float32),
        times=times.astype(np.float32),
        visible=np.stack(visible),
        height=np.float32(subject_height(subject)),
    )


def subject_height(subject: Subject) -> float:
    """Return the extent along z at time 0; for a subject that lies flat, its largest extent."""
    vertices = subject.pose(0.0).vertices.cpu().numpy()
    extent = vertices.max(0) - vertices.min(0)
    return extent[2] if extent[2] > 0.05 * extent.max() else extent.max()
