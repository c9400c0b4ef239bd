"""Tracks of surface points, and animated point clouds: .npz, .csv, glTF."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ..edit import EditSession
from ..edit.rotations import conjugate, multiply, rotate, unit
from ..errors import UserError
from ..gaussians import SH_C0
from ..ops.sampling import farthest_points
from ..runtime import memory
from ..runtime.search_tree import search_tree
from ..scene.scene import Scene
from ..storage.files import read_bytes, write_atomically
from .finite import finite_rows
from .gltf import VERTICES, GltfDocument, linear_colors, upright
from .moments import AnimationMoment, posed_gaussians
from .no_surface import NoSurface
from .request import MAX_POINTS

FORMAT = "scgs-warp tracks"
VERSION = 1
MIN_OPACITY = 0.5
"""Opacity below which a Gaussian is not on the surface."""
MAX_BYTES = 2**27
"""Largest file of points, in bytes."""
POINT_BYTES = {".npz": 56, ".csv": 160, ".glb": 64}
"""Memory of a point at a moment while tracks are built and written, by suffix."""
WEIGHT_BYTES = 12
"""Memory of a weight of a morph target at a moment in a .glb, which has a target for each moment."""


class Tracks(NamedTuple):
    """Paths of P points at T moments, world units."""

    seconds: np.ndarray
    """[T] since the animation's beginning."""
    times: np.ndarray
    """[T] scene times in [0, 1]."""
    points: np.ndarray
    """[T, P, 3] float32."""
    colors: np.ndarray
    """[P, 3] uint8 sRGB, at the first moment."""
    gaussians: np.ndarray
    """[P] int32: the Gaussian of the run that each point is, or moves with."""


def read_points(path: Path) -> np.ndarray:
    """Read points [P, 3] from a .csv of three columns, x, y and z, with or without a line of names.

    Raises:
        UserError: naming the line.
    """
    content = read_bytes(path, "give a .csv with a point per line: x,y,z")
    if len(content) > MAX_BYTES:
        raise UserError(f"{path}: has more than {MAX_BYTES >> 20} MiB; give fewer points")
    lines = csv.reader(io.StringIO(content.decode("utf-8-sig", "replace")))
    points: list[list[float]] = []
    try:
        for number, fields in enumerate(lines, 1):
            if not fields or (number == 1 and [field.strip().lower() for field in fields] == ["x", "y", "z"]):
                continue
            point = [_number(field) for field in fields]
            if len(point) != 3 or not all(map(math.isfinite, point)):
                raise UserError(f"{path}: line {number} is no point; give three finite numbers, x,y,z")
            points.append(point)
            if len(points) > MAX_POINTS:
                raise UserError(f"{path}: has more than {MAX_POINTS:,} points; give fewer")
    except csv.Error as error:
        raise UserError(f"{path}: is no .csv ({error}); give a point per line: x,y,z") from None
    if not points:
        raise UserError(f"{path}: holds no point; give one per line: x,y,z")
    return np.array(points)


def _number(field: str) -> float:
    try:
        value = float(field)
    except ValueError:
        return math.nan
    return value if abs(value) <= 1e9 else math.nan


@torch.no_grad()
def build_tracks(
    scene: Scene,
    session: EditSession | None,
    moments: list[AnimationMoment],
    chosen: int | np.ndarray | None = None,
    advance: Callable[[], None] | None = None,
    suffix: str = ".npz",
) -> Tracks:
    """Follow points of the surface.

    Args:
        session: session whose edit is applied; None: no edit.
        chosen: a number of Gaussians, spread evenly over the surface at time 0; or points [P, 3] at time 0, each of
            which keeps its place beside the nearest Gaussian of the surface; or None, all Gaussians of the surface.
        advance: called after each moment.
        suffix: that of the file to be written, which decides on the memory.

    Raises:
        NoSurface: no Gaussian is opaque.
        UserError: the motion is not finite, or memory does not suffice.
    """
    start = scene.gaussians_at(0.0)
    surface = np.flatnonzero(finite_rows(start) & (start.opacities.cpu().numpy() >= MIN_OPACITY))
    if not len(surface):
        raise NoSurface(f"no Gaussian is opaque to {MIN_OPACITY:g}, so that there is no surface to follow")
    means, quats = start.means.cpu().double().numpy(), unit(start.quats.cpu().double().numpy())
    offsets = None
    if isinstance(chosen, np.ndarray):
        surface = surface[search_tree(means[surface]).query(chosen)[1]]
        offsets = chosen - means[surface]
    elif chosen is not None and chosen < len(surface):
        surface = surface[np.sort(farthest_points(start.means[surface].cpu(), chosen).numpy())]
    count, length = len(surface), len(moments)
    need = POINT_BYTES[suffix] * count * length + (WEIGHT_BYTES * length**2 if suffix == ".glb" else 0)
    fewer = "give fewer --frames or --points, or a shorter film"
    memory.require(need, "cpu", f"--format tracks of {count:,} points at {length:,} instants", fewer)
    frames, colors = [], None
    for moment in moments:
        posed = posed_gaussians(scene, session, moment)
        if colors is None:
            colors = 0.5 + SH_C0 * posed.sh_dc.cpu().numpy()[surface]
        points = posed.means.cpu().double().numpy()[surface]
        if offsets is not None:
            turns = multiply(unit(posed.quats.cpu().double().numpy()[surface]), conjugate(quats[surface]))
            points = points + rotate(turns, offsets)
        if not np.isfinite(points).all():
            raise UserError(f"the motion is not finite at time {moment.time:g}; train again with a lower rate")
        frames.append(points.astype(np.float32))
        if advance is not None:
            advance()
    assert colors is not None
    return Tracks(
        np.array([moment.seconds for moment in moments]),
        np.array([moment.time for moment in moments]),
        np.stack(frames),
        np.rint(255.0 * colors.clip(0.0, 1.0)).astype(np.uint8),
        surface.astype(np.int32),
    )


