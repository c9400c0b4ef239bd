"""Measure edits: a limb turned about its joint, the rest pinned.

``python tests/helpers/limb_bending.py --run runs/figure-quick ... [--picture limbs.png]`` measures runs of the
built-in scene; the picture is of the first one.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # when run as a program

import numpy as np
import torch
from scipy.spatial import cKDTree

from helpers.edit_scenes import figure_surface
from scgs_warp.data.synthetic.figure_motion import bone_transforms
from scgs_warp.edit import ControlGraph, EditSession
from scgs_warp.edit.rotations import from_axis, rotate, to_matrix
from scgs_warp.geometry.cameras import look_at
from scgs_warp.types import Camera

LIMBS = {
    "arm": (("shoulder_left", "elbow_left"), "shoulder_left", (0.0, -1.0, 0.0)),
    "leg": (("hip_left", "knee_left"), "hip_left", (-1.0, 0.0, 0.0)),
}
"""Bones, the joint turned about at time 0, the axis."""
TRUNK = ("torso", "hips")


class Bent(NamedTuple):
    """Within two rings of the limb."""

    edges: float
    """95th percentile of the relative change of the graph's edges."""
    determinant: float
    """Least, of the affine deformation of a control point's neighbourhood."""
    gaussians: float
    """95th percentile of the relative change of Gaussians' distances to their 8 nearest neighbours."""
    error: float
    """Mean distance of the limb's Gaussians from where the joint's rotation takes them, in limb lengths."""
    worst_edge: float
    """Largest relative change of an edge of the graph."""
    torso_moved: float
    """Mean distance by which the Gaussians of torso and hips move, in heights of the figure."""


def grab(session: EditSession, node_bones: np.ndarray, limb: str, near: int = 2, far: int = 3) -> np.ndarray:
    """Make the handle and the pins: the limb but for ``near`` rings at the joint is one handle, everything further than
    ``far`` rings from the limb is pinned. Returns the limb's control points [M] bool."""
    bones, joint, _ = LIMBS[limb]
    own = np.isin(node_bones, bones)
    handle = set(np.flatnonzero(own).tolist()) - set(session.ring(np.flatnonzero(~own), near))
    pivot = tuple(bone_transforms(0.0)[joint][:3, 3].tolist())
    session.reset()
    session.add_handle(handle, 0.0, limb, pivot=pivot)
    session.pin(set(range(len(session))) - set(session.ring(np.flatnonzero(own), far)))
    return own


def bend(
    session: EditSession, node_bones: np.ndarray, solid: np.ndarray, bones: np.ndarray, limb: str, degrees: float
) -> Bent:
    """Turn the limb that ``grab`` took and measure.

    Args:
        solid: [N] bool, which Gaussians count (the opaque ones).
        bones: of those.
    """
    session.move(limb, rotation=from_axis(LIMBS[limb][2], degrees).tolist())
    return measured(session, session.graph, node_bones, solid, bones, limb, degrees)


def measured(
    session: EditSession,
    graph: ControlGraph,
    node_bones: np.ndarray,
    solid: np.ndarray,
    bones: np.ndarray,
    limb: str,
    degrees: float,
) -> Bent:
    """Measure the present edit at time 0 as a turn of a limb about its joint.

    Args:
        graph: graph that bends.
        solid, bones: as in ``bend``.
    """
    own, joint = np.isin(node_bones, LIMBS[limb][0]), LIMBS[limb][1]
    pivot, turn = bone_transforms(0.0)[joint][:3, 3], from_axis(LIMBS[limb][2], degrees)
    start = session.scene.gaussians_at(0.0).means.double().numpy()[solid]
    rest = session.engine.to_world(session.engine.motion_at(0.0).positions)
    bent = session.engine.bend(session.edit, 0.0)
    assert bent is not None
    posed = session.engine.to_world(bent.positions)
    zone = np.zeros(len(session), bool)
    zone[list(graph.ring(np.flatnonzero(own), 2))] = True
    edges = graph.edges
    lengths = [np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) for x in (rest, posed)]
    strain = np.abs(lengths[1] / lengths[0] - 1.0)[zone[edges].any(1)]
    moved = session.gaussians_at(0.0).means.double().numpy()[solid]
    near = zone[session.engine.binding[0][:, 0].numpy()][solid]
    apart, who = cKDTree(start).query(start, 9)
    now = np.linalg.norm(moved[who[:, 1:]] - moved[:, None], axis=-1)
    change = np.abs(now / np.maximum(apart[:, 1:], 1e-9) - 1.0)[near]
    limb_of = np.isin(bones, LIMBS[limb][0])
    truth = rotate(turn, start[limb_of] - pivot) + pivot
    error = np.linalg.norm(moved[limb_of] - truth, axis=1).mean()
    length = np.linalg.norm(start[limb_of] - pivot, axis=1).max()
    determinant = determinants(rest, posed, to_matrix(bent.turns), edges)[zone].min()
    trunk = np.linalg.norm(moved - start, axis=1)[np.isin(bones, TRUNK)].mean() / np.ptp(start[:, 2])
    return Bent(
        float(np.percentile(strain, 95)),
        float(determinant),
        float(np.percentile(change, 95)),
        float(error / length),
        float(strain.max()),
        float(trunk),
    )


