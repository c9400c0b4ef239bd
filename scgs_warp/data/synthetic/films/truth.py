"""Truth of a film: poses, moments and gains of the frames; depth, flow and masks; and a data set with true poses."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from ....geometry.rotation import OPENGL_TO_OPENCV
from ....storage.numpy_files import read_npy
from ....types import Camera
from ...points import write_points
from ..renderer import GROUND_TRUTH_TIMES, SurfacePoints, write_png
from .cameras import at
from .encoding import decoded
from .photography import View
from .request import FilmRequest
from .shooting import Shooting, Take
from .stage import Stage

FILE = "truth.npz"
POINTS_FILE = "points.ply"
POINTS = 6000
"""Number of points on the room that the data set begins from, before those that no camera sees are dropped."""
POINT_NOISE = 0.004
"""Standard deviation of their positions, world units: about that of structure from motion."""
VISIBLE_EVERY = 6
"""Stride of the frames whose visible points are determined."""
BUMPS, DEPTH_BLUR = (6, 8), 2.0
"""Rows and columns of the errors of a depth map; standard deviation by which its outlines are blurred, pixels."""


def write_truth(folder: Path, shooting: Shooting) -> None:
    """Write ``truth.npz``. For C cameras with V frames each, it holds ``names [C]``, ``starts [C]`` (seconds of the
    room's clock), ``seconds [C, V]``, ``times [C, V]`` of the subject, ``viewmats [C, V, 4, 4]``, ``gains [C, V, 3]``
    and ``K [3, 3]``."""
    takes = shooting.takes
    seconds = np.stack([take.seconds for take in takes])
    np.savez(
        folder / FILE,
        names=np.array([take.name for take in takes]),
        starts=np.array([take.start for take in takes]),
        seconds=seconds,
        times=np.vectorize(shooting.time_of)(seconds),
        viewmats=np.stack([take.viewmats for take in takes]),
        gains=np.stack([take.gains for take in takes]),
        K=takes[0].view.K,
    )


def map_of(take: Take, index: int) -> str:
    """Return the name of the maps of a frame."""
    return f"maps/{take.name}/{index:05d}.npz"


def write_maps(folder: Path, stage: Stage, shooting: Shooting, take: Take) -> None:
    """Write ``map_of`` every frame of a take.

    Each holds ``depth [H, W]`` float32; ``moves [H, W]`` bool, True on the subject; ``flow [H, W, 2]`` float16, the
    motion of surface points to the next frame in pixels; and ``seen [H, W]`` bool, True where the point is visible in
    the next frame. The last frame has no flow.
    """
    (folder / map_of(take, 0)).parent.mkdir(parents=True)
    moments = take.seconds.tolist()
    for index, second in enumerate(moments):
        camera = take.view.camera(second)
        hits = stage.hits(stage.pose_unlit(shooting.time_of(second)), camera)
        content = {"depth": hits.depth, "moves": stage.moves(hits)}
        if index + 1 < len(moments):
            later = moments[index + 1]
            there = stage.pose_unlit(shooting.time_of(later))
            places, seen = stage.places(there, hits), take.view.camera(later)
            content["flow"] = flow_to(places, seen).half()
            visible = stage.caster.visible(there, seen, places.reshape(-1, 3).contiguous())
            content["seen"] = visible.view(hits.face.shape) & (hits.face >= 0)
        arrays: dict[str, Any] = {name: value.cpu().numpy() for name, value in content.items()}
        np.savez_compressed(folder / map_of(take, index), **arrays)


def flow_to(places: Tensor, camera: Camera) -> Tensor:
    """Return the motion [H, W, 2], in pixels, from each pixel's centre to the image of ``places`` [H, W, 3]."""
    view = camera.to(places.device)
    local = places @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    pixels = local @ view.K.T
    pixels = pixels[..., :2] / pixels[..., 2:].clamp(min=1e-6)
    rows, columns = torch.meshgrid(
        torch.arange(camera.height, device=places.device) + 0.5,
        torch.arange(camera.width, device=places.device) + 0.5,
        indexing="ij",
    )
    return pixels - torch.stack([columns, rows], dim=-1)


def write_data_set(
    folder: Path, stage: Stage, shooting: Shooting, request: FilmRequest, rng: np.random.Generator,
    done: Callable[[], object],
) -> None:  # fmt: skip
    """Write a data set with true poses, in nerfstudio's layout.

    The frames, as a decoder returns them, are for training. Sharp views at the usual exposure, from places off the
    path, are held out. The initial points lie on the room.
    """
    take = shooting.takes[0]
    (folder / "images").mkdir()
    frames, train, some = [], [], {}
    for index, picture in enumerate(decoded(folder / take.file)):
        name = f"images/frame_{index:05d}.png"
        write_png(folder / name, picture)
        if index % VISIBLE_EVERY == 0:
            some[index] = picture
        second = float(take.seconds[index])
        entry = _entry(name, take.view.viewmat(second), shooting.time_of(second))
        if request.maps:
            entry["depth_file_path"] = _depth_of(folder, take, index, request)
        frames.append(entry)
        train.append(name)
    test = _write_held_out(folder, stage, shooting, take.view, request, rng, frames, done)
    _write_points(folder / POINTS_FILE, stage, shooting, take, some, rng)
    K = take.view.K
    content = {
        "camera_model": "PINHOLE",
        **{"w": take.view.width, "h": take.view.height, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]},
        "ply_file_path": POINTS_FILE,
        **({"depth_unit_scale_factor": 1.0} if request.maps else {}),
        "frames": frames,
        "train_filenames": train,
        "test_filenames": test,
    }
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _depth_of(folder: Path, take: Take, index: int, request: FilmRequest) -> str:
    """Return the name of a frame's depth map: the true one, or one that is wrong, as a network's is: blurred, and by a
    factor that changes smoothly over the image and from frame to frame."""
    if request.depth_error == 0.0:
        return map_of(take, index)
    depth = read_npy(folder / map_of(take, index), "depth")
    rng = np.random.default_rng([request.seed, 8, index])
    bumps = cv2.resize(rng.normal(size=BUMPS), depth.shape[::-1], interpolation=cv2.INTER_CUBIC)
    factor = np.exp(request.depth_error * (bumps + 0.5 * rng.normal()))
    name = f"depths/{index:05d}.npy"
    (folder / name).parent.mkdir(exist_ok=True)
    np.save(folder / name, (cv2.GaussianBlur(depth, (0, 0), DEPTH_BLUR) * factor).astype(np.float32))
    return name


