"""Helpers for editing sessions, and graphs of random points."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from scgs_warp.edit import EditSession, build_graph
from scgs_warp.edit.graph import ControlGraph
from scgs_warp.edit.rotations import from_axis
from scgs_warp.types import Gaussians, Image

TURN = from_axis([0, 0, 1], 40).tolist()


def same(first: Gaussians | Image, second: Gaussians | Image) -> bool:
    """Whether all parts agree to the bit."""
    pairs = zip(dataclasses.astuple(first), dataclasses.astuple(second))
    return all(torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b for a, b in pairs)


def part(session: EditSession, low: float, high: float) -> np.ndarray:
    """Control points between two quantiles along the bar, at time 0."""
    x = session.node_positions(0.0)[:60, 0]
    return np.flatnonzero((x >= np.quantile(x, low)) & (x <= np.quantile(x, high)))


def motion(session: EditSession, time: float) -> np.ndarray:
    """[M, 3] control points without the edit, world units."""
    return session.engine.to_world(session.engine.motion_at(time).positions)


def cloud(seed: int, count: int, spread=(1.0, 1.0, 1.0)) -> np.ndarray:
    """[count, 3] normally distributed points."""
    return np.random.default_rng(seed).normal(size=(count, 3)) * spread


def graph_of(points: np.ndarray, neighbors: int = 6) -> ControlGraph:
    """Build the graph of points that stand still."""
    return build_graph(torch.from_numpy(points).float()[None], neighbors)


def ends(session: EditSession) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Control points of the bar's left end, which never moves, and of its right end, at time 0."""
    x = session.node_positions(0.0)[:, 0]
    return tuple(np.flatnonzero(x < np.quantile(x, 0.2))), tuple(np.flatnonzero(x > np.quantile(x, 0.8)))
