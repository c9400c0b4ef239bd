"""Output of a rig's capture: undistorted images of all cameras, with poses and times in nerfstudio's layout, and
points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from ...data.points import write_points
from ...geometry.rotation import OPENGL_TO_OPENCV
from ...runtime.progress import ShowProgress
from ...storage.json_files import write_json
from ...storage.png_files import write_png
from .. import pictures
from ..similarity import upright
from ..writing import FILE, POINTS, CapturedScene, Pinhole, as_held, pinhole_of
from .cameras import RigCamera, RigSolution
from .instants import TimeLine

FEW_CAMERAS = 4
"""Number of cameras below which none is held out, but every eighth instant of all."""
HELD_OUT_EVERY, HELD_OUT_FIRST = 8, 4

Maps = tuple[np.ndarray, np.ndarray]


def common_pinholes(cameras: dict[int, RigCamera]) -> dict[int, tuple[Pinhole, Maps]]:
    """Return each camera's pinhole, and the distorted coordinates of its pixels (``writing.pinhole_of``). All pinholes
    have the size of the smallest, cut from the middle."""
    own = {number: pinhole_of(camera) for number, camera in cameras.items()}
    width, height = min(p.width for p, _, _ in own.values()), min(p.height for p, _, _ in own.values())
    made = {}
    for number, (pinhole, x, y) in own.items():
        left, top = (pinhole.width - width) // 2, (pinhole.height - height) // 2
        cut = slice(top, top + height), slice(left, left + width)
        moved = Pinhole(pinhole.fx, pinhole.fy, pinhole.cx - left, pinhole.cy - top, width, height)
        made[number] = moved, (np.ascontiguousarray(x[cut]), np.ascontiguousarray(y[cut]))
    return made


def image_name(camera: str, instant: int) -> str:
    """Return the path of a frame in the data set."""
    return f"images/{camera}_{instant:05d}.png"


def write_rig(
    folder: Path,
    solved: RigSolution,
    points: tuple[np.ndarray, np.ndarray],
    names: list[str],
    line: TimeLine,
    held_out: str,
    picture: Callable[[int, int], np.ndarray],
    show: ShowProgress,
    turns: Sequence[int] = (),
) -> None:
    """Write ``images/``, ``points.ply``, a plot of the cameras, and then ``transforms.json``, whose presence marks a
    complete folder.

    Args:
        points: points and colours of the first instant, in the frame of ``solved``.
        names: names of all cameras, by number.
        held_out: name of the camera for ``test``.
        picture: function from the numbers of a camera and an instant to the recorded image.
        show: shows progress.
        turns: quarter turns of the pictures of all cameras, by number; empty without any.
    """
    (folder / "images").mkdir(exist_ok=True)
    pinholes = common_pinholes(solved.cameras)
    all_points, colors = np.concatenate([solved.points, points[0]]), np.concatenate([solved.colors, points[1]])
    viewmats = np.stack([camera.viewmat for camera in solved.cameras.values()])
    moved = upright(as_held(viewmats, [turns[number] for number in solved.cameras if turns]), all_points)
    turned = dict(zip(solved.cameras, moved.viewmats(viewmats)))
    instants, times = len(line.seconds), line.times(list(solved.cameras))
    frames, splits = [], {"train": [], "test": []}
    with show(len(solved.cameras) * instants, "undistorting") as bar:
        for number, (p, (x, y)) in pinholes.items():
            lens = {"w": p.width, "h": p.height, "fl_x": p.fx, "fl_y": p.fy, "cx": p.cx, "cy": p.cy}
            matrix = (np.linalg.inv(turned[number]) @ OPENGL_TO_OPENCV).tolist()
            for instant in range(instants):
                name = image_name(names[number], instant)
                image = cv2.remap(picture(number, instant), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
                write_png(folder / name, image)
                splits[_split(number, instant, names, held_out, len(pinholes))].append(name)
                frames.append(
                    {
                        "file_path": name,
                        "transform_matrix": matrix,
                        "time": float(times[number, instant]),
                        "seconds": float(line.moments[number, instant]),
                        "camera": names[number],
                        **lens,
                    }
                )
                bar.advance()
    write_points(folder / POINTS, moved.points(all_points), colors)
    scene = _first_instant(turned, line, names, next(iter(pinholes.values()))[0], moved.points(all_points), colors)
    pictures.cameras(folder / "cameras.png", scene)
    content = {
        "camera_model": "PINHOLE",
        "ply_file_path": POINTS,
        "frames": frames,
        "train_filenames": splits["train"],
        "test_filenames": splits["test"],
    }
    write_json(folder / FILE, content)


def _first_instant(
    viewmats: dict[int, np.ndarray],
    line: TimeLine,
    names: list[str],
    pinhole: Pinhole,
    points: np.ndarray,
    colors: np.ndarray,
) -> CapturedScene:
    """Return the cameras at the first instant, for their plot."""
    seconds = [float(line.moments[number, 0]) for number in viewmats]
    labels = [names[number] for number in viewmats]
    return CapturedScene(pinhole, np.stack([*viewmats.values()]), [0.0] * len(labels), seconds, labels, points, colors)


def _split(number: int, instant: int, names: list[str], held_out: str, count: int) -> str:
    """Return the split of a frame: one camera is held out or, of few cameras, every eighth instant."""
    if count < FEW_CAMERAS:
        return "test" if instant % HELD_OUT_EVERY == HELD_OUT_FIRST else "train"
    return "test" if names[number] == held_out else "train"
