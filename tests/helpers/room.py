"""A furnished room with patterned walls, filmed by a camera on a known path while something moves in it.

``python tests/helpers/room.py --output room.mp4 --frames 240 --size 640 480`` makes a film for ``apps/capture.py``,
and beside it the true cameras and the pixels that show what moves (``room.npz``).
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # when run as a program

import cv2
import numpy as np
import torch

from helpers.gltf_files import Glb

SIZE = np.array([6.0, 3.0, 5.0])
"""Width, height and depth, glTF's axes (y up); the floor is at y = 0 and the middle at x = z = 0."""
FURNITURE = (
    ((-1.9, 0.5, -1.6), (0.5, 0.5, 0.4)),
    ((1.7, 0.8, -1.5), (0.4, 0.8, 0.4)),
    ((0.1, 0.25, -1.2), (0.7, 0.25, 0.4)),
    ((2.3, 0.4, 0.4), (0.35, 0.4, 0.5)),
    ((-2.4, 0.9, 0.3), (0.3, 0.9, 0.3)),
)
"""Centre and half the size of each box."""
FACES = ((0, 1), (0, -1), (1, 1), (1, -1), (2, 1), (2, -1))
"""Axis and side of a box."""
TEXELS = 80
"""Per metre."""


class Film(NamedTuple):
    frames: list[np.ndarray]
    """[H, W, 3] uint8 RGB"""
    centres: np.ndarray
    """[V, 3] of the cameras, world."""
    viewmats: np.ndarray
    """[V, 4, 4] world-to-camera, OpenCV."""
    K: np.ndarray
    """[3, 3]"""
    moving: list[np.ndarray]
    """[H, W] bool: pixels that show the moving box."""


