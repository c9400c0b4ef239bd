"""The built-in synthetic scene, written in the D-NeRF layout with the true motion beside it.

Monocular as D-NeRF is: each training frame has a time of its own and a camera of its own, drawn from the upper
hemisphere; test frames are spread over time and have other cameras. The same arguments give the same bytes.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from ..errors import UserError
from ..types import Camera
from .synthetic_figure import Figure, build_figure
from .synthetic_raycast import Raycaster

VERSION = 4
"""Raised whenever the scene's pictures or its ground truth change; folders of another version are made anew."""
MARKER = "synthetic.json"
RADIUS = 4.0311
FIELD_OF_VIEW = 0.6911112070083618
"""Radians, D-NeRF's camera_angle_x."""
SINE_OF_ELEVATION = (0.05, 0.85)
SURFACE_POINTS = 2000
TRUTH_TIMES = 51
SAMPLES = 4
"""Rays per pixel and axis."""


def make_synthetic(
    folder: str | Path,
    size: int = 400,
    train: int = 100,
    test: int = 20,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    device: str = "cpu",
) -> Path:
    """Make the scene in ``folder``, unless it is there already with these arguments.

    It is written to a temporary folder beside and renamed, so that an interrupted run leaves nothing half made.

    Args:
        size: width and height in pixels.
        train, test: number of frames, each with its own camera.
        seed: of the cameras and of the surface points.
        progress: called with (done, total) after each picture.
        device: where rays are cast, ``cpu`` or ``cuda``.

    Returns:
        The folder: ``transforms_{train,test}.json``, ``train/``, ``test/``, ``ground_truth.npz``, ``synthetic.json``.

    Raises:
        UserError: the folder holds something else, or cannot be written.
    """
    folder = Path(folder)
    if min(size, train, test) < 1 or train < 2:
        raise UserError(f"{folder}: size {size}, train {train}, test {test}; give a size and counts >= 1 (train >= 2)")
    recipe = {"version": VERSION, "size": size, "train": train, "test": test, "seed": seed}
    if _recipe_of(folder) == recipe:
        return folder
    _check_replaceable(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    except OSError as error:
        raise UserError(f"{folder}: cannot be made ({error.strerror}); choose a folder that can be written") from None
    try:
        _write_scene(work, recipe, progress, device)
        os.chmod(work, 0o755)  # mkdtemp's 0700 is for secrets
        _replace(folder, work)
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror}); make room or choose another folder") from None
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return folder


def _recipe_of(folder: Path) -> dict[str, Any] | None:
    try:
        return json.loads((folder / MARKER).read_text())
    except (OSError, ValueError):
        return None


def _check_replaceable(folder: Path) -> None:
    """Only a synthetic scene or an empty folder gives way."""
    if not folder.exists() or (folder.is_dir() and (_recipe_of(folder) is not None or not any(folder.iterdir()))):
        return
    raise UserError(f"{folder}: exists and holds no synthetic scene ({MARKER}); give another folder, or remove it")


def _replace(folder: Path, work: Path) -> None:
    if folder.exists():
        old = Path(tempfile.mkdtemp(prefix=f".{folder.name}-old-", dir=folder.parent))
        os.rename(folder, old / "scene")
        os.rename(work, folder)
        shutil.rmtree(old, ignore_errors=True)
    else:
        os.rename(work, folder)


