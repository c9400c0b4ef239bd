"""Sound of a film: claps in the room, as the microphone of each camera hears them."""

from __future__ import annotations

import numpy as np

SAMPLE_RATE = 48_000
SPEED_OF_SOUND = 343.0
"""Metres per second; world units are taken as metres."""
CLAP_SECONDS = 0.06
CLAPS_PER_SECOND = 0.9
NOISE = 0.004
"""Standard deviation of each microphone's own noise; a clap begins with about 0.5."""


def clap_times(seconds: float, rng: np.random.Generator) -> np.ndarray:
    """Draw the moments of the claps: irregular, so that no shift but the true one fits."""
    count = max(3, round(CLAPS_PER_SECOND * seconds))
    edges = np.linspace(0.0, seconds, count + 1)
    return edges[:-1] + rng.uniform(0.1, 0.9, count) * np.diff(edges)


def heard(
    times: np.ndarray, shapes: np.ndarray, start: float, seconds: float, distance: float, rng: np.random.Generator
) -> np.ndarray:
    """Return what one microphone records, float32 in [-1, 1].

    Args:
        times: [N] moments of the claps on the clock of the room.
        shapes: [N, S] sound of each clap.
        start: moment at which the recording begins.
        seconds: its length.
        distance: metres to the source.
    """
    sound = rng.normal(0.0, NOISE, round(seconds * SAMPLE_RATE))
    for time, shape in zip(times, shapes):
        first = round((time + distance / SPEED_OF_SOUND - start) * SAMPLE_RATE)
        begin, end = max(first, 0), min(first + len(shape), len(sound))
        if begin < end:
            sound[begin:end] += shape[begin - first : end - first] / max(distance, 1.0)
    return sound.clip(-1.0, 1.0).astype(np.float32)


def clap_shapes(count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw claps [N, S]: noise that fades within some hundredths of a second."""
    time = np.arange(round(CLAP_SECONDS * SAMPLE_RATE)) / SAMPLE_RATE
    fading = np.exp(-time / 0.008) * (1.0 - np.exp(-time / 0.0003))
    return 1.5 * fading * rng.normal(0.0, 0.5, (count, len(time)))
