"""Films of a scene in one call."""

from __future__ import annotations

import operator
from pathlib import Path
from typing import Literal

from ..errors import UserError
from ..geometry import cameras
from ..runtime.caller_settings import unaffected
from ..runtime.progress import progress
from ..scene.scene import Scene
from . import video
from .framing import framed
from .overlay import Painter


@unaffected
def turntable(
    scene: Scene,
    path: str | Path,
    *,
    frames: int = 120,
    size: int = 512,
    fps: float = 30.0,
    time: float | None = None,
    show: Literal["rgb", "depth", "alpha", "nodes", "trajectories"] = "rgb",
) -> Path:
    """Write a film of a scene; see :meth:`Scene.turntable`."""
    target = video.check_path(path)
    try:
        frames, size, fps = operator.index(frames), operator.index(size), float(fps)
        time = None if time is None else float(time)
    except (TypeError, ValueError):
        told = f"frames {frames!r}, size {size!r}, fps {fps!r}, time {time!r}"
        raise UserError(f"{told}: give whole numbers of frames and pixels, and numbers") from None
    if time is not None and not 0.0 <= time <= 1.0:
        raise UserError(f"time {time:g}: give a time from 0 to 1")
    if not 1 <= frames <= video.MAX_FRAMES or not 16 <= size <= 8192 or not video.SLOWEST <= fps <= 1000:
        raise UserError(
            f"frames {frames}, size {size}, fps {fps:g}: give 1 to {video.MAX_FRAMES:,}, 16 to 8192, and "
            f"{video.SLOWEST} to 1000"
        )
    path_cameras = cameras.turntable(framed(scene), frames, size, step=video.size_step(target))
    last = max(frames - 1, 1)
    views = [
        (camera.to(scene.device), index / last if time is None else time) for index, camera in enumerate(path_cameras)
    ]
    first = path_cameras[0]
    video.require_memory(target, first.width, first.height, frames, scene.device.type)
    painter = Painter(scene, show, views)
    with video.film(target, fps) as writer, progress(frames, "turntable") as bar:
        for camera, moment in views:
            writer.write(painter.paint(camera, moment))
            bar.advance()
    return target
