"""Files of Gaussians at one instant."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from ..edit import EditSession
from ..formats.gaussian_files import write_gaussians
from ..formats.gaussian_spz import check_positions
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
        check_positions(path, keep_finite(pose()).means.detach().cpu().double().numpy())


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
        Number of Gaussians, and a note on clipped values.
    """
    check_reach(path, lambda: compute(lambda: session.gaussians_at(time, at)))
    scene = plain_scene(session.scene, compute)
    gaussians = compute(lambda: keep_finite(session.drawn_with(scene).gaussians_at(time, at)))
    clipped = write_still(path, gaussians, up=scene.overview.up, antialiased=scene.config.antialiased)
    return len(gaussians.means), clipping(path, clipped)


def clipping(path: Path, clipped: int) -> str:
    """Return a note on clipped values; empty if there are none."""
    return f" ({clipped:,} values clipped to what {output_suffix(path)} can hold)" if clipped else ""


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
