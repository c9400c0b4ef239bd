"""Parts of a moving body: sets of control points that moved rigidly together over the trained motion.

Patches merge in three stages. First those whose union moves most rigidly (Ward's criterion), pairwise in rounds, down
to a few dozen parts. Then patches change to a neighbouring part whose motion explains theirs better, so that early
mistakes do not last. Last, neighbouring parts merge in the order of the angle by which they turn against each other,
until every pair turns by more than the least angle of a joint. Before that, a part of very few patches joins the
neighbour (if possible a larger one) whose motion explains it best: such a part shows where it goes, but hardly how it
turns. Bands of skin at joints (``joint_bands``) go to the parts beside them, and parts that the motion does not tell
apart merge (``shared_motion``). The criterion is an angle, because a distance would favour large parts and split bodies
whose surface drifts slowly. The number of parts therefore follows from the motion.

Bodies bend where they are narrow. A boundary that is short for its parts (``_widths``) therefore counts as a joint at a
smaller angle, and a long boundary needs better evidence: where a surface looks the same everywhere, its trained motion
slides along it, and the borders of the sliding regions may lie anywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from .joint_bands import find_band, without_band
from .patches import Moments, Motions, Patches
from .shared_motion import find_shared

LEAST_TURN = math.radians(15.0)
"""Largest angle by which two neighbouring parts may turn against each other and still be one part, if their boundary is
not narrow."""
MOST_DOUBTED = math.radians(45.0)
"""Largest such angle between parts that may merge by a shared motion: a larger angle is no error of the motion. A wide
boundary raises it."""
USUAL_WIDTH = 2.0
"""Width that separates narrow from wide boundaries. Around a limb, a part 0.8 times as long as thick has this width."""
NARROW_TURN = 0.7
"""Share of ``LEAST_TURN`` that counts where a boundary has at most this share of the usual width; in between, the angle
grows with the width."""
MOST_DOUBT = 2.5
"""Largest factor by which a wide boundary raises the limits on a shared motion."""
FIRST_PARTS = 90
"""Number of parts at which merging by angle begins."""
BOUNDARY_COST = 1.7e-3
"""Error of a patch's motion, relative to the scene's size, that costs as much as one more boundary edge."""
MIN_PATCHES, MIN_SHARE = 3, 0.01
"""Number of patches, and share of all patches, below which a part joins a neighbour: the skin between two parts moves
half with each."""
SWEEPS = 10
MAX_ROUNDS = 4
"""Number of merges, relative to the first number of parts, after which patches no longer change parts one by one: where
a few patches keep moving back and forth, this may split off as many pieces as merge."""
ROBUST_FITS = 2

_Fit = Callable[[Moments, np.ndarray], tuple[Moments, Motions]]


def find_parts(patches: Patches, count: int | None = None) -> np.ndarray:
    """Label patches by part, [P], numbered by decreasing size.

    Args:
        count: number of parts; None: chosen by the angles between them. A body that falls apart has at least as many
            parts as pieces.
    """
    first = max(FIRST_PARTS, 3 * count if count else 0)
    labels, fits = _merge_by_cost(patches, first), _Fits(patches.moments)
    least = max(MIN_PATCHES, math.ceil(MIN_SHARE * len(patches.nodes)))
    rounds = MAX_ROUNDS * (int(labels.max()) + 1)
    met: dict[bytes, int] = {}
    while True:
        if rounds > 0:
            rounds = _without_repetition(rounds, labels.tobytes(), met)
        if rounds > 0:
            labels = _refined(patches, labels, fits)
        rounds -= 1
        parts = int(labels.max()) + 1
        if count is not None and parts <= count:
            break
        pairs = _neighbors(patches.edges, labels)
        if not len(pairs):
            break
        small = pairs[np.bincount(labels)[pairs].min(1) < least]
        if len(small):
            pooled, sizes = patches.moments.pooled(labels, parts), np.bincount(labels)[small]
            costs = _costs(pooled, small) / pooled.count[small].min(1)
            labels = _joined(labels, small[np.lexsort((costs, sizes.max(1) < least))[0]])
            continue
        turns, widths = relative_turns(*fits.robust(labels), pairs), _widths(patches.edges, labels, pairs)
        excess = turns / widths.clip(NARROW_TURN, 1.0)
        chosen = int(excess.argmin())
        if count is None and excess[chosen] > LEAST_TURN:
            pooled, motions = fits.robust(labels)
            band = find_band(pooled, motions, pairs, partial(relative_turns, pooled, motions))
            if band is not None:
                labels = _renumbered(without_band(labels, patches.moments.errors_under(motions), band))
                continue
            doubt = widths.clip(1.0, MOST_DOUBT)
            close = np.flatnonzero(turns <= MOST_DOUBTED * doubt)
            shared = find_shared(patches.moments, labels, motions, pairs[close], doubt[close], fit_parts)
            if shared is None:
                break
            chosen = int(close[shared])
        labels = _joined(labels, pairs[chosen])
    sizes = np.bincount(labels, weights=patches.moments.count)
    rank = np.empty(len(sizes), np.int64)
    rank[np.argsort(-sizes, kind="stable")] = np.arange(len(sizes))
    return rank[labels]


def _without_repetition(rounds: int, labels: bytes, met: dict[bytes, int]) -> int:
    """Return how many of the ``rounds`` left must still be made. Labels that return would do so again and again: whole
    periods are left out. ``met`` keeps the rounds that were left when labels were first met."""
    if labels in met:
        rounds %= met[labels] - rounds
    met.setdefault(labels, rounds)
    return rounds


def fit_parts(moments: Moments, labels: np.ndarray) -> tuple[Moments, Motions]:
    """Fit the motion of each part to the moments of its patches. Patches that it explains badly count less: the skin at
    a joint moves half with each of two parts."""
    parts = int(labels.max()) + 1
    own = np.arange(len(labels)), labels
    weights = np.ones(len(labels))
    for _ in range(ROBUST_FITS):
        motions = moments.scaled(weights).pooled(labels, parts).motions()
        off = moments.errors_under(motions)[own] / moments.count
        usual = np.array([np.median(off[labels == part]) for part in range(parts)])[labels]
        weights = 1.0 / (1.0 + off / np.maximum(usual, 1e-30))
    pooled = moments.scaled(weights).pooled(labels, parts)
    return pooled, pooled.motions()


class _Fits:
    """Fits of parts, kept by the patches that belong to them: a merge changes few parts, and a fit is slow."""

    def __init__(self, moments: Moments) -> None:
        self._moments = moments
        self._plain: dict[bytes, tuple[Moments, Motions]] = {}
        self._robust: dict[bytes, tuple[Moments, Motions]] = {}

    def plain(self, labels: np.ndarray) -> Motions:
        """Return the best motion of each part."""
        return self._of(labels, self._plain, _fit_plainly)[1]

    def robust(self, labels: np.ndarray) -> tuple[Moments, Motions]:
        """Return the fits of ``fit_parts``."""
        return self._of(labels, self._robust, fit_parts)

    def _of(self, labels: np.ndarray, kept: dict[bytes, tuple[Moments, Motions]], fit: _Fit) -> tuple[Moments, Motions]:
        keys = [np.flatnonzero(labels == part).tobytes() for part in range(int(labels.max()) + 1)]
        new = np.array([key not in kept for key in keys])
        if new.any():
            rows = np.flatnonzero(new[labels])
            moments, motions = fit(self._moments.take(rows), _renumbered(labels[rows]))
            for row, part in enumerate(np.flatnonzero(new)):
                kept[keys[part]] = Moments(*(each[row] for each in moments)), Motions(*(each[row] for each in motions))
        moments, motions = zip(*(kept[key] for key in keys))
        return Moments(*map(np.stack, zip(*moments))), Motions(*map(np.stack, zip(*motions)))


def _fit_plainly(moments: Moments, labels: np.ndarray) -> tuple[Moments, Motions]:
    pooled = moments.pooled(labels, int(labels.max()) + 1)
    return pooled, pooled.motions()


def relative_turns(moments: Moments, motions: Motions, pairs: np.ndarray) -> np.ndarray:
    """Return the largest turn of one body against another between two instants, [E] radians, for pairs [E, 2].

    Of the two bodies' values the larger is taken.
    """
    spreads, rotations = moments.covariance(), motions.rotations
    first, second = pairs.T
    return np.maximum(
        _largest_turns(rotations[first], rotations[second], spreads[second]),
        _largest_turns(rotations[second], rotations[first], spreads[first]),
    )


def _largest_turns(base: np.ndarray, own: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return the largest turn of bodies ``own`` [E, T, 3, 3] against ``base`` between two instants, [E] radians.

    It is the distance by which the turn moves a body's points about their centre, relative to the largest distance for
    that angle about any axis: a turn of a thin body about its own axis hardly counts.

    Args:
        spread: [E, 3, 3] covariance of the bodies' points in the reference pose.
    """
    relative = np.swapaxes(base, 2, 3) @ own
    flat = (len(relative), relative.shape[1], 9)
    # |A - B|^2 = |A|^2 + |B|^2 - 2 <A, B>, with A and B the two rotations of the points, whose norms are the same
    same = (relative @ spread[:, None]).reshape(flat) @ np.swapaxes(relative.reshape(flat), 1, 2)
    moved = np.maximum(2.0 * np.trace(spread, axis1=1, axis2=2) - 2.0 * same.min((1, 2)), 0.0)
    most = np.maximum(np.linalg.eigvalsh(spread)[:, 1:].sum(1), 1e-300)
    return 2.0 * np.arcsin(np.minimum(0.5 * np.sqrt(moved / most), 1.0))


