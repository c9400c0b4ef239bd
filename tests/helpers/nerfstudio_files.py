"""Data sets in the nerfstudio layout, written here: a bright dot of its own colour where each point is."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import torch

from helpers.scenes import look_at

WIDTH, HEIGHT, FOCAL = 40, 30, 50.0


POINTS = np.random.default_rng(3).uniform(-0.6, 0.6, (60, 3))


COLORS = np.random.default_rng(4).integers(0, 256, (60, 3))


def viewmat(index: int) -> np.ndarray:
    angle = 0.1 * index
    eye = torch.tensor([4 * np.cos(angle), 4 * np.sin(angle), 1.0], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return look_at(eye, torch.zeros(3, dtype=torch.float64), up).numpy()


def write_ply(path: Path, points: np.ndarray, colors: np.ndarray | None, origin: np.ndarray | float = 0.0) -> None:
    points = points + origin
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")] if colors is not None else []
    rows = points if colors is None else np.hstack([points, colors])
    lines += ["end_header"] + [" ".join(f"{x:.16g}" for x in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")


def write(folder: Path, count: int = 20, **changes) -> dict:
    """A data set whose images have a bright dot of its own colour where each point is; returns the content."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for index in range(count):
        image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
        view = viewmat(index)
        for point, color in zip(POINTS, COLORS):
            x, y, z = view[:3, :3] @ point + view[:3, 3]
            column, row = int(FOCAL * x / z + WIDTH / 2), int(FOCAL * y / z + HEIGHT / 2)
            if 0 <= column < WIDTH and 0 <= row < HEIGHT:
                image[row, column] = color[::-1]
        cv2.imwrite(str(folder / f"f_{index}.png"), image)
        pose = np.linalg.inv(view) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"f_{index}.png", "transform_matrix": pose.tolist(), "time": index / (count - 1)})
    write_ply(folder / "points.ply", POINTS, COLORS)
    content = {"fl_x": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT, "k1": 0.0, "frames": frames}
    content |= {"ply_file_path": "points.ply", **changes}
    save(folder, content)
    return content


def save(folder: Path, content: dict) -> None:
    (folder / "transforms.json").write_text(json.dumps(content))


def rewrite(folder: Path, change, count: int = 20) -> None:
    """Every image of the folder becomes ``change(index, image)``."""
    for index in range(count):
        path = str(folder / f"f_{index}.png")
        cv2.imwrite(path, change(index, cv2.imread(path)))
