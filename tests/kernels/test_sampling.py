"""Farthest-point sampling against a loop in float64."""

from __future__ import annotations

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from reference import sampling as twin
from scgs_warp.ops import sampling
from scgs_warp.ops.sampling import farthest_points
from scgs_warp.runtime import environment


@pytest.mark.parametrize(("n", "d", "count"), [(300, 3, 64), (10_001, 3, 40), (500, 48, 500), (1, 3, 1), (9, 1, 9)])
def test_matches_the_loop(device, n, d, count):
    points = torch.randn(n, d, generator=torch.Generator().manual_seed(n))
    chosen = farthest_points(points.to(device), count, start=n // 2)
    assert chosen.dtype == torch.int64 and chosen.device.type == device
    assert chosen.tolist() == twin.farthest_points(points, count, start=n // 2).tolist()


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10_000), st.integers(1, 60), st.integers(1, 3))
def test_ties_and_duplicates(seed, n, d):
    """On a small grid every distance is exact, many are equal, and many points coincide."""
    points = torch.randint(0, 3, (n, d), generator=torch.Generator().manual_seed(seed)).float()
    chosen = farthest_points(points, n)
    assert chosen.tolist() == twin.farthest_points(points, n).tolist()
    assert sorted(chosen.tolist()) == list(range(n))


def test_duplicates_alone(device):
    assert sorted(farthest_points(torch.zeros(20, 3, device=device), 20).tolist()) == list(range(20))


def test_each_choice_is_the_farthest(device):
    """The covering radius never grows."""
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(1))
    picked = points[farthest_points(points.to(device), 100).cpu()]
    gaps = [float(torch.cdist(picked[i : i + 1], picked[:i]).min()) for i in range(1, 100)]
    assert all(later <= earlier + 1e-5 for earlier, later in itertools.pairwise(gaps))


def test_points_that_are_not_finite_come_last(device):
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    points[4, 0], points[9, 2] = float("nan"), float("inf")
    chosen = farthest_points(points.to(device), 50).tolist()
    assert sorted(chosen) == list(range(50)) and set(chosen[-2:]) == {4, 9}


def test_no_chunk_or_thread_changes_the_choice(all_threads, monkeypatch):
    points = torch.randn(20_000, 3, generator=torch.Generator().manual_seed(5))
    environment.configure(threads=1)
    expected = farthest_points(points, 50)
    environment.configure(threads=2)
    monkeypatch.setitem(sampling.CHUNK, "cpu", 777)
    assert torch.equal(farthest_points(points, 50), expected)


def test_counts_that_cannot_be(device):
    points = torch.zeros(3, 3, device=device)
    assert farthest_points(points, 0).shape == (0,)
    assert farthest_points(points[:0], 0).shape == (0,)
    for count in (-1, 4):
        with pytest.raises(ValueError, match="count"):
            farthest_points(points, count)
    with pytest.raises(ValueError, match="start"):
        farthest_points(points, 1, start=3)
    with pytest.raises(ValueError, match="points"):
        farthest_points(points[0], 1)
