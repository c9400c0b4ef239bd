"""Neighbouring parts whose motion is not known well enough to tell them apart.

A part that is narrow, or nearly round, hardly shows how it turns: errors of its trained motion then look like turns of
some 30 degrees. Such a turn does not count as a joint if one common motion explains both parts nearly as well as their
own motions do, and nearly as well as the motions of other parts explain theirs. (Errors of neighbouring points are
similar, so they do not average out, however many points a part has.) The limits are wider for a long boundary between
the two parts, which is more likely a border of errors than a joint.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .patches import Moments, Motions

MOST_LOST = 1.5
"""Distance of a part's points from the common motion, at most, relative to that from its own motion."""
MOST_OFF = 1.8
"""The same distance, at most, relative to that of a typical patch of a typical part from the motion of its part. If all
patches counted alike, a large body that stands still would set the measure for those that move."""


def find_shared(
    moments: Moments,
    labels: np.ndarray,
    motions: Motions,
    pairs: np.ndarray,
    doubt: np.ndarray,
    fit: Callable[[Moments, np.ndarray], tuple[Moments, Motions]],
) -> int | None:
    """Return the row of ``pairs`` whose parts share one motion; of several, the one with the least distance divided by
    its doubt. None if there is none.

    Distances are root mean squares over points and time.

    Args:
        moments: of P patches.
        labels: [P] part of each patch.
        motions: of the parts.
        pairs: [E, 2] neighbouring parts.
        doubt: [E] factors, at least 1, of both limits.
        fit: returns the motion of each label, as ``parts.fit_parts``.
    """
    own = moments.errors_under(motions)[np.arange(len(labels)), labels]
    alone = _means(own, moments.count, labels)
    off = own / moments.count
    usual = float(np.median([np.median(off[labels == part]) for part in np.unique(labels)]))
    least, found = MOST_OFF**2 * usual, None
    for row, pair in enumerate(pairs):
        rows = np.flatnonzero(np.isin(labels, pair))
        both = moments.take(rows)
        errors = both.errors_under(fit(both, np.zeros(len(rows), np.int64))[1])[:, 0]
        together = _means(errors, both.count, (labels[rows] == pair[1]).astype(np.int64))
        together /= doubt[row] ** 2
        if (together <= MOST_LOST**2 * alone[pair]).all() and together.max() < least:
            least, found = float(together.max()), row
    return found


def _means(errors: np.ndarray, counts: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return the mean squared distance of the points of each label."""
    return np.bincount(labels, errors) / np.bincount(labels, counts)
