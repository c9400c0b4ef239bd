"""Rods of segments that swing about joints, as patches, and what tests of parts compare."""

from __future__ import annotations

import math

import numpy as np

from scgs_warp.edit import parts
from scgs_warp.edit.patches import Patches, make_patches
from scgs_warp.edit.rotations import from_axis, to_matrix

TIMES = np.linspace(0.0, 1.0, 16)


def chain(
    angles: list[float], seed: int = 0, noise: float | list[float] = 0.0
) -> tuple[Patches, np.ndarray, np.ndarray]:
    """A rod along x of segments of length 1. Each segment swings about a joint at its start: the first about y, the
    next about z, and so on, by these angles in degrees between two instants. Patches are 10 along each segment, 60
    Gaussians each, with noise on their tracks, for all or for each segment. Returns patches, the segment of each patch,
    and the joints at rest."""
    random = np.random.default_rng(seed)
    count = 600 * (len(angles) + 1)
    rest = random.random((count, 3)) * [len(angles) + 1, 0.3, 0.3] - [0.0, 0.15, 0.15]
    segment = rest[:, 0].astype(int)
    off = np.broadcast_to(noise, len(angles) + 1)[segment][:, None]
    tracks = []
    for time in TIMES:
        points, place = rest.copy(), np.eye(4)
        for index in range(len(angles)):
            degrees = angles[index] * 0.5 * (1.0 - math.cos(2.0 * math.pi * time))
            turn = np.eye(4)
            turn[:3, :3] = to_matrix(from_axis((0, 1, 0) if index % 2 == 0 else (0, 0, 1), degrees))
            there = np.eye(4)
            there[0, 3] = index + 1.0
            place = place @ there @ turn @ np.linalg.inv(there)
            own = segment == index + 1
            points[own] = rest[own] @ place[:3, :3].T + place[:3, 3]
        tracks.append(points + off * random.normal(size=points.shape))
    at = rest[:, 0] * 10.0 - 0.5
    low = np.floor(at).clip(0, 10 * (len(angles) + 1) - 2)
    indices = np.stack([low, low + 1], 1).astype(np.int64)
    share = (at - low).clip(0.0, 1.0)
    patches = make_patches(np.stack(tracks), indices, np.stack([1.0 - share, share], 1))
    joints = np.array([[index + 1.0, 0.0, 0.0] for index in range(len(angles))])
    return patches, np.arange(10 * (len(angles) + 1)) // 10, joints


def same_partition(first: np.ndarray, second: np.ndarray) -> bool:
    return len(set(zip(first.tolist(), second.tolist()))) == len(set(first.tolist())) == len(set(second.tolist()))


def plain_width(edges: np.ndarray, labels: np.ndarray, pair: np.ndarray) -> float:
    """Count the edges between two parts, one after the other."""
    crossing = sum({labels[a], labels[b]} == set(pair.tolist()) for a, b in edges.tolist())
    neighbors = sum((edges == patch).sum() for patch in range(len(labels))) / len(labels)
    area = min(int((labels == part).sum()) for part in pair)
    return crossing / (neighbors / 3.0) / math.sqrt(area) / parts.USUAL_WIDTH