def pattern(rng: np.random.Generator, height: int, width: int, contrast: float = 1.0) -> np.ndarray:
    """[height, width, 3] uint8: blots of all sizes in many colours, sharp-edged like wallpaper and posters."""
    image = np.full((height, width, 3), rng.integers(60, 200, 3), np.uint8)
    for _ in range(height * width // 150):
        color = [int(c) for c in rng.integers(0, 256, 3)]
        centre = int(rng.integers(0, width)), int(rng.integers(0, height))
        reach = int(24 * rng.uniform() ** 2) + 2
        if rng.uniform() < 0.5:
            cv2.circle(image, centre, reach, color, -1, cv2.LINE_AA)
        else:
            corners = np.array(centre) + rng.integers(-reach, reach + 1, (4, 2))
            cv2.fillConvexPoly(image, cv2.convexHull(corners.astype(np.int32)), color, cv2.LINE_AA)
    mean = image.mean((0, 1))
    return np.rint(mean + contrast * (image - mean)).clip(0, 255).astype(np.uint8)


def _square(axis: int, side: int, centre: np.ndarray, half: np.ndarray) -> np.ndarray:
    """[4, 3] corners of one side of a box."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    corners = np.tile(centre, (4, 1))
    corners[:, axis] += side * half[axis]
    corners[:, u] += np.array([-1, 1, 1, -1]) * half[u]
    corners[:, v] += np.array([-1, -1, 1, 1]) * half[v]
    return corners


def _box(glb: Glb, rng: np.random.Generator, centre: np.ndarray, half: np.ndarray, contrast: float) -> int:
    """A mesh of six patterned sides, seen from within and without; the pattern's grain is the same on all."""
    primitives = []
    for axis, side in FACES:
        u, v = (axis + 1) % 3, (axis + 2) % 3
        rows, columns = (max(8, round(2 * TEXELS * half[k])) for k in (v, u))
        texture = glb.add("textures", source=glb.image(pattern(rng, rows, columns, contrast)))
        pbr = {"baseColorTexture": {"index": texture}}
        extension = {"KHR_materials_unlit": {}}
        material = glb.add("materials", pbrMetallicRoughness=pbr, doubleSided=True, extensions=extension)
        uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        corners = _square(axis, side, centre, half)
        primitives.append(glb.primitive(corners, [[0, 1, 2], [0, 2, 3]], TEXCOORD_0=glb.array(uv), material=material))
    return glb.add("meshes", primitives=primitives)


def room(seed: int = 0, contrast: float = 1.0) -> Glb:
    """Walls and furniture at rest; a box that crosses the room and turns. ``contrast`` 0: bare walls."""
    rng = np.random.default_rng(seed)
    glb = Glb()
    half = SIZE / 2
    meshes = [_box(glb, rng, np.array([0.0, half[1], 0.0]), half, contrast)]
    meshes += [_box(glb, rng, np.array(centre), np.array(size), contrast) for centre, size in FURNITURE]
    mover = _box(glb, rng, np.zeros(3), np.array([0.28, 0.45, 0.22]), contrast)
    glb.document["nodes"] = [{"children": list(range(1, len(meshes) + 2))}]
    glb.document["nodes"] += [{"mesh": mesh} for mesh in meshes] + [{"mesh": mover}]
    clip = glb.clip("Cross")
    times = np.linspace(0.0, 1.0, 33)
    across, up, along = 1.5 * np.cos(2.6 * times + 0.4), 0.25 * np.sin(9 * times), 0.5 * np.sin(5 * times)
    path = np.stack([across, 0.9 + up, along - 0.4], 1)
    turns = np.stack([0 * times, np.sin(2.5 * times), 0 * times, np.cos(2.5 * times)], 1)
    glb.animate(clip, len(meshes) + 1, "translation", times, path)
    glb.animate(clip, len(meshes) + 1, "rotation", times, turns)
    return glb


def walk(time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera's position and target, glTF's axes: a sweeping arc through the near half of the room."""
    eye = np.array([1.9 * np.sin(2.2 * (time - 0.5)), 1.5 + 0.35 * np.sin(6 * time), 2.0 - 0.5 * np.sin(3 * time)])
    target = np.array([0.35 * np.sin(2.0 * time), 0.9, -1.3])
    return eye, target


def _viewmat(world_from_gltf: np.ndarray, eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    scale = np.cbrt(np.linalg.det(world_from_gltf[:3, :3]))
    forward = target - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    axes = world_from_gltf[:3, :3] / scale @ np.stack([right, np.cross(forward, right), forward], axis=1)
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = axes
    camera_to_world[:3, 3] = world_from_gltf[:3, :3] @ eye + world_from_gltf[:3, 3]
    return np.linalg.inv(camera_to_world)


def shoot(
    count: int, width: int = 320, height: int = 240, *, samples: int = 2, contrast: float = 1.0, seed: int = 0
) -> Film:
    """Film the room: ``count`` frames while time goes from 0 to 1."""
    from scgs_warp.data.gltf.scene import read_scene
    from scgs_warp.data.synthetic.mesh import MeshSubject, Shading
    from scgs_warp.types import Camera

    with tempfile.TemporaryDirectory() as folder:
        scene = read_scene(room(seed, contrast).save(Path(folder) / "room.glb"))
    subject = MeshSubject(scene, (0.0, 1.0), Shading(unlit=True))
    bodies = (len(FURNITURE) + 1) * len(FACES) * 2  # triangles of what stands still come first
    K = np.array([[0.85 * width, 0.0, width / 2], [0.0, 0.85 * width, height / 2], [0.0, 0.0, 1.0]])
    frames, viewmats, moving = [], [], []
    for index in range(count):
        time = index / max(count - 1, 1)
        viewmat = _viewmat(scene.world_from_gltf, *walk(time))
        camera = Camera(torch.from_numpy(viewmat).float(), torch.from_numpy(K).float(), width, height)
        picture = subject.render(subject.pose(time), camera, samples).cpu().numpy()[..., :3]
        frames.append(np.rint(picture.clip(0, 1) * 255).astype(np.uint8))
        viewmats.append(viewmat)
        moving.append(_moving(scene, time, viewmat, K, (width, height), bodies))
    views = np.stack(viewmats)
    centres = -np.einsum("vji,vj->vi", views[:, :3, :3], views[:, :3, 3])
    return Film(frames, centres, views, K, moving)


def _moving(scene, time: float, viewmat: np.ndarray, K: np.ndarray, size: tuple[int, int], bodies: int) -> np.ndarray:
    """Return the pixels inside the moving box's outline; furniture in front of it is ignored."""
    corners = scene.posed(time).positions[np.unique(scene.triangles.faces[bodies:])]
    local = corners @ viewmat[:3, :3].T + viewmat[:3, 3]
    pixels = local @ K.T
    mask = np.zeros((size[1], size[0]), np.uint8)
    if (local[:, 2] > 1e-3).all():
        hull = cv2.convexHull((pixels[:, :2] / pixels[:, 2:]).astype(np.float32))
        cv2.fillConvexPoly(mask, np.rint(hull).astype(np.int32), 1)
    return mask.astype(bool)


def path_length(centres: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())


def save(film: Film, path: Path, fps: float = 30.0) -> Path:
    from scgs_warp.visualization.video import film as writer

    with writer(path, fps) as out:
        for frame in film.frames:
            out.write(frame)
    return path


def main() -> None:
    import argparse

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("room.mp4"))
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480))
    options = parser.parse_args()
    made = shoot(options.frames, *options.size)
    save(made, options.output)
    moving = np.packbits(np.stack(made.moving), axis=-1)
    np.savez_compressed(
        options.output.with_suffix(".npz"), centres=made.centres, viewmats=made.viewmats, K=made.K, moving=moving
    )
    share = np.mean([mask.mean() for mask in made.moving])
    print(f"{options.output}: {options.frames} frames; {100 * share:.0f} % of the pixels move")


if __name__ == "__main__":
    main()
