"""Numbers as bytes that index a codebook, with the least squared error for the numbers at hand."""

from __future__ import annotations

import numpy as np

LEVELS = 256
ROUNDS = 60
MOVED = 16
"""Largest number of levels that are moved in a round."""
BINS = 4096
"""Bins of the histogram from which the first codebook is made."""


def make_codebook(values: np.ndarray) -> np.ndarray:
    """Choose numbers [256] float32, ascending, for finite values of any shape: Lloyd's method.

    Values of at most 256 kinds are kept exactly; the last number is repeated if fewer are needed.
    """
    ordered = np.sort(values.astype(np.float32).ravel()).astype(np.float64)
    kinds = ordered[np.flatnonzero(np.diff(ordered, prepend=np.nan) != 0)] if len(ordered) else np.zeros(1)
    if len(kinds) <= LEVELS:
        return np.pad(kinds, (0, LEVELS - len(kinds)), mode="edge").astype(np.float32)
    book, sums = _first_codebook(ordered), np.concatenate([[0.0], np.cumsum(ordered)])
    for left in range(ROUNDS, 0, -1):
        better = _improved(ordered, sums, book, left > ROUNDS // 3)
        if np.abs(better - book).max() <= 1e-7 * (ordered[-1] - ordered[0]):
            break
        book = better
    return book.astype(np.float32)


def _improved(ordered: np.ndarray, sums: np.ndarray, book: np.ndarray, move: bool) -> np.ndarray:
    """Return the means of the values next to each level; if ``move``, the levels of least error, first those without
    values, halve the intervals of greatest error.

    Args:
        sums: sums of the first 0 to V values.
    """
    ends = np.concatenate([[0], np.searchsorted(ordered, (book[1:] + book[:-1]) / 2), [len(ordered)]])
    counts = np.diff(ends)
    mean = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), book)
    if move:
        level = np.repeat(np.arange(LEVELS), counts)
        error = np.bincount(level, (ordered - mean[level]) ** 2, LEVELS)
        order = np.argsort(error, kind="stable")
        least, most = order[:MOVED], order[: -MOVED - 1 : -1]
        worth = error[most] > 4 * error[least]  # what a half interval has left is a quarter
        step = np.sqrt(error[most] / np.maximum(counts[most], 1))[worth]
        mean[least[worth]] = mean[most[worth]] + step
        mean[most[worth]] -= step
    return np.sort(mean)


def _first_codebook(ordered: np.ndarray) -> np.ndarray:
    """Return levels whose density is the cube root of that of the values, the best for many levels."""
    counts, edges = np.histogram(ordered, BINS)
    share = np.concatenate([[0.0], np.cumsum(np.cbrt(counts))])
    return np.interp((np.arange(LEVELS) + 0.5) / LEVELS, share / share[-1], edges)


def encode(values: np.ndarray, book: np.ndarray) -> np.ndarray:
    """Return the index [...] uint8 of the nearest number of an ascending codebook, for each value."""
    middles = (book[1:].astype(np.float64) + book[:-1]) / 2
    return np.searchsorted(middles, values.astype(np.float64)).astype(np.uint8)
