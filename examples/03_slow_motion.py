"""Slow motion: the scene is continuous in time, so a film can show any moment between the training frames.

The film runs at normal speed, slows down to a sixth in the middle while the camera goes round, and speeds up again.

    python examples/01_train_builtin.py
    python examples/03_slow_motion.py --output slow.gif
"""

from __future__ import annotations

from pathlib import Path

import tyro

import scgs_warp
from scgs_warp.edit import Playback
from scgs_warp.geometry.cameras import orbit_camera
from scgs_warp.visualization.video import film

SECONDS = 5.0
SPEEDS = Playback(map=((0.0, 0.0), (1.0, 0.4), (4.0, 0.6), (SECONDS, 1.0)))
"""Pairs of a second of the film and a moment of the scene, linear in between."""


def main(run: Path = Path("runs/example"), output: Path = Path("slow.mp4"), size: int = 256, fps: float = 25.0) -> None:
    """Write a film.

    Args:
        run: folder of a run.
        output: name that ends in .mp4 or .gif, or a folder for PNGs.
        size: longer side in pixels, even.
        fps: frames per second.
    """
    scene = scgs_warp.Scene.load(run)
    frames = round(SECONDS * fps)
    with film(output, fps) as writer:
        for frame in range(frames):
            second = frame / fps
            slow = min(max((second - 1.0) / 3.0, 0.0), 1.0)  # 0 to 1 while time is slow
            camera = orbit_camera(scene.overview, scene.overview.azimuth + 120.0 * slow, size)
            image = scene.render(camera, SPEEDS.time_at(second, SECONDS))
            writer.write((image.rgb.clamp(0.0, 1.0) * 255.0).byte().numpy())
    print(f"{output}: {frames} frames; {SPEEDS.time_at(2.0, SECONDS):.2f} is the moment shown at second 2")


if __name__ == "__main__":
    tyro.cli(main)
