"""What to tell a user whose film gave too few cameras: the likeliest reason, and what helps."""

from __future__ import annotations

from typing import NamedTuple

from .features import Links

FEW_FEATURES = 150
"""Of a frame; below, there is nothing to recognise."""
FEW_INLIERS = 40
"""Between neighbours; below, they hardly show the same."""
LINKED = 0.8
TURNING = 0.97
"""Share of pairs of frames that one homography explains."""
LITTLE_ARC = 2.0
"""Degrees between rays to a point; below, depth is a guess."""
GOOD = 0.9
"""Share of registered frames that needs no word."""


class Outcome(NamedTuple):
    picked: int
    registered: int
    arc: float
    """Degrees; 0 without a model."""
    links: Links
    masked: float
    """Share of the pixels that masks hide."""


def reason(found: Outcome) -> str:
    """Why, and what helps, in one clause each."""
    links = found.links
    if links.features < FEW_FEATURES:
        return (
            f"there is little to recognise ({links.features} features a frame): film something with texture, in more "
            "light, or give a larger --size"
        )
    if found.masked > 0.3 and (links.linked < LINKED or links.inliers < FEW_INLIERS):
        return f"masks hide {100 * found.masked:.0f} % of the frames: give --masks none, or masks of your own"
    if links.linked < LINKED or links.inliers < FEW_INLIERS:
        return (
            f"frames that follow each other have little in common ({links.inliers} matches): give --frames "
            f"{2 * found.picked}, or film more slowly"
        )
    if links.planar > TURNING or (found.registered and found.arc < LITTLE_ARC):
        return "the camera turns but hardly moves: film from several places, walking sideways around the scene"
    if found.registered >= 2:
        return (
            "the film falls into parts that do not connect: give --matching exhaustive, or use a part (--start, --end)"
        )
    return "no two frames gave a beginning: give --fov if you know it, or film with more movement"


def too_few(folder: str, found: Outcome) -> str:
    """The line for a capture that failed."""
    accepted = found.registered / max(found.picked, 1)
    accept = f"; --least {int(100 * accepted) / 100:g} takes it as it is" if found.registered >= 3 else ""
    return (
        f"{folder}: {found.registered} of {found.picked} frames registered; {reason(found)}{accept} (what was made is "
        "kept, the same command goes on from it)"
    )


def notes(found: Outcome) -> list[str]:
    """What a user should know of a capture that did not fail."""
    lines = []
    if found.registered < GOOD * found.picked:
        lines.append(f"note: {found.picked - found.registered} frames have no camera; {reason(found)}")
    elif found.arc < LITTLE_ARC:
        lines.append(f"note: rays to a point differ by {found.arc:.1f} degrees only; depth will be uncertain")
    return lines