def _entry(name: str, viewmat: np.ndarray, time: float) -> dict[str, object]:
    return {"file_path": name, "transform_matrix": (np.linalg.inv(viewmat) @ OPENGL_TO_OPENCV).tolist(), "time": time}


def _write_held_out(
    folder: Path, stage: Stage, shooting: Shooting, view: View, request: FilmRequest, rng: np.random.Generator,
    frames: list[dict[str, object]], done: Callable[[], object],
) -> list[str]:  # fmt: skip
    """Write views from within the arc of the path, at other heights and moments; add them to ``frames``."""
    names = []
    for index in range(request.test):
        time = (index + 0.5) / request.test
        azimuth = rng.uniform(-0.45, 0.45) * request.arc
        viewmat = at(azimuth, rng.uniform(1.2, 1.9), shooting.floor, rng.uniform(2.8, 3.2))
        still = View(lambda _, matrix=viewmat: matrix, view.K, view.width, view.height)
        image = stage.caster.render(stage.pose(time), still.camera(0.0), request.samples)[..., :3]
        pixels = (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu().numpy()
        names.append(f"images/held_out_{index:03d}.png")
        write_png(folder / names[-1], pixels)
        frames.append(_entry(names[-1], viewmat, time))
        done()
    return names


def _write_points(
    path: Path, stage: Stage, shooting: Shooting, take: Take, pictures: Mapping[int, np.ndarray],
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Write the points on the room that one of ``pictures`` sees, each with the colour of its first sight."""
    points = stage.sample_room(POINTS, rng)
    colors, found = np.zeros((len(points), 3)), np.zeros(len(points), bool)
    tensor = torch.from_numpy(points).float().to(stage.device)
    for index, picture in pictures.items():
        second = float(take.seconds[index])
        camera, viewmat = take.view.camera(second), take.view.viewmat(second)
        posed = stage.pose_unlit(shooting.time_of(second))
        fresh = stage.caster.visible(posed, camera, tensor).cpu().numpy() & ~found
        pixels = (points[fresh] @ viewmat[:3, :3].T + viewmat[:3, 3]) @ take.view.K.T
        columns, rows = np.floor(pixels[:, :2] / pixels[:, 2:]).astype(int).T
        colors[fresh] = picture[rows.clip(0, camera.height - 1), columns.clip(0, camera.width - 1)]
        found |= fresh
    moved = points[found] + rng.normal(0.0, POINT_NOISE, (int(found.sum()), 3))
    write_points(path, moved, colors[found].astype(np.uint8))


def write_ground_truth(folder: Path, stage: Stage, shooting: Shooting, points: SurfacePoints) -> None:
    """Write ``ground_truth.npz``, the true motion of points on the subject, as ``synthesize.py`` does for every scene.

    Visibility is determined in every ``VISIBLE_EVERY``-th frame and kept until the next of them.
    """
    take = shooting.takes[0]
    moments = take.seconds[::VISIBLE_EVERY].tolist()
    seen = []
    for second in moments:
        time = shooting.time_of(second)
        tensor = torch.from_numpy(stage.track(points, [time])[0]).float().to(stage.device)
        seen.append(stage.caster.visible(stage.pose_unlit(time), take.view.camera(second), tensor).cpu().numpy())
    times = np.linspace(0.0, 1.0, GROUND_TRUTH_TIMES)
    vertices = stage.mover.posed(0.0)[0]
    np.savez(
        folder / "ground_truth.npz",
        points=stage.track(points, times.tolist()).astype(np.float32),
        times=times.astype(np.float32),
        visible=np.repeat(np.stack(seen), VISIBLE_EVERY, axis=0)[: shooting.count],
        height=np.float32(vertices[:, 2].max() - vertices[:, 2].min()),
    )
