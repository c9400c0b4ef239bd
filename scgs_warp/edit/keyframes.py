"""Interpolation of handles between keyframes. It acts on their translations and rotations, not on positions of control
points, so that a part which turns between two keyframes does not shrink."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal, get_args

import numpy as np

from .field_reader import FieldReader, check_record
from .handles import Target
from .rotations import IDENTITY, conjugate, exponential, logarithm, multiply, power, slerp, unit

Easing = Literal["smooth", "linear", "ease", "step"]

MAX_SECONDS = 3600.0
"""Largest time in a film, seconds."""


@dataclass(frozen=True)
class Keyframe:
    """Targets of handles at one moment of the film."""

    at: float
    """Time in the film, seconds."""
    targets: Mapping[str, Target] = field(default_factory=dict)
    """Targets by handle. A handle that is missing here is interpolated between the other keyframes."""
    easing: Easing = "smooth"
    """Interpolation to the next keyframe. smooth: without stopping at keyframes or overshooting them; linear: at
    constant speed; ease: from rest to rest; step: constant, then a jump."""

    def __post_init__(self) -> None:
        """Check and convert the fields.

        Raises:
            UserError: naming the field.
        """
        check_record(
            self, "keyframe", lambda node: {"targets": node.named_records("targets", Target), **keyframe_fields(node)}
        )


def keyframe_fields(node: FieldReader) -> dict[str, Any]:
    """Read all fields of a keyframe but its targets.

    Raises:
        UserError: naming the field.
    """
    at = node.number("at", None, 0.0, MAX_SECONDS)
    if at is None:
        raise node.wrong("at", "is missing", "give seconds from the film's beginning")
    return {"at": at, "easing": node.choice("easing", get_args(Easing), "smooth")}


def targets_at(keyframes: Sequence[Keyframe], at: float) -> dict[str, Target]:
    """Return every handle's target at a moment of the film, constant before its first keyframe and after its last."""
    names = sorted({name for frame in keyframes for name in frame.targets})
    ordered = sorted(keyframes, key=lambda frame: frame.at)
    return {name: _track_at([frame for frame in ordered if name in frame.targets], name, at) for name in names}


def _track_at(frames: list[Keyframe], name: str, at: float) -> Target:
    if at <= frames[0].at:
        return frames[0].targets[name]
    if at >= frames[-1].at:
        return frames[-1].targets[name]
    times = np.array([frame.at for frame in frames])
    i = int(np.searchsorted(times, at, side="right")) - 1
    span = times[i + 1] - times[i]
    share = float((at - times[i]) / span)
    easing = frames[i].easing
    first, second = frames[i].targets[name], frames[i + 1].targets[name]
    if easing == "step" or share == 0.0 or first == second:
        return first
    moves = np.array([frame.targets[name].translation for frame in frames])
    turns = _aligned(np.array([frame.targets[name].rotation for frame in frames]))
    if easing != "smooth":
        share = share**3 * (share * (6 * share - 15) + 10) if easing == "ease" else share
        moved = moves[i] + share * (moves[i + 1] - moves[i])
        turned = slerp(turns[i], turns[i + 1], share)
    else:
        moved = cubic(times, moves, i, share)
        turned = _squad(times, turns, i, share)
    return Target.of(moved.tolist(), unit(turned).tolist())


def _aligned(quats: np.ndarray) -> np.ndarray:
    """Flip signs such that each turn from one quaternion to the next is the shorter one."""
    aligned = quats.copy()
    for i in range(1, len(aligned)):
        if aligned[i] @ aligned[i - 1] < 0:
            aligned[i] = -aligned[i]
    return aligned


def _slopes(times: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return velocities [K, 3] at the keyframes that avoid overshoot (Fritsch & Butland): 0 at the ends and where the
    direction reverses. ``steps`` [K - 1, 3] are the differences between keyframes."""
    spans = np.diff(times)[:, None]
    rates = steps / spans
    slopes = np.zeros((len(times), steps.shape[1]))
    if len(rates) > 1:
        before, after = rates[:-1], rates[1:]
        same = before * after > 0
        w1, w2 = 2 * spans[1:] + spans[:-1], spans[1:] + 2 * spans[:-1]
        safe = np.where(same, before, 1.0), np.where(same, after, 1.0)
        slopes[1:-1] = np.where(same, (w1 + w2) / (w1 / safe[0] + w2 / safe[1]), 0.0)
    return slopes


def cubic(times: np.ndarray, values: np.ndarray, i: int, share: float) -> np.ndarray:
    """Evaluate the monotone cubic between keyframes i and i + 1."""
    slopes = _slopes(times, np.diff(values, axis=0)) * (times[i + 1] - times[i])
    s2, s3 = share * share, share**3
    blend = 3 * s2 - 2 * s3
    return (
        (1 - blend) * values[i] + blend * values[i + 1] + (s3 - 2 * s2 + share) * slopes[i] + (s3 - s2) * slopes[i + 1]
    )


def _squad(times: np.ndarray, quats: np.ndarray, i: int, share: float) -> np.ndarray:
    """Evaluate a cubic Bezier curve of rotations (Shoemake 1985) with the angular velocities of ``_slopes``."""
    spans = np.diff(times)
    ways = logarithm(multiply(conjugate(quats[:-1]), quats[1:]))
    slopes = _slopes(times, ways) * spans[i] / 3.0
    points = [
        quats[i],
        multiply(quats[i], exponential(slopes[i])),
        multiply(quats[i + 1], exponential(-slopes[i + 1])),
        quats[i + 1],
    ]
    while len(points) > 1:
        points = [slerp(a, b, share) for a, b in pairwise(points)]
    return points[0]


def blend(target: Target, share: float) -> Target:
    """Scale a target by ``share``."""
    if share == 1.0:
        return target
    turned = power(np.array(target.rotation), share) if share else IDENTITY
    return Target.of((share * np.array(target.translation)).tolist(), turned.tolist())
