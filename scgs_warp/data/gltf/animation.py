"""glTF animation clips and their samplers. All values are float64; quaternions are xyzw, as glTF stores them.

Formulas: glTF 2.0 specification, appendix C (interpolation).
"""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np

from ...errors import UserError
from .file import GltfFile

PATHS = {"translation": 3, "rotation": 4, "scale": 3}
"""Number of components of each animated property; ``weights`` has one per morph target of the mesh."""
POINTER = "KHR_animation_pointer"
STILL = 1e-5
"""Change of a property, as a share of its largest value, that counts as rounding."""
POINTED = re.compile(r"/nodes/([0-9]{1,9})/(translation|rotation|scale|weights)")
"""Pointers of that extension to what channels without it move as well."""


class Sampler(NamedTuple):
    """A curve through the keyframes of one property."""

    times: np.ndarray
    """[N] seconds, not falling."""
    values: np.ndarray
    """[N, C]; for a cubic spline [N, 3, C]: in-tangent, value, out-tangent."""
    interpolation: str
    """LINEAR, STEP or CUBICSPLINE."""

    @property
    def moves(self) -> bool:
        """True if the value changes; tangents alone count for nothing."""
        keys = self.values[:, 1] if self.interpolation == "CUBICSPLINE" else self.values
        return bool((np.ptp(keys, axis=0) > STILL * np.abs(keys).max()).any())


class Channel(NamedTuple):
    node: int
    path: str
    sampler: Sampler


class Clip(NamedTuple):
    name: str
    channels: list[Channel]
    start: float
    """Time of the first keyframe, seconds."""
    end: float
    """Time of the last keyframe, seconds."""
    ignored: int = 0
    """Number of channels that move something else than nodes and weights."""

    @property
    def moves(self) -> bool:
        """True if a value changes between two keyframes."""
        return any(channel.sampler.moves for channel in self.channels)


