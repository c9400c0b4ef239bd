"""Settings of a film, and their check."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ....errors import UserError

FilmKind = Literal["phone", "rig"]
FILM_KINDS: tuple[FilmKind, ...] = ("phone", "rig")
MAX_FRAMES = 20_000


@dataclass(frozen=True)
class FilmRequest:
    """Settings of a film: everything that determines its bytes."""

    kind: FilmKind = "phone"
    subject: str = "robot"
    width: int = 640
    height: int = 360
    seconds: float = 6.0
    fps: float = 30.0
    fov: float = 65.0
    """Horizontal field of view, degrees."""
    arc: float = 100.0
    """Angle in degrees about the subject across which the cameras of a rig stand, or a walk with the phone leads."""
    samples: int = 3
    """Number of rays per pixel along each axis."""
    shake: float = 1.0
    """Strength of the hand's movements."""
    blur: float = 0.0
    """Share of the time between two frames in which the shutter is open; 0: no motion blur."""
    rolling: float = 0.0
    """Share of the time between two frames from the first to the last row; 0: all rows at once."""
    exposure: float = 0.0
    """Largest relative change of the exposure."""
    balance: float = 0.0
    """Largest relative change of red and blue against green."""
    crf: int = 20
    """x264's constant rate factor."""
    views: int = 6
    """Number of cameras of a rig."""
    offsets: float = 0.0
    """Largest difference, in seconds, between the moments at which two cameras of a rig begin."""
    sound: bool = True
    """Record sound: claps that all cameras hear."""
    test: int = 20
    """Number of held-out views of a phone's data set."""
    maps: bool = False
    """Also write depth, flow and masks of every frame; a phone's data set names the depth maps."""
    depth_error: float = 0.0
    """Relative error of the depth maps of a phone's data set."""
    seed: int = 0


def check(request: FilmRequest) -> None:
    """Check the values of a request.

    Raises:
        UserError: naming the option, its value and the remedy.
    """
    if request.width % 2 or request.height % 2 or not (64 <= min(request.width, request.height) <= 4096):
        raise UserError(f"--size {request.width} {request.height}: a film needs even numbers from 64 to 4096")
    if not 1.0 <= request.fps <= 240.0:
        raise UserError(f"--fps {request.fps:g}: give 1 to 240 frames per second")
    if not 8 <= request.seconds * request.fps <= MAX_FRAMES:
        raise UserError(f"--seconds {request.seconds:g}: give a film of 8 to {MAX_FRAMES} frames")
    if not 20.0 <= request.fov <= 110.0:
        raise UserError(f"--fov {request.fov:g}: give 20 to 110 degrees for a film")
    if not 1.0 <= request.arc <= 300.0:
        raise UserError(f"--arc {request.arc:g}: give 1 to 300 degrees")
    for name, most in (("shake", 10.0), ("blur", 1.0), ("rolling", 1.0), ("exposure", 1.0), ("balance", 1.0)):
        if not 0.0 <= getattr(request, name) <= most:
            raise UserError(f"--{name} {getattr(request, name):g}: give 0 to {most:g}")
    has_maps = request.maps and request.kind == "phone"
    if not 0.0 <= request.depth_error <= 1.0 or (request.depth_error and not has_maps):
        raise UserError(f"--depth-error {request.depth_error:g}: give 0 to 1, with --film phone --maps")
    if not 0 <= request.crf <= 51:
        raise UserError(f"--crf {request.crf}: give 0 (lossless) to 51")
    if request.kind == "rig" and not 2 <= request.views <= 100:
        raise UserError(f"--views {request.views}: give a rig 2 to 100 cameras")
    if not 0.0 <= request.offsets <= 10.0:
        raise UserError(f"--offsets {request.offsets:g}: give 0 to 10 seconds")
    if not 1 <= request.samples <= 16 or request.test < 1 or request.seed < 0:
        raise UserError("--samples: give 1 to 16; --test: at least 1; --seed: 0 or more")
