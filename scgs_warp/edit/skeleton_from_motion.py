"""The skeleton of a scene, found in its trained motion."""

from __future__ import annotations

import math

import numpy as np
import torch

from ..errors import UserError
from ..runtime.search_tree import search_tree
from ..scene.scene import Scene
from .joints import Joint, find_joints
from .necks import find_necks
from .parts import find_parts
from .patches import Patches, make_patches
from .skeleton import Part, Skeleton, Source

INSTANTS = 16
"""Number of instants at which the motion is compared; the first one, time 0, is the reference pose."""
MIN_OPACITY = 0.5
"""Opacity below which a Gaussian does not show how the surface moves."""
STILL = 3e-3
"""Root mean square distance of the Gaussians from a rigid motion, relative to the scene's size, below which nothing
moves."""
MAX_GAUSSIANS = 50_000
"""Number of Gaussians that are looked at; of more, an even sample."""


def find_skeleton(scene: Scene, binding: tuple[np.ndarray, np.ndarray], count: int | None = None) -> Skeleton:
    """Find parts and joints; parts are in order of decreasing size and called ``part-1``, ``part-2``, ... Where nothing
    moves, parts are those of the shape, between narrow necks, and the skeleton's source says so.

    Args:
        binding: indices and skinning weights of the control points of each Gaussian, [N, K] each.
        count: number of parts; None: chosen from the motion. There are more where the scene falls into more pieces,
            and fewer where the motion, or the shape of what stands still, tells no more apart (``other_count``).
    """
    patches = observe(scene, binding)
    source: Source = "motion"
    labels = find_parts(patches, count)
    if not moves(patches):
        source, labels = "geometry", find_necks(patches.edges, len(patches.nodes), count)
    joints = find_joints(patches, labels)
    owner = _labels_of_nodes(scene, patches, labels)
    return Skeleton(tuple(_part(scene, row, joint, owner) for row, joint in enumerate(joints)), source)


def other_count(skeleton: Skeleton, count: int) -> str | None:
    """Say why ``find_skeleton`` has found another number of parts than ``count``; None: it has not."""
    found = len(skeleton.parts)
    if found == count:
        return None
    if found > count:
        why = "the scene falls into that many pieces, and no part spans two"
    elif skeleton.source == "geometry":
        why = "what stands still is not cut into smaller pieces"
    else:
        why = "the motion tells no more apart"
    return f"gives {found}: {why}"


def moves(patches: Patches) -> bool:
    """Return whether anything moves but for a rigid motion of the whole."""
    pooled = patches.moments.pooled(np.zeros(len(patches.nodes), np.int64), 1)
    return bool(math.sqrt(pooled.errors().sum() / pooled.count.sum()) > STILL * patches.size)


def observe(scene: Scene, binding: tuple[np.ndarray, np.ndarray]) -> Patches:
    """Sample the motion of the opaque Gaussians, normalised units.

    Raises:
        UserError: none of them moves finitely.
    """
    with torch.no_grad():
        opaque = np.flatnonzero((scene.gaussians.opacities() > MIN_OPACITY).cpu().numpy())
        if not len(opaque):
            opaque = np.arange(len(binding[0]))
        chosen = opaque[:: max(1, math.ceil(len(opaque) / MAX_GAUSSIANS))]
        times = torch.linspace(0.0, 1.0, INSTANTS).tolist()
        tracks = [scene.motion.gaussians_at(scene.gaussians, time).means[chosen].cpu().double() for time in times]
    found = torch.stack(tracks).numpy()
    finite = np.isfinite(found).all(axis=(0, 2))
    if not finite.any():
        raise UserError("no Gaussian's motion is finite; train again with a lower rate")
    return make_patches(found[:, finite], binding[0][chosen[finite]], binding[1][chosen[finite]])


def _labels_of_nodes(scene: Scene, patches: Patches, labels: np.ndarray) -> np.ndarray:
    """Return the part of every control point, [M]; one without Gaussians has that of the nearest one with some."""
    with torch.no_grad():
        points = scene.motion.control_points_at(0.0).cpu().double().numpy()
    found = labels[search_tree(points[patches.nodes]).query(points)[1]]
    found[patches.nodes] = labels  # two control points may coincide
    return found


def _part(scene: Scene, row: int, joint: Joint, owner: np.ndarray) -> Part:
    unit = scene.normalisation
    point = joint.point / unit.scale + np.asarray(unit.centre, np.float64)
    axis = None if joint.axis is None else tuple(joint.axis.tolist())
    parent = None if joint.parent < 0 else f"part-{joint.parent + 1}"
    nodes = tuple(np.flatnonzero(owner == row).tolist())
    return Part(
        f"part-{row + 1}", nodes, parent, tuple(point.tolist()), axis, math.degrees(joint.turn), joint.confidence
    )
