"""Train a scene: data in, a run directory out.

The script makes the built-in scene (a waving robot), trains on it, and scores held-out views. The other examples start
from the run directory that it writes.

    python examples/01_train_builtin.py
"""

from __future__ import annotations

from pathlib import Path

import tyro

import scgs_warp
from scgs_warp.config.presets import preset, with_steps
from scgs_warp.data import load
from scgs_warp.data.synthetic.builtin import make_synthetic
from scgs_warp.evaluation.evaluate import evaluate


def main(
    output: Path = Path("runs/example"), data: Path = Path("data/example"), size: int = 200, steps: int = 4000
) -> None:
    """Train the built-in scene.

    Args:
        output: run directory; an existing one is refused.
        data: folder for the scene's images, in D-NeRF layout.
        size: width and height of the images.
        steps: training steps of both stages together.
    """
    make_synthetic(data, size=size, train=60, test=6)
    train, test = load(data, "train"), load(data, "test")

    config = with_steps(preset("quick"), steps)  # every milestone scales with the number of steps
    scene = scgs_warp.fit(config, train, output=output, test=test)

    scores = evaluate(scene, test)
    print(f"{scene.gaussian_count} Gaussians, moved by {scene.control_point_count} control points")
    print(f"held-out views: PSNR {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.3f}")
    print(f"{output}: the run; look at it with: python apps/view.py --run {output} --output film.mp4")


if __name__ == "__main__":
    tyro.cli(main)
