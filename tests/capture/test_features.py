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
