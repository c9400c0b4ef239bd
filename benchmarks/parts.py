"""Compare the parts and joints found in trained runs with the true bones.

    python benchmarks/parts.py --run runs/figure-quick ... --data data/figure --json benchmarks/results/parts.json
    python benchmarks/parts.py --run runs/man --data data/man --mesh man.glb --json benchmarks/results/parts-man.json

Runs are of the built-in figure, or of a data set that ``apps/synthesize.py --mesh`` made of a skinned glTF file. Each
surface point of ``ground_truth.npz`` that a training view sees belongs to the bone whose rigid motion explains its
track best, and is compared with the part of the nearest opaque Gaussian. Bones that turn by less than 15 degrees
against their parent count as one with it. Parts and bones are matched one to one; a point of a part that matches no
bone, or another bone than the point's, disagrees.

Rows hold `run` and `bone`. Those of bone `all` hold the run's `agreement`, `parts`, `bones`, processor `seconds` of
finding them; `seen_agreement`, for which each point counts as often as a training view sees it, with the Gaussian that
is nearest to it then; and `tracked`: the share of points whose nearest Gaussian moves, in the trained motion, more like
the true bone than like any other. A surface that looks the same however it turns, such as a ball at a joint, need not.
Rows of bones hold the same for their own `points` (share of all), their `turn` against their parent, and
`trained_turn`, that of the Gaussians nearest to their points. Where the joint was found they hold `joint_error` in
percent of the height, and `axis_error` in degrees if both the truth and the run have an axis and the bone turns by more
than 20 degrees.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from scgs_warp.data import load
from scgs_warp.data.gltf.scene import read_scene
from scgs_warp.data.synthetic.figure_motion import BONES, bone_transforms
from scgs_warp.data.synthetic.from_mesh import span_of
from scgs_warp.data.synthetic.mesh import MeshSubject
from scgs_warp.data.synthetic.shading import Shading
from scgs_warp.edit import EditSession
from scgs_warp.edit.rotations import from_matrix, logarithm, rigid_fit, to_matrix
from scgs_warp.runtime.environment import configure
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.scene.scene import Scene
from scgs_warp.types import Gaussians

LEAST_TURN, LEAST_AXIS_TURN = 15.0, 20.0
"""Degrees."""
AXIS_SHARE = 0.8
"""Share of the variance of the turns about a true axis."""
INSTANTS = 21
COMPARED = 12
"""Number of instants at which tracks are compared with the bones' motions."""


class Bones(NamedTuple):
    """True skeleton: names, parents (-1: none), and bone-to-world [B, 4, 4] at a time in [0, 1]."""

    names: list[str]
    parents: list[int]
    at: Callable[[float], np.ndarray]


def figure_bones() -> Bones:
    names = list(BONES)
    parents = [-1 if BONES[name].parent is None else names.index(BONES[name].parent or "") for name in names]
    return Bones(names, parents, lambda time: np.stack([bone_transforms(time)[name] for name in names]))


def gltf_bones(path: Path, data: Path) -> Bones:
    """Take the bones of a file, in the world of the data set that was made of it."""
    recipe = json.loads((data / "synthesis.json").read_text())
    scene = read_scene(path, recipe["clip"])
    subject = MeshSubject(scene, span_of(scene, *recipe["seconds"]), Shading())
    nodes = sorted({bone.node for bone in scene.palette})
    parents = []
    for node in nodes:
        above = scene.nodes.parent[node]
        while above >= 0 and above not in nodes:
            above = scene.nodes.parent[above]
        parents.append(nodes.index(above) if above >= 0 else -1)

    def at(time: float) -> np.ndarray:
        world = scene.world_from_gltf @ scene.nodes.world(scene.clip, subject.seconds(time))[nodes]
        U, _, Vt = np.linalg.svd(world[:, :3, :3])
        world[:, :3, :3] = U @ Vt
        return world

    return Bones([scene.nodes.nodes[node].name or f"joint-{node}" for node in nodes], parents, at)


def relative_turns(bones: Bones, bone: int) -> np.ndarray:
    """Return the rotation of a bone against its parent at all instants, [T, 3, 3]."""
    poses = [bones.at(float(time))[:, :3, :3] for time in np.linspace(0.0, 1.0, INSTANTS)]
    return np.stack([pose[bones.parents[bone]].T @ pose[bone] for pose in poses])


