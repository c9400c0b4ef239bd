"""Films of a small rig: cameras that stand still around the built-in figure in its room, and their truth."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from scgs_warp.data.synthetic.films.cameras import rig_viewmats
from scgs_warp.data.synthetic.films.encoding import write_film
from scgs_warp.data.synthetic.films.sound import SAMPLE_RATE, clap_shapes, heard
from scgs_warp.data.synthetic.films.stage import stage_of
from scgs_warp.types import Camera

FPS = 20.0


class RigFilms(NamedTuple):
    folder: Path
    """One .mp4 per camera, cam0.mp4 and so on."""
    starts: np.ndarray
    """[C] seconds"""
    viewmats: np.ndarray
    """[C, 4, 4]"""
    K: np.ndarray
    """[3, 3]"""
    floor: float


ARC = 100.0


def film_rig(
    folder: Path, late: list[int], count: int = 10, width: int = 320, height: int = 180, sound: bool = True
) -> RigFilms:
    """Film with one camera per entry of ``late``: the number of frames by which it begins late."""
    folder.mkdir()
    stage = stage_of("robot", "cpu")
    viewmats = rig_viewmats(len(late), stage.floor, ARC)
    focal = 0.8 * width
    K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    cameras = [Camera(torch.from_numpy(v).float(), torch.from_numpy(K).float(), width, height) for v in viewmats]
    films: list[list[np.ndarray]] = [[] for _ in late]
    total = count + max(late)
    for instant in range(total):
        posed = stage.pose(instant / (total - 1))
        for camera, begins, film in zip(cameras, late, films):
            if begins <= instant < begins + count:
                image = stage.caster.render(posed, camera, 2)[..., :3]
                film.append((image.clamp(0, 1) * 255).round().to(torch.uint8).numpy())
    starts = np.array(late) / FPS
    rng = np.random.default_rng(0)
    times = np.sort(rng.uniform(0.0, total / FPS, 9))
    shapes = clap_shapes(len(times), rng)
    for index, (film, start) in enumerate(zip(films, starts)):
        own = np.random.default_rng([1, index])
        recorded = heard(times, shapes, start, max(count / FPS, 1.5), 3.0, own) if sound else None
        write_film(folder / f"cam{index}.mp4", film, FPS, 14, recorded)
    assert SAMPLE_RATE % FPS == 0
    return RigFilms(folder, starts, viewmats, K, stage.floor)


def write_poses_bounds(films: RigFilms, width: int, height: int) -> None:
    """Write LLFF's rows of the true cameras beside the films."""
    rows = []
    for viewmat in films.viewmats:
        right, down, forward = viewmat[0, :3], viewmat[1, :3], viewmat[2, :3]
        position = -viewmat[:3, :3].T @ viewmat[:3, 3]
        pose = np.stack([down, right, -forward, position, [height, width, films.K[0, 0]]], axis=1)
        rows.append([*pose.ravel(), 1.0, 10.0])
    np.save(films.folder / "poses_bounds.npy", np.array(rows))
