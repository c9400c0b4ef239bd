"""Pairs of frames to compare, and matches of their descriptors."""

from __future__ import annotations

import numpy as np
import torch

from scgs_warp.capture import features


def test_pairs_reach_as_far_as_they_should():
    assert features.pairs(5, "auto", True) == [(i, j) for i in range(5) for j in range(i + 1, 5)]
    many = features.pairs(200, "auto", True)
    assert len(many) < 4000 and {(i, i + 1) for i in range(199)} <= set(many) and (0, 190) in many
    assert len(features.pairs(100, "auto", False)) == 4950, "images of a folder need not be in order"
    assert many == sorted(set(many)) and len(features.pairs(200, "exhaustive", True)) == 19900


def test_matches_are_mutual_and_clear():
    rng = np.random.default_rng(0)
    rows = rng.uniform(0, 1, (60, 128)) ** 4
    one = np.rint(rows / np.linalg.norm(rows, axis=1, keepdims=True) * 512).clip(0, 255).astype(np.uint8)
    order = rng.permutation(60)
    two = one[order]
    two[-1] = two[-2]  # two that look the same: neither is a match
    found = features.nearest_mutual(torch.from_numpy(one), torch.from_numpy(two))
    assert len(found) == 58 and np.array_equal(order[found[:, 1]], found[:, 0])
    assert found.dtype == np.uint32 and len(features.nearest_mutual(torch.from_numpy(one), torch.zeros(0, 128))) == 0


def test_matches_are_those_of_the_two_nearest_in_each_direction():
    """Against a search in each direction, with noise, repeated descriptors on either side, and different numbers."""
    rng = np.random.default_rng(1)

    def described(rows: np.ndarray) -> np.ndarray:
        return np.rint(rows / np.linalg.norm(rows, axis=1, keepdims=True) * 512).clip(0, 255).astype(np.uint8)

    def nearest(cosines: np.ndarray) -> list[tuple[int, bool]]:
        found = []
        for row in cosines:
            second, best = np.sort(row)[-2:]
            angle, other = np.arccos(np.clip([best, second], -1.0, 1.0))
            clear = best > second and angle <= features.MAX_ANGLE and angle <= features.MAX_ANGLE_RATIO * other
            found.append((int(row.argmax()), bool(clear)))
        return found

    rows = rng.uniform(0, 1, (90, 128)) ** 4
    one, two = described(rows), described(rows[20:] + 0.2 * rng.uniform(0, 1, (70, 128)) ** 2)
    one[3], two[5], two[7] = one[40], two[30], two[31]
    cosines = one.astype(np.float64) @ two.astype(np.float64).T / features.DESCRIPTOR_LENGTH**2
    forth, back = nearest(cosines), nearest(cosines.T)
    expected = [(i, j) for i, (j, clear) in enumerate(forth) if clear and back[j] == (i, True)]
    found = features.nearest_mutual(torch.from_numpy(one), torch.from_numpy(two))
    assert 20 < len(expected) < 68 and [tuple(pair) for pair in found.tolist()] == expected
