"""Synchronisation of cameras by their sound: offsets of all pairs by cross-correlation, then one clock that fits them.

The spectra are whitened (the phase transform: Knapp and Carter, "The generalized correlation method for estimation of
time delay", IEEE TASSP 1976), so that a peak is as narrow as the sound's bandwidth allows, whatever the room and the
microphones do to its colour. Sound takes 3 milliseconds per metre: the offsets are off by the difference of the
distances of the cameras to what is heard.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .sound import RATE, Sound

LOWEST, HIGHEST = 150.0, 7000.0
"""Band of the sound that is compared, Hz: without the rumble of wind and mains, and without what codecs drop."""
CLEAR = 8.0
"""Least ratio of the peak of a correlation to its root mean square. The largest of a million values of noise is near
5, that of their averaged energy below 7."""
ALL_PAIRS = 12
"""Largest number of cameras among which all pairs are compared."""
NEXT_CAMERAS = 5
"""Number of following cameras with which each of more cameras is compared, besides the first."""
LEAST_OVERLAP = 1.0
"""Shortest common sound of two cameras, seconds."""
SPREAD = 0.004
"""Width, seconds, over which the energy of an unclear correlation is averaged. The clocks of two recorders differ by
some 20 parts in a million, which spreads the peak of a minute of sound over a millisecond and buries it in noise."""
ROBUST_SECONDS = 0.004
"""Disagreement of a pair's offset with the others beyond which it counts less."""


class PairOffset(NamedTuple):
    """Offset of two cameras by their sound."""

    a: int
    b: int
    seconds: float
    """Start of b minus start of a."""
    clarity: float
    """Ratio of the correlation's peak to its root mean square."""


class Clock(NamedTuple):
    """Result of a synchronisation."""

    starts: np.ndarray
    """[C] seconds at which each camera begins, the earliest at 0; NaN for cameras that match no other."""
    disagreement: float
    """Median distance, in seconds, of the pairs' offsets from ``starts``."""


def synchronise(sounds: Sequence[Sound | None]) -> Clock:
    """Find when each camera began, from all pairs of sounds that match clearly."""
    present = [index for index, sound in enumerate(sounds) if sound is not None]
    size = 2 * max((len(sounds[index].samples) for index in present), default=1)  # type: ignore[union-attr]
    size = 1 << (size - 1).bit_length()
    spectra: dict[int, np.ndarray] = {}

    def spectrum(index: int) -> np.ndarray:
        if index not in spectra:
            sound = sounds[index]
            assert sound is not None
            spectra[index] = _whitened(sound.samples, size)
        return spectra[index]

    pairs = []
    for a, b in _pairs(present):
        one, two = sounds[a], sounds[b]
        assert one is not None and two is not None
        lag, clarity = _lag(spectrum(a), spectrum(b), size, len(one.samples), len(two.samples))
        # A sound in a at its second t is in b at t + lag.
        pairs.append(PairOffset(a, b, one.start - two.start - lag, clarity))
    return solve(len(sounds), [pair for pair in pairs if pair.clarity >= CLEAR])


def _pairs(present: Sequence[int]) -> list[tuple[int, int]]:
    if len(present) <= ALL_PAIRS:
        return [(a, b) for i, a in enumerate(present) for b in present[i + 1 :]]
    near = {
        (present[i], present[j])
        for i in range(len(present))
        for j in range(i + 1, len(present))
        if j - i <= NEXT_CAMERAS
    }
    return sorted(near | {(present[0], other) for other in present[1:]})


def _whitened(samples: np.ndarray, size: int) -> np.ndarray:
    """Return the spectrum of a sound with magnitude 1 within the band, and 0 outside."""
    from scipy import fft

    spectrum = np.asarray(fft.rfft(samples.astype(np.float32), size))
    frequencies = np.arange(len(spectrum)) * (RATE / size)
    magnitude = np.abs(spectrum)
    inside = (frequencies >= LOWEST) & (frequencies <= HIGHEST) & (magnitude > 1e-12)
    return np.where(inside, spectrum / np.maximum(magnitude, 1e-12), 0.0).astype(np.complex64)


