"""Measure gestures of the editor on trained runs of the built-in figure, against its true joints.

    python benchmarks/posing.py --run runs/figure-quick ... --json benchmarks/results/posing.json

Each limb is put where a turn of its joint takes it, without pins:

- default: one click on the hand or foot, and one pull to where the turn takes it (`EditSession.pull`);
- part: the limb's topmost part turned about the joint that was found (`EditSession.turn`);
- point: one control point, moved there, and nothing else said;
- least: the rigid limb turned about its true joint by the least angle that puts the tip there, which is what a pull
  says about the limb. The turn about the line from joint to tip remains unknown, so that it errs, too.

Rows hold `run`, `limb`, `gesture`, `degrees`, and as ratios `worst_edge` (largest relative change of an edge),
`least_determinant`, `limb_error` (mean distance from the true turn, in limb lengths) and `torso_moved` (in heights).
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from provenance import ROOT

sys.path.insert(0, str(ROOT / "tests"))

from helpers.limb_bending import LIMBS, bones_of, measured
from scgs_warp.data.synthetic.figure_motion import bone_transforms
from scgs_warp.edit import EditSession
from scgs_warp.edit.rotations import from_axis, rotate
from scgs_warp.runtime.environment import configure
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.scene.scene import Scene

DEGREES = (45, 90, 135)


def rows_of(run: Path) -> list[dict[str, Any]]:
    """Measure all gestures on one run."""
    session = EditSession(Scene.load(run, device="cpu"))
    session._found[None] = session._find(None)  # the run's own may be of another version
    node_bones, solid, bones = bones_of(session)
    points = session.node_positions(0.0)
    rows = []
    for limb, (own, joint, axis) in LIMBS.items():
        pivot = bone_transforms(0.0)[joint][:3, 3]
        tip = np.flatnonzero(node_bones == own[-1])
        tip = int(tip[np.linalg.norm(points[tip] - pivot, axis=1).argmax()])
        for degrees in DEGREES:
            place = rotate(from_axis(axis, degrees), points[tip] - pivot) + pivot
            for gesture in ("default", "part", "point"):
                session.reset()
                _act(session, gesture, tip, place, degrees, axis)
                skeleton = session.edit.skeleton
                graph = session.graph if skeleton is None else session.engine.poser(skeleton).graph
                bent = measured(session, graph, node_bones, solid, bones, limb, degrees)
                rows.append({
                    "run": run.name, "limb": limb, "gesture": gesture, "degrees": degrees,
                    "worst_edge": bent.worst_edge, "least_determinant": bent.determinant, "limb_error": bent.error,
                    "torso_moved": bent.torso_moved,
                })  # fmt: skip
            error = _least_turn_error(session.scene, solid, np.isin(bones, own), pivot, points[tip], degrees, axis)
            rows.append({"run": run.name, "limb": limb, "gesture": "least", "degrees": degrees, "limb_error": error})
    return rows


def _least_turn_error(
    scene: Scene, solid: np.ndarray, limb: np.ndarray, pivot: np.ndarray, tip: np.ndarray, degrees: float, axis: Any
) -> float:
    """Return the mean distance between the limb's Gaussians after the true turn and after the least one that takes the
    tip to the same place, in limb lengths.

    Args:
        solid: [N] bool, opaque Gaussians; limb: of those, the limb's.
    """
    arms = scene.gaussians_at(0.0).means.double().numpy()[solid][limb] - pivot
    turn = from_axis(axis, degrees)
    before, after = tip - pivot, rotate(turn, tip - pivot)
    across = np.cross(before, after)
    angle = np.degrees(np.arctan2(np.linalg.norm(across), before @ after))
    apart = rotate(from_axis(across, angle), arms) - rotate(turn, arms)
    return float(np.linalg.norm(apart, axis=1).mean() / np.linalg.norm(arms, axis=1).max())


def _act(session: EditSession, gesture: str, tip: int, place: np.ndarray, degrees: float, axis: Any) -> None:
    start = session.node_positions(0.0)[tip]
    if gesture == "point":
        session.add_handle([tip], 0.0, "tip")
        session.move("tip", translation=(place - start).tolist())
        return
    part = next(part.name for part in session.parts() if tip in part.nodes)
    if gesture == "default":
        session.pull(part, place, grip=start)
    else:
        session.turn(session.chain(part)[-1], degrees, axis)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, nargs="+", required=True)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    configure(1)
    rows = [row for run in options.run for row in rows_of(run)]
    for row in rows:
        names = [name for name in ("worst_edge", "least_determinant", "limb_error", "torso_moved") if name in row]
        numbers = " ".join(f"{name} {row[name]:6.3f}" for name in names)
        print(f"{row['run']:16} {row['limb']:4} {row['gesture']:8} {row['degrees']:4}  {numbers}")
    if options.json:
        origin = {"provenance": "measured", "command": command_line("benchmarks/posing.py", sys.argv[1:])}
        content = {**origin, **provenance("cpu"), "rows": rows}
        options.json.write_text(json.dumps(content, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
