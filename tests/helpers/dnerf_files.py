"""A tiny data set in the D-NeRF layout, of random pixels."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image as PillowImage

WIDTH, HEIGHT = 24, 16
IDENTITY = [[1, 0, 0, 0.5], [0, 1, 0, 0.25], [0, 0, 1, 4], [0, 0, 0, 1]]


def write_scene(folder: Path, frames: int = 3, mode: str = "RGBA", seed: int = 0, **fields) -> list[np.ndarray]:
    """A tiny valid data set of random pixels, whose first frame is the test frame, too; returns the images."""
    rng = np.random.default_rng(seed)
    (folder / "train").mkdir(parents=True)
    images, entries = [], []
    for index in range(frames):
        pixels = rng.integers(0, 256, (HEIGHT, WIDTH, len(mode)), dtype=np.uint8)
        PillowImage.fromarray(pixels).save(folder / f"train/r_{index:03d}.png")
        images.append(pixels)
        time = index / max(frames - 1, 1)
        entries.append({"file_path": f"./train/r_{index:03d}", "time": time, "transform_matrix": IDENTITY})
    content = {"camera_angle_x": 0.8, "frames": entries, **fields}
    (folder / "transforms_train.json").write_text(json.dumps(content))
    (folder / "transforms_test.json").write_text(json.dumps({**content, "frames": entries[:1]}))
    return images


HUGE = "a number of 5,000 digits"
"""Python refuses to read such a number, and to write it."""


def edit(folder: Path, change) -> None:
    path = folder / "transforms_train.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content).replace(f'"{HUGE}"', "9" * 5_000))