def largest_turn(turns: np.ndarray) -> float:
    traces = np.einsum("aij,bij->ab", turns, turns)
    return math.degrees(math.acos(max(-1.0, min(1.0, (traces.min() - 1.0) / 2.0))))


def main_axis(turns: np.ndarray, frame: np.ndarray) -> np.ndarray | None:
    """Return the axis of relative rotations in the world at time 0; None if there is no single one."""
    U, _, Vt = np.linalg.svd(turns.mean(0))
    vectors = logarithm(from_matrix(turns @ (U @ Vt).T))
    values, axes = np.linalg.eigh(vectors.T @ vectors)
    return frame @ axes[:, 2] if values[2] > AXIS_SHARE * values.sum() else None


def true_labels(bones: Bones, points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the bone whose motion explains each track [T, P, 3] best, [P]."""
    chosen = np.linspace(0, len(times) - 1, COMPARED).astype(int)
    back, errors = np.linalg.inv(bones.at(float(times[chosen[0]]))), 0.0
    for row in chosen:
        moves = bones.at(float(times[row])) @ back
        placed = np.einsum("bij,pj->bpi", moves[:, :3, :3], points[chosen[0]]) + moves[:, None, :3, 3]
        errors = errors + ((placed - points[row]) ** 2).sum(2)
    return np.asarray(errors).argmin(0)


class Surface(NamedTuple):
    """Points of the true surface that a training view sees, and the Gaussians nearest to them."""

    bone: np.ndarray
    """[P] true bone; bones that hardly turn count as their parents."""
    part: np.ndarray
    """[P] part of the nearest Gaussian."""
    tracked: np.ndarray
    """[P] bone whose motion explains the nearest Gaussian's track best."""
    tracks: np.ndarray
    """[T, P, 3] nearest Gaussians at the compared instants."""


def rows_of(run: Path, bones: Bones, data: Path) -> list[dict[str, Any]]:
    with np.load(data / "ground_truth.npz") as truth:
        seen = truth["visible"].any(0)
        visible = truth["visible"][:, seen]
        points, times, height = truth["points"][:, seen].astype(np.float64), truth["times"], float(truth["height"])
    turns = [largest_turn(relative_turns(bones, b)) if p >= 0 else 180.0 for b, p in enumerate(bones.parents)]
    whole = list(range(len(bones.names)))
    for bone in sorted(whole, key=lambda b: _depth(bones, b)):
        if turns[bone] < LEAST_TURN:
            whole[bone] = whole[bones.parents[bone]]
    session = EditSession(Scene.load(run, device="cpu"))
    begin = time.process_time()
    skeleton = session._find(None)
    seconds = time.process_time() - begin
    session._found[None] = skeleton
    surface = _surface(session, bones, np.array(whole), points, times)
    table = np.zeros((len(skeleton.parts), len(whole)), np.int64)
    np.add.at(table, (surface.part, surface.bone), 1)
    parts, own = linear_sum_assignment(-table)
    matched = {int(b): int(p) for p, b in zip(parts, own) if table[p, b] > 0}
    bone_of = np.full(len(skeleton.parts), -1)
    bone_of[parts] = own
    shown_at = [frame.time for frame in load(data).entries]
    counts = counts_of(visible, np.array(shown_at), times)
    rows: list[dict[str, Any]] = [{
        "run": run.name, "bone": "all", "agreement": float(table[parts, own].sum() / len(surface.bone)),
        "parts": len(skeleton.parts), "bones": len(np.unique(surface.bone)), "seconds": seconds,
        "tracked": float((surface.tracked == surface.bone).mean()),
        "seen_agreement": seen_agreement(session, bone_of, surface.bone, points, times, counts),
    }]  # fmt: skip
    start = bones.at(0.0)
    for bone in np.unique(surface.bone).tolist():
        above = whole[bones.parents[bone]] if bones.parents[bone] >= 0 else -1
        mine, has = surface.bone == bone, matched.get(bone, -1)
        row: dict[str, Any] = {
            "run": run.name, "bone": bones.names[bone], "points": float(mine.mean()),
            "agreement": float((surface.part[mine] == has).mean()),
            "tracked": float((surface.tracked[mine] == bone).mean()),
        }  # fmt: skip
        if (surface.bone == above).any():
            row["turn"], row["trained_turn"] = turns[bone], _trained_turn(surface, bone, above)
        if bone in matched and above in matched:
            one, other = skeleton.parts[has], skeleton.parts[matched[above]]
            joint = one if one.parent == other.name else other if other.parent == one.name else None
            row["found"] = joint is not None
            if joint is not None:
                row["joint_error"] = 100.0 * float(np.linalg.norm(joint.joint - start[bone, :3, 3])) / height
                axis = main_axis(relative_turns(bones, bone), start[bones.parents[bone], :3, :3])
                if axis is not None and joint.axis is not None and turns[bone] > LEAST_AXIS_TURN:
                    row["axis_error"] = math.degrees(math.acos(min(1.0, abs(float(np.dot(axis, joint.axis))))))
        rows.append(row)
    return rows


def counts_of(visible: np.ndarray, shown_at: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return in how many views each point is seen nearest to each of ``times``, [T, P].

    Args:
        visible: [V, P] whether a view shows a point.
        shown_at: [V] times of the views.
    """
    counts = np.zeros((len(times), visible.shape[1]), np.int64)
    np.add.at(counts, np.abs(shown_at[:, None] - times).argmin(1), visible)
    return counts


def seen_agreement(
    session: EditSession,
    bone_of: np.ndarray,
    bone: np.ndarray,
    points: np.ndarray,
    times: np.ndarray,
    counts: np.ndarray,
) -> float:
    """Return the share of seen points whose nearest Gaussian at that instant belongs to the part of their bone.

    Args:
        bone_of: bone of each part, -1: none.
        bone: [P] true bone of each point.
        points: [T, P, 3]
        counts: [T, P] in how many views each is seen.
    """
    right, parts = 0, session.gaussian_parts()
    for time_, places, count in zip(times, points, counts):
        nearest = nearest_gaussians(session.scene.gaussians_at(float(time_)), places)
        right += int(count[bone_of[parts[nearest]] == bone].sum())
    return right / int(counts.sum())


def nearest_gaussians(gaussians: Gaussians, points: np.ndarray) -> np.ndarray:
    """Return the opaque Gaussian nearest to each of ``points`` [P, 3]."""
    solid = np.flatnonzero((gaussians.opacities > 0.5).cpu().numpy())
    return solid[cKDTree(gaussians.means.double().cpu().numpy()[solid]).query(points)[1]]


def _surface(session: EditSession, bones: Bones, whole: np.ndarray, points: np.ndarray, times: np.ndarray) -> Surface:
    """Compare the true surface's tracks [T, P, 3] with the nearest Gaussians.

    Args:
        whole: [B] the bone as which each counts.
    """
    nearest = nearest_gaussians(session.scene.gaussians_at(float(times[0])), points[0])
    instants = times[np.linspace(0, len(times) - 1, COMPARED).astype(int)]
    tracks = np.stack([session.scene.gaussians_at(float(t)).means[nearest].double().cpu().numpy() for t in instants])
    return Surface(
        whole[true_labels(bones, points, times)], session.gaussian_parts()[nearest],
        whole[true_labels(bones, tracks, instants)], tracks,
    )  # fmt: skip


def _trained_turn(surface: Surface, bone: int, parent: int) -> float:
    """Return the largest turn of a bone's Gaussians against those of its parent, degrees."""
    own, base = (
        np.stack([to_matrix(rigid_fit(tracks[0], now)[0]) for now in tracks])
        for tracks in (surface.tracks[:, surface.bone == which] for which in (bone, parent))
    )
    return largest_turn(np.swapaxes(base, 1, 2) @ own)


def _depth(bones: Bones, bone: int) -> int:
    return 0 if bones.parents[bone] < 0 else 1 + _depth(bones, bones.parents[bone])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, nargs="+", required=True)
    parser.add_argument("--data", type=Path, required=True, help="folder with ground_truth.npz")
    parser.add_argument("--mesh", type=Path, help="the glTF file of which the data set was made")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    configure(1)
    bones = figure_bones() if options.mesh is None else gltf_bones(options.mesh, options.data)
    rows = [row for run in options.run for row in rows_of(run, bones, options.data)]
    for row in rows:
        print(" ".join(f"{key} {value:.3f}" if isinstance(value, float) else str(value) for key, value in row.items()))
    if options.json:
        origin = {"provenance": "measured", "command": command_line("benchmarks/parts.py", sys.argv[1:])}
        options.json.write_text(json.dumps({**origin, **provenance("cpu"), "rows": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
