"""Follow points through time: every Gaussian is a point of the surface and keeps its identity.

The script poses the scene at many moments, picks points spread over it, and writes their paths as numbers and as a
plot. Motion analysis, physics or a second renderer can start from these data.

    python examples/01_train_builtin.py
    python examples/07_follow_points.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
import tyro

import scgs_warp


def main(
    run: Path = Path("runs/example"), output: Path = Path("tracks.npz"), points: int = 200, moments: int = 25
) -> None:
    """Write tracks.

    Args:
        run: folder of a run.
        output: .npz with `times` [T] and `tracks` [T, P, 3], world units; a plot goes beside it.
        points: number of points to follow.
        moments: number of times from 0 to 1.
    """
    scene = scgs_warp.Scene.load(run)
    times = np.linspace(0.0, 1.0, moments)
    opacities = scene.gaussians_at(0.0).opacities
    chosen = torch.nonzero(opacities >= opacities.median())[:, 0]  # nearly transparent Gaussians are not on the surface
    chosen = chosen[torch.linspace(0, len(chosen) - 1, min(points, len(chosen))).long()]
    tracks = np.stack([scene.gaussians_at(float(time)).means[chosen].numpy() for time in times])
    np.savez_compressed(output, times=times, tracks=tracks)

    length = np.linalg.norm(np.diff(tracks, axis=0), axis=2).sum(axis=0)
    print(
        f"{output}: {tracks.shape[1]} points at {moments} moments; paths {length.min():.3f} to {length.max():.3f} long"
    )
    figure = plt.figure(figsize=(6, 6))
    axes = figure.add_subplot(projection="3d")
    for path, way in zip(tracks.transpose(1, 0, 2), length / max(length.max(), 1e-9)):
        axes.plot(*path.T, color=plt.get_cmap("plasma")(way), linewidth=1)
    axes.set_aspect("equal")
    axes.set_title("where points go; bright: far")
    figure.savefig(output.with_suffix(".png"), dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    tyro.cli(main)
