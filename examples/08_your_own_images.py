"""Your own images and cameras: the smallest data set that trains.

The script writes images with known cameras and times into a folder in D-NeRF layout. It renders them from a trained
scene; put your own in their place. Three things matter: the file names, the times from 0 to 1, and the matrix of a
frame, which is camera-to-world with OpenGL's axes (x right, y up, z backwards).

    python examples/01_train_builtin.py
    python examples/08_your_own_images.py
    python apps/train.py --data data/mine
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image

import scgs_warp
from scgs_warp.data import load
from scgs_warp.geometry.cameras import orbit_camera

OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def main(run: Path = Path("runs/example"), output: Path = Path("data/mine"), frames: int = 40, size: int = 200) -> None:
    """Write a data set.

    Args:
        run: folder of the run from which the images are rendered.
        output: folder to create.
        frames: number of training images; a fifth as many are held out.
        size: longer side in pixels.
    """
    scene = scgs_warp.Scene.load(run)
    for split, count in (("train", frames), ("test", max(1, frames // 5))):
        (output / split).mkdir(parents=True)
        listed, angle = [], 0.0
        for index in range(count):
            time = index / max(count - 1, 1)
            camera = orbit_camera(scene.overview, 137.5 * index, size, elevation=10.0 + 30.0 * (index % 2))
            image = scene.render(camera, time, background=(0.0, 0.0, 0.0))
            color = image.rgb / image.alpha.clamp_min(1e-3)[:, :, None]  # a PNG's colour is not multiplied by its alpha
            pixels = torch.cat([color, image.alpha[:, :, None]], dim=2).clamp(0.0, 1.0) * 255.0
            Image.fromarray((pixels + 0.5).byte().numpy()).save(output / split / f"{index:03d}.png")
            pose = np.linalg.inv(camera.viewmat.double().numpy()) @ OPENCV_TO_OPENGL
            listed.append({"file_path": f"{split}/{index:03d}", "time": time, "transform_matrix": pose.tolist()})
            angle = 2.0 * math.atan(camera.width / (2.0 * float(camera.K[0, 0])))
        content = json.dumps({"camera_angle_x": angle, "frames": listed}, indent=1)
        (output / f"transforms_{split}.json").write_text(content)
    data = load(output, "train")  # reads it as train.py will
    print(f"{output}: {len(data)} frames of {data[0].camera.width} x {data[0].camera.height}")


if __name__ == "__main__":
    tyro.cli(main)
