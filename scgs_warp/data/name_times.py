"""Times in the names of images: counters, clocks, seconds since 1970."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import datetime
from fractions import Fraction
from pathlib import PurePosixPath

CAMERA = re.compile(r"(?:camera|cam|view)[ _-]?[0-9]+|(?:left|right)[0-9]{1,2}(?![0-9])", re.IGNORECASE)
"""Number of a camera in a name, such as ``0001_cam2``."""
COPY = re.compile(r" ?\([0-9]+\)$|~[0-9]+$")
"""Number of a copy at the end of a name, such as ``IMG_0001 (1)`` and ``IMG_0001~2``."""
DATE = re.compile(
    r"(?<![0-9])((?:19|20)[0-9]{2})([-_.]?)([01][0-9])\2([0-3][0-9])(?:[-_ .T]*| at )"
    r"([0-2][0-9])[-_.:h]?([0-5][0-9])[-_.:m]?([0-5][0-9])"
    r"(?:\.?([0-9]{1,9})|[-_,]([0-9]{3}|[0-9]{6}|[0-9]{9})|)(?![0-9])"
)
"""Date and time of day, with decimals of the second."""
CLOCK = re.compile(r"(?<![0-9])([0-9]{1,3})[h:]([0-5][0-9])[m:]([0-5][0-9](?:\.[0-9]{1,9})?)")
"""Time since the beginning of a film."""
STAMP = re.compile(
    r"(?<![0-9])([0-9]{1,9}(?=[_-][0-9]{9}(?![0-9]))|[12][0-9]{9}(?=[_-][0-9]{1,9}(?![0-9])))[_-]([0-9]+)"
)
"""Seconds, and the nanoseconds, microseconds or milliseconds after them, as ROS writes them."""
SECONDS = re.compile(r"(?:.*[^0-9.A-Za-z])?([0-9]{1,15}\.[0-9]{1,15})s?")
"""Names that end with a decimal, which no letter precedes: ``cam1.0002`` is a camera and a frame."""


def times_from_names(names: list[str]) -> list[float]:
    """Return times in [0, 1]: from the names if they tell them, else from the order."""
    moments = moments_in_names(names)
    if moments is None:
        return [index / max(len(names) - 1, 1) for index in range(len(names))]
    first, last = min(moments), max(moments)
    return [float((moment - first) / (last - first)) for moment in moments]


def moments_in_names(names: list[str]) -> list[Fraction] | None:
    """Return the moment that each name tells, in some unit; None if not all tell one, or all tell the same.

    It is a date with a time of day, a time since the beginning, or seconds and their parts, wherever it is in the name,
    if all names have it and it differs by seconds. Names that end with decimals, such as ``1311868164.363181``, have
    their times in seconds. Of other names it is the last number, or one before it that has more digits and more
    values. A number after ``cam``, ``camera``, ``view``, ``left`` or ``right`` is that of a camera and one such as
    ``(1)`` or ``~2`` that of a copy, unless the names have no other.
    """
    stems = [PurePosixPath(name).stem for name in names]
    for label in (COPY, CAMERA):
        bare = [label.sub("", stem) for stem in stems]
        numbers = [re.findall("[0-9]+", stem) for stem in bare]
        if all(numbers) and len({tuple(each) for each in numbers}) > 1:
            stems = bare
    for pattern, moment in ((DATE, _of_date), (CLOCK, _of_clock), (STAMP, _of_stamp(stems)), (SECONDS, _of_seconds)):
        found = [pattern.search(stem) if pattern is not SECONDS else pattern.fullmatch(stem) for stem in stems]
        moments = [moment(match) for match in found if match is not None]
        known = [each for each in moments if each is not None]
        if len(known) == len(names) and len({int(each) for each in known}) > 1:  # else, 2.9 comes before 2.10
            return known
    return _counted(stems)


def _counted(stems: list[str]) -> list[Fraction] | None:
    groups = [re.findall("[0-9]+", stem) for stem in stems]
    if not all(groups):
        return None
    column = -1
    if len({len(each) for each in groups}) == 1:

        def rank(place: int) -> tuple[int, int]:
            texts = [each[place] for each in groups]
            return len(set(texts)), min(map(len, texts))

        for place in range(-2, -len(groups[0]) - 1, -1):
            values, digits = rank(place)
            if values > rank(column)[0] and digits > rank(column)[1]:
                column = place
    numbers = [Fraction(each[column]) for each in groups]
    return numbers if len(set(numbers)) > 1 else None


def _of_date(match: re.Match[str]) -> Fraction | None:
    year, month, day, hour, minute, second = (int(match[group]) for group in (1, 3, 4, 5, 6, 7))
    try:
        passed = datetime(year, month, day, hour, minute, second) - datetime(1970, 1, 1)
    except ValueError:
        return None
    decimals = match[8] or match[9] or "0"
    return passed.days * 86400 + passed.seconds + Fraction(f"0.{decimals}")


def _of_clock(match: re.Match[str]) -> Fraction:
    return int(match[1]) * 3600 + int(match[2]) * 60 + Fraction(match[3])


def _of_stamp(stems: list[str]) -> Callable[[re.Match[str]], Fraction]:
    """Return the reader of stamps: the longest part of a second tells the unit of all, which need not begin with
    zeros."""
    parts = [len(match[2]) for stem in stems if (match := STAMP.search(stem))]
    unit = 10 ** (3 * -(-max(parts, default=1) // 3))
    return lambda match: int(match[1]) + Fraction(int(match[2]), unit)


def _of_seconds(match: re.Match[str]) -> Fraction:
    return Fraction(match[1])