def slerp(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    """Interpolate unit quaternions [4] along the shorter arc from a (``share`` 0) to b (``share`` 1)."""
    cosine = float(a @ b)
    sign = -1.0 if cosine < 0.0 else 1.0
    angle = float(np.arccos(min(abs(cosine), 1.0)))
    if angle < 1e-6:  # Sine and angle agree to 1e-13; the quotient below would be 0 / 0.
        mixed = (1.0 - share) * a + share * sign * b
    else:
        mixed = (np.sin((1.0 - share) * angle) * a + np.sin(share * angle) * sign * b) / np.sin(angle)
    return mixed / np.linalg.norm(mixed)


def interpolate(sampler: Sampler, seconds: float, rotation: bool = False) -> np.ndarray:
    """Evaluate the curve at ``seconds``, [C]; it is constant before the first keyframe and after the last one."""
    times, values = sampler.times, sampler.values
    cubic = sampler.interpolation == "CUBICSPLINE"
    if seconds <= times[0] or seconds >= times[-1]:
        key = values[0] if seconds <= times[0] else values[-1]
        return _unit(key[1] if cubic else key, rotation)
    k = int(np.searchsorted(times, seconds, side="right")) - 1
    if sampler.interpolation == "STEP":
        return _unit(values[k], rotation)
    step = float(times[k + 1] - times[k])
    t = (seconds - float(times[k])) / step
    if cubic:
        before, after = values[k], values[k + 1]
        result = (
            (2 * t**3 - 3 * t**2 + 1) * before[1]
            + step * (t**3 - 2 * t**2 + t) * before[2]
            + (-2 * t**3 + 3 * t**2) * after[1]
            + step * (t**3 - t**2) * after[0]
        )
        return _unit(result, rotation)
    if rotation:
        return slerp(_unit(values[k], True), _unit(values[k + 1], True), t)
    return (1.0 - t) * values[k] + t * values[k + 1]


def _unit(value: np.ndarray, rotation: bool) -> np.ndarray:
    length = float(np.linalg.norm(value)) if rotation else 1.0
    return value / length if length > 0 else np.array([0.0, 0.0, 0.0, 1.0])


def read_clips(file: GltfFile) -> list[Clip]:
    """Read every animation of the file, in the file's order; unnamed ones are called ``animation_0`` and so on.

    Raises:
        UserError: a sampler is invalid; the message names it.
    """
    clips = []
    for index, animation in enumerate(file.document.animations or []):
        channels, ignored = [], 0
        for number, channel in enumerate(animation.channels or []):
            parsed = _channel(file, animation, channel, f"animations[{index}].channels[{number}]")
            if parsed is None:
                ignored += 1
            else:
                channels.append(parsed)
        times = [channel.sampler.times for channel in channels]
        start = min((float(t[0]) for t in times), default=0.0)
        end = max((float(t[-1]) for t in times), default=0.0)
        clips.append(Clip(animation.name or f"animation_{index}", channels, start, end, ignored))
    return clips


def _channel(file: GltfFile, animation: Any, channel: Any, where: str) -> Channel | None:
    target = channel.target
    node, path = (None, None) if target is None else (target.node, target.path)
    extension = (target.extensions or {}).get(POINTER) if target is not None else None
    pointer = extension.get("pointer") if isinstance(extension, dict) else None
    if isinstance(pointer, str) and (found := POINTED.fullmatch(pointer)) is not None:
        node, path = int(found[1]), found[2]
    if node is None or path not in (*PATHS, "weights"):
        return None  # The specification says to ignore channels without a node; other paths belong to extensions.
    file.item("nodes", node, f"{where}.target")
    samplers = animation.samplers or []
    if not isinstance(channel.sampler, int) or not 0 <= channel.sampler < len(samplers):
        raise file.error(f"{where}.sampler", f"is {channel.sampler!r} of {len(samplers)}; export the file again")
    return Channel(node, path, _sampler(file, samplers[channel.sampler], path, where))


def _sampler(file: GltfFile, sampler: Any, path: str, where: str) -> Sampler:
    interpolation = sampler.interpolation or "LINEAR"
    if interpolation not in ("LINEAR", "STEP", "CUBICSPLINE"):
        raise file.error(where, f"is interpolated by {str(interpolation)[:30]}; use LINEAR, STEP or CUBICSPLINE")
    times = file.array(sampler.input, f"{where} input", 1)[:, 0].astype(np.float64)
    values = file.array(sampler.output, f"{where} output", PATHS.get(path)).astype(np.float64)
    if not len(times) or (np.diff(times) < 0).any():  # Equal times, which some exporters write, are a jump.
        raise file.error(where, "has keyframe times that fall; export the animation again")
    parts = 3 if interpolation == "CUBICSPLINE" else 1
    rows = len(times) * parts
    if len(values) < rows or (path == "weights" and len(values) % rows) or (path in PATHS and len(values) != rows):
        raise file.error(where, f"has {len(values)} values for {len(times)} {interpolation} keyframes; export it again")
    shape = (len(times), parts, -1) if parts == 3 else (len(times), -1)
    return Sampler(times, values.reshape(shape), interpolation)


def choose_clip(file: GltfFile, clips: list[Clip], name: str | None) -> Clip | None:
    """Choose the clip with the given name, ignoring case if no name matches exactly; without a name, the first one that
    moves something, because files often begin with a pose at rest.

    Returns:
        The clip; None for a file without animations.

    Raises:
        UserError: there is no such clip; the message lists the clips.
    """
    if name is None:
        return next((clip for clip in clips if clip.moves), clips[0] if clips else None)
    if not clips:
        raise UserError(f"--clip {name}: {file.path} holds no animation; leave out --clip")
    matching = [clip for clip in clips if clip.name == name]
    matching = matching or [clip for clip in clips if clip.name.lower() == name.lower()]
    if not matching:
        listed = ", ".join(f"{clip.name} ({clip.end - clip.start:.2f} s)" for clip in clips)
        raise UserError(f"--clip {name}: {file.path} has no such clip; give one of: {listed}")
    return matching[0]
