"""Edit a pose: take some control points, move them, and the scene bends with them.

The script lifts the part that moves most (an arm), and writes before and after side by side. Everything more than two
edges of the control graph away stays. The edit is saved as JSON: `apps/edit.py --run RUN --script edit.json` plays it.

    python examples/01_train_builtin.py
    python examples/04_edit_a_pose.py
"""

from __future__ import annotations

from pathlib import Path

import torch
import tyro
from PIL import Image

import scgs_warp
from scgs_warp.edit import EditSession
from scgs_warp.geometry.cameras import orbit_camera


def main(
    run: Path = Path("runs/example"),
    output: Path = Path("edited.png"),
    edit: Path = Path("edit.json"),
    time: float = 0.5,
    lift: float = 0.3,
    size: int = 256,
) -> None:
    """Lift the part that moves most.

    Args:
        run: folder of a run.
        output: image of before and after.
        edit: file of the saved edit.
        time: moment of the scene, from 0 to 1.
        lift: distance upwards in world units.
        size: longer side of each image in pixels.
    """
    session = EditSession(scgs_warp.Scene.load(run))
    travel = torch.stack([session.scene.control_points_at(t / 10) for t in range(11)]).std(dim=0).norm(dim=1)
    grip = session.ring([int(travel.argmax())], 1)  # that control point and its neighbours

    arm = session.add_handle(grip, time, name="arm")
    session.pin_rest(rings=2)
    up = session.scene.overview.up
    session.move(arm.name, translation=[lift * x for x in up])
    session.save(edit)

    camera = orbit_camera(session.scene.overview, session.scene.overview.azimuth, size)
    pair = [session.scene.render(camera, time).rgb, session.render(camera, time).rgb]
    Image.fromarray((torch.cat(pair, dim=1).clamp(0.0, 1.0) * 255.0).byte().numpy()).save(output)
    print(f"{output}: {len(grip)} of {len(session)} control points lifted by {lift:g}; {edit}: the edit")


if __name__ == "__main__":
    tyro.cli(main)