def _neighbors(edges: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return the pairs of neighbouring labels, [E, 2]."""
    ends = np.sort(labels[edges], axis=1)
    return np.unique(ends[ends[:, 0] != ends[:, 1]], axis=0)


def _widths(edges: np.ndarray, labels: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the lengths of the boundaries of pairs, [E], relative to the square root of the smaller part's area and to
    ``USUAL_WIDTH``.

    Lengths and areas are counted in patches. Where patches cover a surface evenly, a third of their mean number of
    neighbours crosses each patch of a boundary's length.

    Args:
        pairs: [E, 2] labels, the smaller one first.
    """
    parts = int(labels.max()) + 1
    first, second = np.sort(labels[edges], axis=1).T
    crossing = np.bincount(parts * first + second, minlength=parts**2)[parts * pairs[:, 0] + pairs[:, 1]]
    neighbors = 2.0 * len(edges) / len(labels)
    area = np.bincount(labels)[pairs].min(1)
    return 3.0 * crossing / (neighbors * np.sqrt(area) * USUAL_WIDTH)


def _renumbered(labels: np.ndarray) -> np.ndarray:
    return np.unique(labels, return_inverse=True)[1].reshape(-1)


def _joined(labels: np.ndarray, pair: np.ndarray) -> np.ndarray:
    return _renumbered(np.where(labels == pair[1], pair[0], labels))


def _merge_by_cost(patches: Patches, count: int) -> np.ndarray:
    """Merge neighbours whose union adds least to the error, until ``count`` parts are left. In each round, those pairs
    merge that are each other's best choice."""
    labels = np.arange(len(patches.nodes))
    while labels.max(initial=0) >= count:
        parts = int(labels.max()) + 1
        moments, pairs = patches.moments.pooled(labels, parts), _neighbors(patches.edges, labels)
        if not len(pairs):
            break
        first, second = pairs.T
        order = np.lexsort((second, first, _costs(moments, pairs)))
        labels = _merged(labels, pairs[order], parts - count)
    return labels


def _costs(moments: Moments, pairs: np.ndarray) -> np.ndarray:
    """Return what the union of each pair [E, 2] adds to the error, [E]."""
    errors, (first, second) = moments.errors(), pairs.T
    return moments.take(first).plus(moments.take(second)).errors() - errors[first] - errors[second]


def _merged(labels: np.ndarray, pairs: np.ndarray, most: int) -> np.ndarray:
    """Merge pairs, best first, of which neither end has a better partner; at most ``most`` of them."""
    parts = int(labels.max()) + 1
    into, seen, merged = np.arange(parts), np.zeros(parts, bool), 0
    for first, second in pairs.tolist():
        if not seen[first] and not seen[second] and merged < most:
            into[second] = first
            merged += 1
        seen[first] = seen[second] = True
    return _renumbered(into[labels])


def _refined(patches: Patches, labels: np.ndarray, fits: _Fits) -> np.ndarray:
    """Move patches to the neighbouring part whose motion explains theirs best, until none changes; then number the
    connected pieces."""
    count = len(labels)
    ends = np.concatenate([patches.edges, patches.edges[:, ::-1]])
    graph = csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    price = patches.moments.count.mean() * (BOUNDARY_COST * patches.size) ** 2
    even = np.arange(count) % 2 == 0
    for _ in range(SWEEPS):
        parts = int(labels.max()) + 1
        errors = patches.moments.errors_under(fits.plain(labels))
        changed = labels.copy()
        for turn in (even, ~even):
            own = np.zeros((count, parts))
            own[np.arange(count), changed] = 1.0
            near = np.asarray(graph @ own)
            cost = np.where(near + own > 0, errors - price * near, np.inf)
            changed[turn] = cost.argmin(1)[turn]
        changed = _renumbered(changed)
        if np.array_equal(changed, labels):
            break
        labels = changed
    same = patches.edges[labels[patches.edges[:, 0]] == labels[patches.edges[:, 1]]]
    within = coo_matrix((np.ones(len(same)), (same[:, 0], same[:, 1])), shape=(count, count))
    return connected_components(within, directed=False)[1].astype(np.int64)
