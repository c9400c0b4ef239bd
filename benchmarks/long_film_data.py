"""The film of ``long_film.py``: the built-in figure for 1,000 frames, and its quarters as data sets of their own."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from scgs_warp.data.synthetic.builtin import FIELD_OF_VIEW, RADIUS, SINE_OF_ELEVATION, FigureSubject, random_camera
from scgs_warp.data.synthetic.figure_motion import BONES, joint_angles
from scgs_warp.data.synthetic.joints import pose_joints
from scgs_warp.data.synthetic.orbit_cameras import PlannedPicture, instants, surrounding
from scgs_warp.data.synthetic.raycast import Raycaster
from scgs_warp.data.synthetic.renderer import Optics, write_pictures
from scgs_warp.data.synthetic.surface import RigidParts
from scgs_warp.storage.output_folders import write_folder_atomically

ACTS = 4
"""Number of times that a joint of the long film goes through its motion of the short one, forth or back."""
FRAMES, SIZE, SAMPLES = 1_000, (480, 270), 2
TEST_PER_ACT = 15
SEAM_CAMERAS = 6
SEAM_OFFSETS = (-0.25, -0.02, -0.005, 0.005, 0.02, 0.25)
"""Distances from a border, in acts, at which the same cameras look: the outer ones show how it is elsewhere."""


def long_transforms(time: float) -> dict[str, np.ndarray]:
    """Return the bones at ``time`` in [0, 1] of the long film. Every joint goes forth and back at its own pace, so that
    no pose of all joints returns."""
    angles = {}
    for index, bone in enumerate(joint_angles(0.0)):
        pace = 0.85 + 0.3 * (index * 0.618034 % 1.0)
        own = 0.5 - 0.5 * math.cos(math.pi * (pace * ACTS * time + 0.4 * (index * 0.414214 % 1.0)))
        angles[bone] = joint_angles(own)[bone]
    turn = 2.0 * math.pi * ACTS * time
    shift = (0.03 * math.sin(0.9 * turn), 0.0, 0.035 * math.cos(1.9 * turn))
    return pose_joints(BONES, angles, shift)


class LongFigure(FigureSubject):
    """The built-in figure, moving as ``long_transforms`` says."""

    def __init__(self) -> None:
        super().__init__()
        self.surface = RigidParts(self.figure, long_transforms)
        self.raycaster = Raycaster(self.surface, self.device, None)
        self.pose, self.render, self.visible = self.raycaster.pose, self.raycaster.render, self.raycaster.visible


def plan(frames: int, wide: float) -> dict[str, list[PlannedPicture]]:
    """Plan training frames from all sides, test frames between them from elsewhere, and the frames at borders.

    Args:
        wide: width of the pictures by their height, and so the factor by which cameras stand farther away.
    """
    rng = np.random.default_rng(0)
    train = surrounding(frames, SINE_OF_ELEVATION, RADIUS * wide, 0.0)

    def camera() -> np.ndarray:
        matrix = random_camera(rng)
        matrix[:3, 3] *= wide
        return matrix

    tests = ACTS * TEST_PER_ACT
    held_out = [PlannedPicture((index + 0.5) / tests, camera(), 0) for index in range(tests)]
    for border in range(1, ACTS):
        for matrix in [camera() for _ in range(SEAM_CAMERAS)]:
            held_out += [PlannedPicture((border + offset) / ACTS, matrix, 0) for offset in SEAM_OFFSETS]
    return {"train": [PlannedPicture(t, m, 0) for t, m in zip(instants(frames), train)], "test": held_out}


def make_film(folder: Path, frames: int = FRAMES, size: tuple[int, int] = SIZE) -> None:
    """Make the data set of the whole film, unless it exists."""
    if folder.exists():
        return
    subject = LongFigure()
    points = subject.sample(500, np.random.default_rng(0))
    optics, pictures = Optics(FIELD_OF_VIEW, *size, SAMPLES), plan(frames, size[0] / size[1])

    def write(work: Path) -> None:
        write_pictures(work, subject, points, pictures, optics, lambda: None)

    write_folder_atomically(folder, write)


def make_part(film: Path, act: int, folder: Path) -> None:
    """Make the data set of one quarter of the film, unless it exists: times go from 0 to 1 again."""
    if folder.exists():
        return

    def write(work: Path) -> None:
        for split in ("train", "test"):
            (work / split).mkdir()
            content: dict[str, Any] = json.loads((film / f"transforms_{split}.json").read_text())
            kept = [frame for frame in content["frames"] if act / ACTS <= frame["time"] <= (act + 1) / ACTS]
            for frame in kept:
                name = frame["file_path"].removeprefix("./") + ".png"
                os.link(film / name, work / name)
                frame["time"] = frame["time"] * ACTS - act
            (work / f"transforms_{split}.json").write_text(json.dumps({**content, "frames": kept}, indent=1) + "\n")

    write_folder_atomically(folder, write)


def repeat(film: Path, frames: int, folder: Path) -> None:
    """Make a data set of ``frames`` frames from the training pictures of another, over and over, unless it exists."""
    if folder.exists():
        return

    def write(work: Path) -> None:
        for split, count in (("train", frames), ("test", 1)):
            (work / split).mkdir()
            content: dict[str, Any] = json.loads((film / f"transforms_{split}.json").read_text())
            made = []
            for index in range(count):
                frame = dict(content["frames"][index % len(content["frames"])])
                name = f"{split}/r_{index:03d}"
                os.link(film / (frame["file_path"] + ".png"), work / f"{name}.png")
                made.append({**frame, "file_path": f"./{name}", "time": index / max(count - 1, 1)})
            (work / f"transforms_{split}.json").write_text(json.dumps({**content, "frames": made}, indent=1) + "\n")

    write_folder_atomically(folder, write)
