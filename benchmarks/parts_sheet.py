"""Draw the parts that were found in trained runs: each moment beside itself with its parts in colours.

python benchmarks/parts_sheet.py --run runs/jumpingjacks runs/hook ... --output docs/images/edit-parts.png
"""

from __future__ import annotations

import argparse
import colorsys
import dataclasses
import sys
from pathlib import Path

import numpy as np
import torch

from scgs_warp.edit import EditSession
from scgs_warp.gaussians import SH_C0
from scgs_warp.geometry.cameras import orbit_camera
from scgs_warp.rendering.render import render
from scgs_warp.runtime.environment import configure
from scgs_warp.scene.scene import Scene
from scgs_warp.storage.png_files import write_png

TIMES = (0.0, 0.5, 1.0)
GOLDEN = 0.61803399
"""Step of the hue from part to part, which keeps neighbours in the list apart."""


def part_colors(count: int) -> np.ndarray:
    """Return a colour for each part, [P, 3]."""
    return np.array([colorsys.hsv_to_rgb(GOLDEN * k % 1.0, 0.75, (0.6, 1.0)[k // 3 % 2]) for k in range(count)])


def row_of(run: Path, size: int) -> np.ndarray:
    """Return the pictures of a run side by side, [H, W, 3]."""
    session = EditSession(Scene.load(run, device="cpu"))
    scene = session.scene
    colors = part_colors(len(session.parts()))[session.gaussian_parts()]
    print(f"{run.name}: {len(session.parts())} parts", flush=True)
    camera, white, pictures = orbit_camera(scene.overview, scene.overview.azimuth, size), torch.ones(3), []
    for time in TIMES:
        posed = session.engine.normalised(time, None)
        flat = torch.from_numpy((colors - 0.5) / SH_C0).float().reshape(posed.sh_dc.shape)
        painted = dataclasses.replace(posed, sh_dc=flat, sh_rest=torch.zeros_like(posed.sh_rest))
        view = scene.normalisation.apply_camera(camera)
        pictures.append(scene.render(camera, time, white).rgb)
        pictures.append(render(painted, view, white, antialiased=scene.config.antialiased).rgb)
    return np.concatenate([picture.detach().clamp(0, 1).numpy() for picture in pictures], axis=1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, nargs="+", required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--size", type=int, default=200, help="longer side of a picture in pixels")
    options = parser.parse_args()
    configure(1)
    sheet = np.concatenate([row_of(run, options.size) for run in options.run])
    write_png(options.output, (255.0 * sheet + 0.5).astype(np.uint8))
    return 0


if __name__ == "__main__":
    sys.exit(main())