def write_tracks(path: Path, tracks: Tracks, up: tuple[float, float, float]) -> None:
    """Write tracks in the format of the suffix; the same ones give the same bytes.

    Raises:
        UserError: the file cannot be written, or would be too large.
    """
    write = {".npz": _write_npz, ".csv": _write_csv, ".glb": _write_glb}[path.suffix.lower()]
    write(path, tracks, up)


def _write_npz(path: Path, tracks: Tracks, up: tuple[float, float, float]) -> None:
    content = io.BytesIO()
    np.savez_compressed(
        content,
        format=np.array(FORMAT),
        version=np.array(VERSION),
        seconds=tracks.seconds.astype("<f4"),
        times=tracks.times.astype("<f4"),
        points=tracks.points.astype("<f4"),
        colors=tracks.colors,
        gaussians=tracks.gaussians.astype("<i4"),
        up=np.array(up, "<f4"),
    )
    write_atomically(path, content.getvalue())


def _write_csv(path: Path, tracks: Tracks, up: tuple[float, float, float]) -> None:
    """Write a line per point and moment; ``up`` has no place in it."""
    text = io.StringIO()
    text.write("frame,seconds,time,point,x,y,z,red,green,blue\n")
    colors = [",".join(map(str, color)) for color in tracks.colors.tolist()]
    for frame, points in enumerate(tracks.points):
        head = f"{frame},{tracks.seconds[frame]:.9g},{tracks.times[frame]:.9g}"
        for point, ((x, y, z), color) in enumerate(zip(points.tolist(), colors)):
            text.write(f"{head},{point},{x:.9g},{y:.9g},{z:.9g},{color}\n")
    write_atomically(path, text.getvalue().encode())


def _write_glb(path: Path, tracks: Tracks, up: tuple[float, float, float]) -> None:
    """Write the points with a morph target for each later moment; weights go from one to the next, linearly."""
    document, first = GltfDocument(), tracks.points[0]
    attributes = {
        "POSITION": document.accessor(first.astype("<f4"), target=VERTICES, bounds=True),
        "COLOR_0": document.accessor(linear_colors(tracks.colors / 255.0), target=VERTICES, normalized=True),
    }
    moves = [points - first for points in tracks.points[1:]]
    targets = [{"POSITION": document.accessor(move.astype("<f4"), bounds=True)} for move in moves]
    mesh = {"name": "tracks", "primitives": [{"attributes": attributes, "mode": 0}]}
    if targets:
        mesh["primitives"][0]["targets"] = targets
        mesh["weights"] = [0.0] * len(targets)
    node = {"name": "tracks", "mesh": document.append("meshes", mesh), "rotation": upright(up)}
    document.json["scenes"][0]["nodes"].append(document.append("nodes", node))
    if targets:
        weights = np.eye(len(tracks.points), dtype="<f4")[:, 1:]
        sampler = {
            "input": document.accessor(tracks.seconds.astype("<f4"), bounds=True),
            "output": document.accessor(weights.reshape(-1)),
            "interpolation": "LINEAR",
        }
        channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        document.append("animations", {"name": "motion", "samplers": [sampler], "channels": [channel]})
    document.write(path)
