"""Render a trained scene: any moment, any camera.

The script writes a strip of moments from one camera, colours above depth. Times run from 0 to 1. A camera has a
world-to-camera matrix in OpenCV's convention and intrinsics in pixels.

    python examples/01_train_builtin.py
    python examples/02_render_at_time.py
    python examples/02_render_at_time.py --run runs/figure-quick    # after the README's first command
"""

from __future__ import annotations

from pathlib import Path

import torch
import tyro
from PIL import Image

import scgs_warp
from scgs_warp.geometry.cameras import look_at


def main(
    run: Path = Path("runs/example"),
    output: Path = Path("moments.png"),
    times: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0),
    size: int = 256,
) -> None:
    """Write an image of several moments.

    Args:
        run: folder of a run.
        output: image file to write.
        times: moments, from 0 to 1.
        size: width and height of each image in pixels.
    """
    scene = scgs_warp.Scene.load(run)
    seen = scene.overview  # positions of the training cameras
    centre = torch.tensor(seen.centre)
    eye = centre + seen.radius * torch.tensor([0.0, -0.9, 0.4])
    K = torch.tensor([[1.4 * size, 0.0, size / 2], [0.0, 1.4 * size, size / 2], [0.0, 0.0, 1.0]])
    camera = scgs_warp.Camera(look_at(eye, centre, seen.up), K, size, size)

    columns = []
    for time in times:
        image = scene.render(camera, time, background=(1.0, 1.0, 1.0))  # rgb [H, W, 3], alpha [H, W], depth [H, W]
        near = (1.0 - image.depth / (2.0 * seen.radius)).clamp(0.0, 1.0) * image.alpha
        columns.append(torch.cat([image.rgb, near[:, :, None].expand(-1, -1, 3)], dim=0))
    strip = (torch.cat(columns, dim=1).clamp(0.0, 1.0) * 255.0).byte()
    Image.fromarray(strip.numpy()).save(output)
    print(f"{output}: {len(times)} moments of {run}")


if __name__ == "__main__":
    tyro.cli(main)
