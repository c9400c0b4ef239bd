"""A ball that moves before a wall, in the layout of DyCheck's iPhone data: colours and depth by ray casting."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch

from helpers.layouts import save_image, save_json
from helpers.scenes import look_at

WIDTH, HEIGHT, FOCAL = 72, 96, 80.0
CENTRE = np.array([36.5, 47.0])
TIMES = 12
SCALE, ORIGIN = 0.25, np.array([0.5, -0.25, 1.0])
"""``scene.json``: the world of the file, in metres, is larger than that of the scene, and elsewhere."""
WALL, RADIUS = 2.0, 0.3
UNSEEN = 3
"""Columns at the left of a training image without LiDAR."""
HELD = {1: [time for time in range(TIMES) if time not in (3, 4)], 2: list(range(2, 10))}
"""Times at which the other cameras have an image: some have bad frames, others begin late."""
COVISIBLE_FROM = 20
"""First covisible column of a held-out image of full size."""


def viewmat(camera: int, time: int) -> np.ndarray:
    """[4, 4] world-to-camera, OpenCV: camera 0 walks, the others stand."""
    eyes = [[-0.5 + time / (TIMES - 1), 0.1, 0.0], [-0.7, 0.2, 0.1], [0.7, -0.2, 0.0]]
    eye, target, up = (torch.tensor(each, dtype=torch.float64) for each in (eyes[camera], [0.0, 0.0, 1.5], [0, -1, 0]))
    return look_at(eye, target, up.double()).numpy()


def ball_at(time: int) -> np.ndarray:
    return np.array([-0.4 + 0.8 * time / (TIMES - 1), 0.1, 1.3])


def _pattern(places: np.ndarray, seed: int) -> np.ndarray:
    """Colours in [0, 1] that change smoothly in space."""
    waves = np.random.default_rng(seed).normal(size=(3, 4, 3)) * 2.5
    return (0.5 + 0.12 * np.sin(np.einsum("...d,ckd->...ck", places, waves)).sum(-1)).clip(0.05, 0.95)


def shown(camera: int, time: int) -> tuple[np.ndarray, np.ndarray]:
    """Colours [H, W, 3] in [0, 1] and depth along z [H, W], in the units of the scene."""
    view = viewmat(camera, time)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    local = np.stack([(x - CENTRE[0]) / FOCAL, (y - CENTRE[1]) / FOCAL, np.ones_like(x)], -1)
    rays, eye = local @ view[:3, :3], -view[:3, :3].T @ view[:3, 3]
    depth = (WALL - eye[2]) / rays[..., 2]
    color = _pattern(eye + rays * depth[..., None], 1)
    offset = eye - ball_at(time)
    a, b, c = (rays**2).sum(-1), rays @ offset, offset @ offset - RADIUS**2
    root = b**2 - a * c
    near = (-b - np.sqrt(np.maximum(root, 0.0))) / a
    on_ball = (root > 0) & (near > 0) & (near < depth)
    depth = np.where(on_ball, near, depth)
    ball = _pattern(eye + rays * depth[..., None] - ball_at(time) + 5.0, 2)
    return np.where(on_ball[..., None], ball, color), depth


def write_dycheck(folder: Path, covisible: bool = True, depth: bool = True) -> None:
    """Write the data set, as DyCheck's own program does."""
    frames = [(0, time) for time in range(TIMES)] + [(camera, time) for camera, times in HELD.items() for time in times]
    names = {frame: f"{frame[0]}_{frame[1]:05d}" for frame in frames}
    for (camera, time), name in names.items():
        view = viewmat(camera, time)
        position = -view[:3, :3].T @ view[:3, 3] / SCALE + ORIGIN
        fields = {"focal_length": FOCAL, "image_size": [WIDTH, HEIGHT], "orientation": view[:3, :3].tolist()}
        fields |= {"pixel_aspect_ratio": 1.0, "position": position.tolist(), "principal_point": CENTRE.tolist()}
        fields |= {"radial_distortion": [0.0] * 3, "skew": 0.0, "tangential_distortion": [0.0, 0.0]}
        save_json(folder / f"camera/{name}.json", fields)
        color, distance = shown(camera, time)
        image = np.concatenate([np.round(color[..., ::-1] * 255), np.full((HEIGHT, WIDTH, 1), 255)], 2).astype(np.uint8)
        if camera == 0:
            image[:, :UNSEEN] = 0
            metres = np.where(np.arange(WIDTH) < UNSEEN, 0.0, distance / SCALE).astype(np.float32)[..., None]
            if depth:
                _save_array(folder / f"depth/1x/{name}.npy", metres)
                _save_array(folder / f"depth/2x/{name}.npy", metres[::2, ::2])
        elif covisible:
            mask = np.where(np.arange(WIDTH // 2) >= COVISIBLE_FROM // 2, 255, 0).astype(np.uint8)
            save_image(folder / f"covisible/2x/val/{name}.png", np.tile(mask, (HEIGHT // 2, 1)))
        save_image(folder / f"rgb/1x/{name}.png", image)
        half = cv2.resize(image, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA)
        half[..., 3] = np.where(half[..., 3] == 255, 255, 0)
        save_image(folder / f"rgb/2x/{name}.png", half)
    train, val = ([frame for frame in frames if (frame[0] == 0) == (split == "train")] for split in ("train", "val"))
    for split, chosen in (("train", train), ("val", val)):
        content = {"frame_names": [names[frame] for frame in chosen], "camera_ids": [frame[0] for frame in chosen]}
        save_json(folder / f"splits/{split}.json", {**content, "time_ids": [frame[1] for frame in chosen]})
    ids = {"train_ids": [names[frame] for frame in train], "val_ids": [names[frame] for frame in val]}
    save_json(
        folder / "dataset.json", {"count": len(frames), "num_exemplars": TIMES, "ids": list(names.values()), **ids}
    )
    metadata = {name: {"warp_id": time, "appearance_id": time, "camera_id": cam} for (cam, time), name in names.items()}
    save_json(folder / "metadata.json", metadata)
    save_json(folder / "scene.json", {"scale": SCALE, "center": ORIGIN.tolist(), "near": 0.5, "far": 4.0})
    extra = {"factor": 2, "fps": 30.0, "bbox": [[-1, -1, -1], [1, 1, 2]], "lookat": [0, 0, 1.5], "up": [0, -1, 0]}
    save_json(folder / "extra.json", extra)
    np.save(folder / "points.npy", np.array([[0.0, 0.0, WALL], [0.5, 0.5, WALL]]) / SCALE + ORIGIN)


def _save_array(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, values)
