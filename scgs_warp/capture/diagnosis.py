"""What to tell a user whose film gave too few cameras: the likeliest reason, and what helps."""

from __future__ import annotations

from typing import NamedTuple

from .features import Links

MIN_FEATURES = 150
"""Of a frame; below, there is nothing to recognise."""
MIN_INLIERS = 40
"""Between neighbours; below, they hardly show the same."""
MIN_LINKED = 0.8
MAX_PLANAR = 0.97
"""Share of pairs of frames that one homography explains."""
MIN_ARC = 2.0
"""Degrees between rays to a point; below, depth is a guess."""
GOOD_SHARE = 0.9
"""Share of registered frames that needs no word."""


class Outcome(NamedTuple):
    picked: int
    registered: int
    arc: float
    """Degrees; 0 without a model."""
    links: Links
    masked: float
    """Share of the pixels that masks hide."""


def likely_reason(outcome: Outcome) -> str:
    """Why, and what helps, in one clause each."""
    links = outcome.links
    if links.features < MIN_FEATURES:
        return (
            f"there is little to recognise ({links.features} features a frame): film something with texture, in more "
            "light, or give a larger --size"
        )
    if outcome.masked > 0.3 and (links.linked < MIN_LINKED or links.inliers < MIN_INLIERS):
        return f"masks hide {100 * outcome.masked:.0f} % of the frames: give --masks none, or masks of your own"
    if links.linked < MIN_LINKED or links.inliers < MIN_INLIERS:
        return (
            f"frames that follow each other have little in common ({links.inliers} matches): give --frames "
            f"{2 * outcome.picked}, or film more slowly"
        )
    if links.planar > MAX_PLANAR or (outcome.registered and outcome.arc < MIN_ARC):
        return "the camera turns but hardly moves: film from several places, walking sideways around the scene"
    if outcome.registered >= 2:
        return (
            "the film falls into parts that do not connect: give --matching exhaustive, or use a part (--start, --end)"
        )
    return "no two frames gave a beginning: give --fov if you know it, or film with more movement"


def too_few(folder: str, outcome: Outcome) -> str:
    """The line for a capture that failed."""
    accepted = outcome.registered / max(outcome.picked, 1)
    accept = f"; --least {int(100 * accepted) / 100:g} takes it as it is" if outcome.registered >= 3 else ""
    return (
        f"{folder}: {outcome.registered} of {outcome.picked} frames registered; {likely_reason(outcome)}{accept} "
        "(what was made is kept, the same command goes on from it)"
    )


def notes(outcome: Outcome) -> list[str]:
    """What a user should know of a capture that did not fail."""
    lines = []
    if outcome.registered < GOOD_SHARE * outcome.picked:
        lines.append(f"note: {outcome.picked - outcome.registered} frames have no camera; {likely_reason(outcome)}")
    elif outcome.arc < MIN_ARC:
        lines.append(f"note: rays to a point differ by {outcome.arc:.1f} degrees only; depth will be uncertain")
    return lines
