"""Files of Gaussians at one instant."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..edit import EditSession
from ..formats.gaussian_files import write_gaussians
from ..formats.gaussian_spz import check_positions, coarse_step
from ..geometry.axes import Axis, direction
from ..types import Gaussians
from .finite import keep_finite
from .glb import write_glb
from .plain import at_once, plain_scene
from .request import output_suffix

FILE_UP: Axis = "-y"
"""Up direction of Gaussians from files, which do not state it."""


def check_reach(path: Path, pose: Callable[[], Gaussians]) -> None:
    """Check that the format can hold the positions of the Gaussians that ``pose`` returns, before others are fitted in
    their place, which takes seconds.

    Raises:
        UserError: it cannot.
    """
    if output_suffix(path) == ".spz":
        check_positions(path, _positions(keep_finite(pose())))


def _positions(gaussians: Gaussians) -> np.ndarray:
    return gaussians.means.detach().cpu().double().numpy()


def write_edited(
    path: Path,
    session: EditSession,
    time: float,
    at: float | None,
    compute: Callable[[Callable[[], Any]], Any] = at_once,
) -> tuple[int, str]:
    """Write a moment of an edit, fitting Gaussians in place of sharp ones, as :func:`export` does with ``--at``.

    Args:
        time, at: as for ``EditSession.gaussians_at``.
        compute: as for ``plain_scene``; it is called once more than there, for a .spz twice.

    Returns:
        Number of Gaussians, and a note on what the format loses.
    """
    check_reach(path, lambda: compute(lambda: session.gaussians_at(time, at)))
    scene = plain_scene(session.scene, compute)
    gaussians = compute(lambda: keep_finite(session.drawn_with(scene).gaussians_at(time, at)))
    clipped = write_still(path, gaussians, up=scene.overview.up, antialiased=scene.config.antialiased)
    return len(gaussians.means), losses(path, gaussians, clipped)


def losses(path: Path, gaussians: Gaussians, clipped: int) -> str:
    """Return a note on clipped values and on positions that the format rounds visibly; empty if there are none."""
    suffix = output_suffix(path)
    notes = [f"{clipped:,} values clipped to what {suffix} can hold"] if clipped else []
    step = coarse_step(_positions(gaussians)) if suffix == ".spz" else None
    if step is not None:
        notes.append(f"positions rounded to {step:.2g}, which shows in this scene; a .ply is exact")
    return f" ({'; '.join(notes)})" if notes else ""


def write_still(
    path: Path,
    gaussians: Gaussians,
    *,
    up: tuple[float, float, float] = direction(FILE_UP),
    antialiased: bool = False,
    spz_version: Literal[3, 4] = 4,
) -> int:
    """Write activated Gaussians, world units, in the format of the longest suffix: .glb, or one of
    ``gaussian_files.READERS``.

    Args:
        up: unit vector, used by .glb alone.
        antialiased, spz_version: as for :func:`~scgs_warp.formats.gaussian_files.write_gaussians`.

    Returns:
        Number of values clipped to the range of the format.

    Raises:
        UserError: the suffix is none of these, or the file cannot be written.
    """
    if path.suffix.lower() != ".glb":
        return write_gaussians(path, gaussians, antialiased=antialiased, spz_version=spz_version)
    write_glb(path, gaussians, up)
    return 0
