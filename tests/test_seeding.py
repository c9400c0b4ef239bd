"""Random generators that depend on a seed and keys alone."""

from __future__ import annotations

import torch

from scgs_warp.seeding import generator


def draw(*keys: int) -> list[int]:
    return torch.randint(2**31, (4,), generator=generator(*keys)).tolist()


def test_same_seed_and_keys_give_the_same_numbers():
    assert draw(3, 1, 2) == draw(3, 1, 2)


def test_every_key_counts_in_its_place():
    drawn = [draw(*keys) for keys in ((0,), (1,), (0, 0), (0, 1), (0, 1, 2), (0, 2, 1), (0, 0, 1, 2))]
    assert all(a != b for k, a in enumerate(drawn) for b in drawn[:k])
