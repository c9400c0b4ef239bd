"""Compare posed trained runs of the built-in figure with ray-cast pictures of the same pose.

    python benchmarks/posing_pictures.py --run runs/figure-quick ... --json benchmarks/results/posing-pictures.json

At time 0 the left arm is turned about the shoulder, and the left shin about the knee, by 45 and 90 degrees: in the run
by ``EditSession.turn`` of the part that was found there (for the arm the topmost part of the forearm's chain, as in
``benchmarks/posing.py``), in the truth by the figure's own bones. Views are new. Rows
hold `run`, `limb`, `degrees`, `skin` (see ``Edit.skin``), `psnr`, and `psnr_unedited`, of the same views without the
turn. ``--bones`` takes the true bones as parts, which shows the skin alone.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any, get_args

import numpy as np
from provenance import ROOT

sys.path.insert(0, str(ROOT / "tests"))

from helpers.edit_scenes import bone_skeleton
from helpers.limb_bending import bones_of
from scgs_warp.data.synthetic.figure import build_figure
from scgs_warp.data.synthetic.figure_motion import BONES, bone_transforms
from scgs_warp.data.synthetic.raycast import Raycaster
from scgs_warp.data.synthetic.surface import RigidParts
from scgs_warp.edit import EditSession
from scgs_warp.edit.part_skin import SkinName
from scgs_warp.edit.rotations import from_axis, to_matrix
from scgs_warp.geometry.cameras import orbit_camera
from scgs_warp.runtime.environment import configure
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.scene.scene import Scene
from scgs_warp.storage.png_files import write_png
from scgs_warp.types import Camera

LIMBS = {
    "shoulder": ("shoulder_left", (0.0, -1.0, 0.0), "elbow_left"),
    "knee": ("knee_left", (1.0, 0.0, 0.0), None),
}
"""Bone that turns, the axis, and the end of a limb that turns as a whole."""
DEGREES = (45, 90)
AZIMUTHS = (-110.0, -70.0, -20.0, 35.0)
ELEVATION = 20.0


def turned_bones(bone: str, axis: Any, degrees: float) -> dict[str, np.ndarray]:
    """Return bone-to-world [4, 4] at time 0, one bone turned about its joint with all that hangs on it."""
    transforms = bone_transforms(0.0)
    pivot = transforms[bone][:3, 3]
    turn = np.eye(4)
    turn[:3, :3] = to_matrix(from_axis(axis, degrees))
    turn[:3, 3] = pivot - turn[:3, :3] @ pivot

    def hangs(name: str | None) -> bool:
        return name is not None and (name == bone or hangs(BONES[name].parent))

    return {name: turn @ matrix if hangs(name) else matrix for name, matrix in transforms.items()}


def truth(bones: dict[str, np.ndarray], views: list[Camera], samples: int = 3) -> list[np.ndarray]:
    """Return the ray-cast pictures on black, [H, W, 3] each."""
    caster = Raycaster(RigidParts(build_figure(), lambda time: bones))
    posed = caster.pose(0.0)
    return [caster.render(posed, view, samples)[..., :3].numpy() for view in views]


def pictures(session: EditSession, views: list[Camera]) -> list[np.ndarray]:
    return [session.render(view, 0.0, background=(0.0, 0.0, 0.0)).rgb.clamp(0, 1).numpy() for view in views]


def psnr(found: list[np.ndarray], wanted: list[np.ndarray]) -> float:
    return float(np.mean([-10.0 * np.log10(((a - b) ** 2).mean()) for a, b in zip(found, wanted)]))


def part_of(session: EditSession, node_bones: np.ndarray, bone: str) -> str:
    """Return the part that holds most of a bone's control points."""
    own = session.skeleton.owners()[node_bones == bone]
    return session.skeleton.names[int(np.bincount(own).argmax())]


def rows_of(run: Path, size: int, bones: bool, sheet: list[np.ndarray]) -> list[dict[str, Any]]:
    session = EditSession(Scene.load(run, device="cpu"))
    session._found[None] = session._find(None)  # the run's own may be of another version
    node_bones = bones_of(session)[0]
    if bones:
        session.edit = dataclasses.replace(session.edit, skeleton=bone_skeleton(node_bones.tolist()))
    views = [orbit_camera(session.scene.overview, azimuth, size, ELEVATION) for azimuth in AZIMUTHS]
    unedited, start, rows = pictures(session, views), session.edit, []
    plain = psnr(unedited, truth(bone_transforms(0.0), views))
    for limb, (bone, axis, end) in LIMBS.items():
        for degrees in DEGREES:
            wanted = truth(turned_bones(bone, axis, degrees), views)
            shown = [wanted]
            for skin in get_args(SkinName):
                session.edit = dataclasses.replace(start, skin=skin)
                part = part_of(session, node_bones, end or bone)
                session.turn(session.chain(part)[-1] if end else part, degrees, axis)
                found = pictures(session, views)
                shown.append(found)
                row = {"run": run.name, "limb": limb, "degrees": degrees, "skin": skin}
                rows.append({**row, "psnr": psnr(found, wanted), "psnr_unedited": plain})
                print(" ".join(str(x) for x in rows[-1].values()), flush=True)
            sheet.append(np.concatenate([np.concatenate(row, axis=1) for row in shown]))
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, nargs="+", required=True)
    parser.add_argument("--size", type=int, default=300, help="side of the pictures in pixels")
    parser.add_argument("--bones", action="store_true", help="the true bones as parts")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--sheet", type=Path, help="PNG: truth above the pictures with each skin")
    options = parser.parse_args()
    configure(1)
    sheet: list[np.ndarray] = []
    rows = [row for run in options.run for row in rows_of(run, options.size, options.bones, sheet)]
    if options.sheet:
        write_png(options.sheet, (np.concatenate(sheet).clip(0, 1) * 255 + 0.5).astype(np.uint8))
    if options.json:
        origin = {"provenance": "measured", "command": command_line("benchmarks/posing_pictures.py", sys.argv[1:])}
        options.json.write_text(json.dumps({**origin, **provenance("cpu"), "rows": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