def _lag(one: np.ndarray, two: np.ndarray, size: int, length_one: int, length_two: int) -> tuple[float, float]:
    """Return the delay of ``two`` against ``one`` in seconds, and the clarity of the correlation's peak."""
    from scipy import fft, ndimage

    correlation = np.asarray(fft.irfft(np.conj(one) * two, size))
    least = int(LEAST_OVERLAP * RATE)
    lags = np.concatenate([np.arange(0, size // 2), np.arange(-size // 2, 0)])
    possible = (lags < length_two - least) & (lags > least - length_one)
    if min(length_one, length_two) < least or not possible.any():
        return 0.0, 0.0
    peak, clarity = _peak(correlation, possible)
    if clarity < CLEAR:
        correlation = np.square(correlation, dtype=np.float64)
        for _ in range(2):  # Twice, so that it is highest where the middle of a peak is.
            correlation = np.asarray(ndimage.uniform_filter1d(correlation, round(SPREAD * RATE), mode="wrap"))
        correlation -= correlation[possible].mean()
        peak, clarity = _peak(correlation, possible)
    return (float(lags[peak]) + _vertex(correlation, peak)) / RATE, clarity


def _peak(values: np.ndarray, possible: np.ndarray) -> tuple[int, float]:
    """Return the place of the largest possible value and its ratio to their root mean square, which is 0 if sounds
    match where they have too little in common."""
    peak = int(np.where(possible, values, 0.0).argmax())
    if values.max() > values[peak]:
        return peak, 0.0
    return peak, float(values[peak] / max(np.sqrt(np.square(values[possible]).mean()), 1e-12))


def _vertex(values: np.ndarray, peak: int) -> float:
    """Return the offset of the vertex of the parabola through a peak and its neighbours, in samples."""
    before, at, after = values[peak - 1], values[peak], values[(peak + 1) % len(values)]
    bend = before - 2.0 * at + after
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0 else 0.0


def solve(count: int, pairs: Sequence[PairOffset]) -> Clock:
    """Fit the starts of ``count`` cameras to the offsets of pairs: least absolute deviations, by reweighting.

    Cameras that no chain of pairs connects to the largest group get NaN.
    """
    group = _largest_group(count, pairs)
    starts = np.full(count, np.nan)
    if not group:
        return Clock(starts, 0.0)
    rows = {camera: row for row, camera in enumerate(group)}
    used = [pair for pair in pairs if pair.a in rows and pair.b in rows]
    system = np.zeros((len(used) + 1, len(group)))
    for row, pair in enumerate(used):
        system[row, rows[pair.a]], system[row, rows[pair.b]] = -1.0, 1.0
    system[-1, 0] = 1.0  # the first camera begins at 0, until all are shifted
    wanted = np.array([*(pair.seconds for pair in used), 0.0])
    weights = np.ones(len(wanted))
    found = np.zeros(len(group))
    for _ in range(30):
        found = np.linalg.lstsq(system * weights[:, None], wanted * weights, rcond=None)[0]
        error = np.abs(system @ found - wanted)
        weights[:-1] = 1.0 / np.sqrt(np.maximum(error[:-1], ROBUST_SECONDS) / ROBUST_SECONDS)
    starts[group] = found - found.min()
    error = np.abs(system @ found - wanted)[:-1]
    return Clock(starts, float(np.median(error)) if len(error) else 0.0)


def _largest_group(count: int, pairs: Sequence[PairOffset]) -> list[int]:
    """Return the largest set of cameras that pairs connect, ascending; empty without pairs."""
    group = list(range(count))
    for pair in pairs:
        low, high = sorted((group[pair.a], group[pair.b]))
        group = [low if name == high else name for name in group]
    members = [[camera for camera in range(count) if group[camera] == name] for name in sorted(set(group))]
    largest = max(members, key=len, default=[])
    return largest if len(largest) > 1 else []