def determinants(rest: np.ndarray, posed: np.ndarray, turns: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """[M] of the affine maps that best explain each node's edges; its rotation decides in directions in which they
    reach less than about a tenth of their length: a forearm's control points lie almost on a line."""
    both = np.concatenate([edges, edges[:, ::-1]])
    before, after = rest[both[:, 1]] - rest[both[:, 0]], posed[both[:, 1]] - posed[both[:, 0]]
    A, B = np.zeros((len(rest), 3, 3)), np.zeros((len(rest), 3, 3))
    np.add.at(A, both[:, 0], before[:, :, None] * before[:, None])
    np.add.at(B, both[:, 0], after[:, :, None] * before[:, None])
    little = 1e-2 * np.trace(A, axis1=1, axis2=2)[:, None, None]
    lone = little[:, 0, 0] == 0
    A[lone], B[lone] = np.eye(3), np.eye(3)
    return np.linalg.det((B + little * turns) @ np.linalg.inv(A + little * np.eye(3)))


DEGREES = (15, 45, 90, 135)
VIEWS = {"arm": (0.4, -3.6, 0.3), "leg": (3.6, -0.6, 0.1)}
"""Return the camera of a picture."""


def bones_of(session: EditSession) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, for a trained figure, the bone of each control point [M], which Gaussians are opaque [N], and the bones
    of those: the bone whose surface is nearest."""
    surface, bones = figure_surface(20000)
    tree = cKDTree(surface)
    nodes = session.engine.to_world(session.engine.motion_at(0.0).positions)
    gaussians = session.scene.gaussians_at(0.0)
    solid = (gaussians.opacities > 0.5).cpu().numpy()
    return bones[tree.query(nodes)[1]], solid, bones[tree.query(gaussians.means.double().cpu().numpy()[solid])[1]]


def measure(session: EditSession, limb: str) -> list[Bent]:
    """At all angles, for a trained scene."""
    node_bones, solid, own = bones_of(session)
    grab(session, node_bones, limb)
    return [bend(session, node_bones, solid, own, limb, degrees) for degrees in DEGREES]


def picture(session: EditSession, size: int = 220) -> np.ndarray:
    """[H, W, 3] uint8: a row for each limb, at rest and at all angles."""
    rows = []
    for limb, (_, _, axis) in LIMBS.items():
        measure(session, limb)
        viewmat = look_at(VIEWS[limb], (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)).float()
        K = torch.tensor([[1.5 * size, 0.0, size / 2], [0.0, 1.5 * size, size / 2], [0.0, 0.0, 1.0]])
        camera = Camera(viewmat, K, size, size)
        row = []
        for degrees in (0, *DEGREES):
            session.move(limb, rotation=from_axis(axis, degrees).tolist())
            image = session.render(camera, 0.0)
            rgb = image.rgb + (1.0 - image.alpha[..., None])
            row.append((rgb.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy())
        rows.append(np.concatenate(row, axis=1))
    return np.concatenate(rows)


def main() -> None:
    from scgs_warp.scene.scene import Scene
    from scgs_warp.storage.png_files import write_png

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, nargs="+", required=True)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    sessions = [EditSession(Scene.load(run, device="cpu")) for run in options.run]
    for limb in LIMBS:
        found = [measure(session, limb) for session in sessions]
        for degrees, of_runs in zip(DEGREES, zip(*found)):
            cells = [
                " ".join(f"{100 * b.edges:.1f}" for b in of_runs),
                " ".join(f"{100 * b.gaussians:.1f}" for b in of_runs),
                " ".join(f"{b.determinant:.2f}" for b in of_runs),
                " ".join(f"{100 * b.error:.1f}" for b in of_runs),
            ]
            print(f"| {limb}, {degrees} | {' | '.join(cells)} |", flush=True)
    if options.picture:
        write_png(options.picture, picture(sessions[0]))


if __name__ == "__main__":
    main()
