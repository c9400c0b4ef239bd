"""Diagnosis of a capture in which too few frames got a camera: the likeliest cause and its remedy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from .features import Links

MIN_FEATURES = 150
"""Smallest useful number of features per frame."""
MIN_INLIERS = 40
"""Smallest useful number of inlier matches between consecutive frames."""
MIN_LINKED = 0.8
"""Smallest useful share of the pairs of consecutive frames that have matches."""
MAX_PLANAR = 0.97
"""Share of frame pairs explained by one homography; above it, the camera probably rotates without moving."""
STILL = 0.002
"""Motion of matches, as a share of the longer side, below which the camera stands still."""
MIN_ARC = 2.0
"""Smallest useful angle between the rays to a point, degrees; at smaller angles, depth is unreliable."""
WEAK_ARC = 4.0
"""Such an angle below which cameras may be missing although all frames that follow each other match."""
MAX_MASKED = 0.5
"""Share of masked pixels above which masks, and not a lack of texture, leave few features; masks that are found cover
less."""
STANDS_STILL = "the camera stands still, so that nothing tells depth"
WALK = "film from several places, walking sideways around the scene"
LONG = 0.05
"""Share of a film's time in which no frame has a camera, above which the user gets a note."""
GOOD_SHARE = 0.9
"""Share of registered frames above which the user gets no note."""


class Outcome(NamedTuple):
    """Result of a capture in numbers."""

    picked: int
    registered: int
    arc: float
    """Median angle between the rays to a point, degrees; 0 without a model."""
    links: Links
    masked: float
    """Share of pixels that are masked."""
    exhaustive: bool = False
    """True if each frame was matched with each."""
    whole: bool = False
    """True if the source has no further frames of use, so that a larger --frames would pick the same."""
    film: bool = True
    """False for a folder of images, of which --start and --end choose no part."""


def likely_reason(outcome: Outcome) -> str:
    """Return the likeliest cause of missing cameras, and its remedy."""
    links = outcome.links
    part = "(--start, --end)" if outcome.film else "of the images, in a folder of its own"
    if outcome.masked > MAX_MASKED and links.features < MIN_FEATURES:
        return (
            f"masks hide {100 * outcome.masked:.0f} % of the frames: they are black where something moves, and white "
            "elsewhere; invert them if they are not, or give --masks none"
        )
    if links.features < MIN_FEATURES:
        return (
            f"there is little to recognise ({links.features} features a frame): film something with texture, in more "
            "light, or give a larger --size"
        )
    if links.moved < STILL:
        return f"{STANDS_STILL}: {WALK}, or with several cameras"
    if outcome.masked > 0.3 and (links.linked < MIN_LINKED or links.inliers < MIN_INLIERS):
        return f"masks hide {100 * outcome.masked:.0f} % of the frames: give --masks none, or masks of your own"
    if links.linked < MIN_LINKED or links.inliers < MIN_INLIERS:
        more = "" if outcome.whole else f"give --frames {2 * outcome.picked}, "
        return (
            f"frames that follow each other have little in common ({links.inliers} matches): {more}film more slowly, "
            f"or use a part {'without cuts ' if outcome.film else ''}{part}"
        )
    if links.planar > MAX_PLANAR or (outcome.registered and outcome.arc < MIN_ARC):
        return f"the camera turns but hardly moves: {WALK}"
    if outcome.registered >= 2 and links.linked == 1.0 and outcome.arc < WEAK_ARC:
        return f"the camera hardly moves to the side, as when it goes straight ahead: {WALK}"
    if outcome.registered >= 2:
        more = f"give --frames {2 * outcome.picked}, or " if outcome.exhaustive else "give --matching exhaustive, or "
        if outcome.exhaustive and outcome.whole:
            more = ""
        parts = "the film falls" if outcome.film else "the images fall"
        return f"{parts} into parts that do not connect: {more}use a part {part}"
    return "no two frames gave a beginning: give --fov if you know it, or film with more movement"


def too_few(folder: str, outcome: Outcome) -> str:
    """Return the message for a failed capture."""
    accepted = outcome.registered / max(outcome.picked, 1)
    accept = f"; --least {int(100 * accepted) / 100:g} takes it as it is" if outcome.registered >= 3 else ""
    return (
        f"{folder}: {outcome.registered} of {outcome.picked} frames registered; {likely_reason(outcome)}{accept} "
        "(finished work is kept; the same command continues from it)"
    )


def notes(outcome: Outcome) -> list[str]:
    """Return notes on a successful capture."""
    lines = []
    if outcome.registered < GOOD_SHARE * outcome.picked:
        lines.append(f"note: {outcome.picked - outcome.registered} frames have no camera; {likely_reason(outcome)}")
    elif outcome.links.moved < STILL:
        lines.append(f"note: {STANDS_STILL}; the cameras found are those of what moves")
    elif outcome.links.planar > MAX_PLANAR:
        lines.append(
            "note: the camera turns or zooms but hardly moves, or it films something flat: unless it does, depth and "
            f"the places of the cameras are made up; {WALK}"
        )
    elif outcome.arc < MIN_ARC:
        lines.append(f"note: rays to a point differ by {outcome.arc:.1f} degrees only; depth will be uncertain")
    return lines


def unseen_ends(seconds: Sequence[float], span: tuple[float, float]) -> list[str]:
    """Return a note if no frame near the beginning or the end of a film has a camera.

    Args:
        seconds: times of the frames with a camera.
        span: times of the film's ends.
    """
    least, parts, options = LONG * (span[1] - span[0]), [], []
    if min(seconds) - span[0] > least:
        start = math.floor(100 * min(seconds)) / 100
        parts, options = [f"before second {start:g}"], [f"--start {start:g}"]
    if span[1] - max(seconds) > least:
        end = math.ceil(100 * max(seconds)) / 100
        parts, options = [*parts, f"after second {end:g}"], [*options, f"--end {end:g}"]
    if not options:
        return []
    return [
        f"note: no frame {' and '.join(parts)} has a camera, and training guesses the motion there; "
        f"{' '.join(options)} and another --output leave that out"
    ]


def unseen_between(seconds: Sequence[float], without: Sequence[float], span: tuple[float, float]) -> list[str]:
    """Return a note on the longest time between two frames with a camera, if frames in between should have one.

    Args:
        seconds: times of the frames with a camera, ascending.
        without: times of the other picked frames. Where there are none, the film repeats itself, and nothing is lost.
        span: times of the film's ends.
    """
    least = LONG * (span[1] - span[0])
    gaps = [
        (after - before, before, after)
        for before, after in pairwise(seconds)
        if after - before > least and any(before < second < after for second in without)
    ]
    if not gaps:
        return []
    _, before, after = max(gaps)
    end, start = math.ceil(100 * before) / 100, math.floor(100 * after) / 100
    return [
        f"note: no frame between seconds {end:g} and {start:g} has a camera, and training guesses the motion there; "
        f"--end {end:g} or --start {start:g}, with another --output, takes one part"
    ]