def _write_scene(work: Path, recipe: dict[str, Any], progress: Callable[[int, int], None] | None, device: str) -> None:
    figure = build_figure()
    raycaster = Raycaster(figure, device)
    rng = np.random.default_rng(recipe["seed"])
    part, local = sample_surface(figure, SURFACE_POINTS, rng)
    total, done = recipe["train"] + recipe["test"], 0
    visible = np.zeros((recipe["train"], SURFACE_POINTS), bool)
    for split in ("train", "test"):
        (work / split).mkdir()
        entries = []
        count = recipe[split]
        for index in range(count):
            time = index / max(count - 1, 1)
            camera_to_world = random_camera(rng)
            camera = _camera(camera_to_world, recipe["size"])
            posed = raycaster.pose(time)
            image = raycaster.render(posed, camera, SAMPLES)
            write_rgba(work / split / f"r_{index:03d}.png", image.cpu().numpy())
            if split == "train":
                points = _track(raycaster, part, local, [time])[0]
                seen = raycaster.visible(posed, camera, torch.from_numpy(points.astype(np.float32)).to(device))
                visible[index] = seen.cpu().numpy()
            entries.append(
                {"file_path": f"./{split}/r_{index:03d}", "time": time, "transform_matrix": camera_to_world.tolist()}
            )
            done += 1
            if progress is not None:
                progress(done, total)
        content = {"camera_angle_x": FIELD_OF_VIEW, "frames": entries}
        (work / f"transforms_{split}.json").write_text(json.dumps(content, indent=1) + "\n")
    times = np.linspace(0.0, 1.0, TRUTH_TIMES)
    vertices = raycaster.pose(0.0).vertices.cpu().numpy()
    np.savez(
        work / "ground_truth.npz",
        points=_track(raycaster, part, local, times).astype(np.float32),
        times=times.astype(np.float32),
        visible=visible,
        height=np.float32(vertices[:, 2].max() - vertices[:, 2].min()),
    )
    (work / MARKER).write_text(json.dumps(recipe) + "\n")


def random_camera(rng: np.random.Generator) -> np.ndarray:
    """[4, 4] camera-to-world, OpenGL: on the upper hemisphere, evenly over its area, looking at the origin."""
    azimuth = rng.uniform(0.0, 2.0 * math.pi)
    z = rng.uniform(*SINE_OF_ELEVATION)
    flat = math.sqrt(1.0 - z * z)
    backward = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), z])
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(backward, right), backward], axis=1)
    matrix[:3, 3] = RADIUS * backward
    return matrix


def _camera(camera_to_world: np.ndarray, size: int) -> Camera:
    viewmat = np.linalg.inv(camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0]))
    focal = 0.5 * size / math.tan(0.5 * FIELD_OF_VIEW)
    K = torch.tensor([[focal, 0.0, 0.5 * size], [0.0, focal, 0.5 * size], [0.0, 0.0, 1.0]])
    return Camera(torch.from_numpy(viewmat).float(), K, size, size)


def sample_surface(figure: Figure, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly by area over all parts: part of each [P], position in that part's bone frame [P, 3].

    Some lie inside a neighbouring part, where no camera sees them; visibility tells.
    """
    corners = figure.local[figure.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    cumulative = np.cumsum(areas / areas.sum())
    steps = (np.arange(count) + rng.uniform(size=count)) / count
    face = np.minimum(np.searchsorted(cumulative, steps), len(areas) - 1)
    u, v = rng.uniform(size=(2, count, 1))
    flip = u + v > 1.0
    u, v = np.where(flip, 1.0 - u, u), np.where(flip, 1.0 - v, v)
    a, b, c = corners[face].transpose(1, 0, 2)
    return figure.face_part[face], a + u * (b - a) + v * (c - a)


def _track(raycaster: Raycaster, part: np.ndarray, local: np.ndarray, times) -> np.ndarray:
    """[T, P, 3] float64 world positions of surface points."""
    tracks = []
    for time in times:
        transforms = raycaster.part_transforms(float(time))[part]
        tracks.append(np.einsum("pij,pj->pi", transforms[:, :3, :3], local) + transforms[:, :3, 3])
    return np.stack(tracks)


def write_rgba(path: Path, image: np.ndarray) -> None:
    """Write premultiplied [H, W, 4] in [0, 1] as an 8-bit PNG, whose colour is not premultiplied.

    Raises:
        OSError: the file cannot be written.
    """
    alpha = image[..., 3:]
    color = np.where(alpha > 0, image[..., :3] / np.maximum(alpha, 1e-6), 0.0)
    pixels = np.concatenate([color, alpha], axis=-1).clip(0.0, 1.0) * 255.0
    ok, data = cv2.imencode(".png", cv2.cvtColor(np.rint(pixels).astype(np.uint8), cv2.COLOR_RGBA2BGRA))
    if not ok:
        raise OSError(0, "PNG encoding failed")
    path.write_bytes(data.tobytes())
