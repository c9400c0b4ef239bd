"""Tracks through the clouds of a film: rigid motion, hidden points, outliers, and where tracks end."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from scgs_warp.training.clouds import Cloud
from scgs_warp.training.tracks import follow, gather

MOMENTS = 9
NOWHERE = torch.full((3,), float("nan"))


def body(count: int = 4000) -> torch.Tensor:
    """Points of a box of 1 x 0.6 x 0.4."""
    return (torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) - 0.5) * torch.tensor([1.0, 0.6, 0.4])


def moved(points: torch.Tensor, moment: int) -> torch.Tensor:
    """The box turns by 30 degrees about z from moment to moment, and goes along."""
    angle = math.radians(30.0 * (moment - MOMENTS // 2))
    turn = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )
    return points @ turn.T + torch.tensor([0.2, 0.1, 0.0]) * (moment - MOMENTS // 2)


def clouds(missing: int | None = None) -> list[Cloud]:
    """At each moment only what is on one side of the box is seen, and a fifth of it has no track."""
    found = []
    for moment in range(MOMENTS):
        here, there = moved(body(), moment), moved(body(), moment + 1)
        seen = here[:, 1] < here[:, 1].median()
        generator = torch.Generator().manual_seed(moment)
        lost = torch.rand(int(seen.sum()), generator=generator) < 0.2
        later = torch.where(lost[:, None], NOWHERE, there[seen])
        last = moment in (missing, MOMENTS - 1)
        zeros = torch.zeros(int(seen.sum()), 3)
        found.append(Cloud(here[seen], zeros, zeros[:, 0] == 0, moment / 8, None if last else later))
    return found


def test_points_go_where_the_body_goes():
    """Also those that no moment after the first shows."""
    points = body()[:200]
    tracks = follow(points, MOMENTS // 2, clouds(), 0.2)
    assert tracks is not None
    for moment in range(MOMENTS):
        torch.testing.assert_close(tracks.places[moment], moved(points, moment), atol=2e-3, rtol=0)
    assert bool((tracks.weights[MOMENTS // 2] == 1).all())
    after, before = tracks.weights[MOMENTS // 2 :], tracks.weights[: MOMENTS // 2 + 1].flip(0)
    for sure in (after, before):
        assert bool((sure[1:] <= sure[:-1]).all()) and 0.05 < float(sure[-1].mean()) < 0.95, "less and less sure"


def test_points_far_from_what_is_tracked_are_less_sure():
    points = torch.stack([body()[0], body()[0] + torch.tensor([0.0, 0.0, 0.6])])
    tracks = follow(points, 4, clouds(), 0.1)
    assert tracks is not None and float(tracks.weights[5, 1]) < 0.2 < float(tracks.weights[5, 0])


def test_tracks_that_differ_from_those_around_are_dropped():
    wrong = clouds()
    for number, cloud in enumerate(wrong[:-1]):
        assert cloud.later is not None
        some = torch.rand(len(cloud.later), generator=torch.Generator().manual_seed(number + 50)) < 0.1
        wrong[number] = cloud._replace(later=torch.where(some[:, None], cloud.later + 0.7, cloud.later))
    points = body()[:100]
    tracks = follow(points, 4, wrong, 0.2)
    assert tracks is not None
    for moment in range(MOMENTS):
        assert float((tracks.places[moment] - moved(points, moment)).norm(dim=1).median()) < 0.01


def test_without_tracks_nothing_is_known_beyond():
    points = body()[:100]
    tracks = follow(points, 4, clouds(missing=6), 0.2)
    assert tracks is not None
    assert bool((tracks.weights[7:] == 0).all()) and bool((tracks.weights[:7] > 0).all())
    torch.testing.assert_close(tracks.places[6], moved(points, 6), atol=2e-3, rtol=0)
    assert follow(points, 4, [cloud._replace(later=None) for cloud in clouds()], 0.2) is None
    few = [cloud._replace(later=None if cloud.later is None else cloud.later.clone()) for cloud in clouds()]
    few[4].later[20:] = NOWHERE
    stopped = follow(points, 4, few, 0.2)
    assert stopped is not None and bool((stopped.weights[5:] == 0).all())


@pytest.mark.parametrize("start", [0, MOMENTS - 1])
def test_any_cloud_may_be_the_first(start):
    points = moved(body()[:50], start)
    tracks = follow(points, start, clouds(), 0.2)
    assert tracks is not None
    for moment in range(MOMENTS):
        torch.testing.assert_close(tracks.places[moment], moved(body()[:50], moment), atol=4e-3, rtol=0)


def test_all_sides_are_gathered_in_one_pose():
    """A side that the first cloud does not show comes from the others, where the body is in the first one's pose."""
    found, tracks = gather(clouds(), MOMENTS // 2, 10_000, 0)
    assert tracks is not None and found.time == 0.5
    nearest = torch.cdist(found.points, moved(body(), MOMENTS // 2)).min(1).values
    assert float(nearest.max()) < 0.01
    first = clouds()[MOMENTS // 2].points
    hidden = body()[body()[:, 1] > 0.15]
    shares = [float((torch.cdist(hidden, each).min(1).values < 0.08).float().mean()) for each in (first, found.points)]
    assert shares[0] == 0.0 and shares[1] > 0.25
    assert tracks.places.shape == (MOMENTS, len(found.points), 3)
    for moment in range(MOMENTS):
        sure = tracks.weights[moment] > 0.1
        there = torch.cdist(tracks.places[moment][sure], moved(body(), moment)).min(1).values
        assert float(there.max()) < 0.02
    few, some = gather(clouds(), MOMENTS // 2, 100, 0)
    assert some is not None and len(few.points) == some.places.shape[1] == 100
    again, _ = gather(clouds(), MOMENTS // 2, 100, 0)
    assert torch.equal(few.points, again.points)


def test_what_rests_or_strays_is_not_gathered():
    """Points that some clouds hold by mistake: a wall that stays, and a few far from everything."""
    wrong = []
    wall = torch.tensor([0.0, 2.0, 0.0]) + 0.3 * torch.rand(80, 3, generator=torch.Generator().manual_seed(7))
    far = torch.tensor([[0.0, 0.0, 3.0], [0.1, 0.0, 3.0], [0.0, 0.1, 3.0]])
    for moment, cloud in enumerate(clouds()):
        points = torch.cat([cloud.points, wall, moved(far, moment)])
        later = None if cloud.later is None else torch.cat([cloud.later, wall, moved(far, moment + 1)])
        wrong.append(Cloud(points, torch.zeros_like(points), points[:, 0] < 9, cloud.time, later))
    found, _ = gather(wrong, MOMENTS // 2, 10_000, 0)
    assert float(found.points[:, 1].max()) < 1.0 and float(found.points[:, 2].max()) < 1.0 and len(found.points) > 300


def test_without_tracks_the_first_cloud_is_all():
    found, tracks = gather([cloud._replace(later=None) for cloud in clouds()], 3, 10, 0)
    assert tracks is None and torch.equal(found.points, clouds()[3].points)


def test_where_tracks_show_that_nothing_moves_there_is_nothing():
    resting = [cloud._replace(points=clouds()[0].points, later=clouds()[0].points) for cloud in clouds()]
    assert gather(resting, 4, 100, 0) == (None, None)


def test_places_that_images_show_stop_the_drift():
    """The steps turn the box by too little; two thirds of what the first cloud saw is seen again, to a hair."""
    drifting = clouds()
    for number, cloud in enumerate(drifting[:-1]):
        assert cloud.later is not None
        drifting[number] = cloud._replace(later=cloud.points + 0.95 * (cloud.later - cloud.points))
    points, start = body()[:600], MOMENTS // 2
    asked: list[float] = []

    def seen(time: float, expected: np.ndarray) -> np.ndarray:
        asked.append(time)
        there = moved(points, round(8 * time)).double().numpy()
        return np.where((np.arange(len(points)) % 3 < 2)[:, None], there, np.nan)

    alone, corrected = follow(points, start, drifting, 0.2), follow(points, start, drifting, 0.2, seen)
    assert alone is not None and corrected is not None
    assert sorted(asked) == [k / 8 for k in range(MOMENTS) if k != start]
    for moment in (0, MOMENTS - 1):
        true = moved(points, moment)
        drift, left = ((tracks.places[moment] - true).norm(dim=1) for tracks in (alone, corrected))
        assert float(left.median()) < 0.1 * float(drift.median()), moment
        assert float(left[2::3].median()) < 0.1 * float(drift[2::3].median()), "those that are not seen go along"
        assert float(corrected.weights[moment].mean()) > float(alone.weights[moment].mean())


def test_too_few_places_change_nothing():
    points = body()[:100]

    def seen(time: float, expected: np.ndarray) -> np.ndarray:
        there = np.full(expected.shape, np.nan)
        there[:10] = expected[:10] + 0.3
        return there

    one, two = follow(points, 4, clouds(), 0.2), follow(points, 4, clouds(), 0.2, seen)
    assert one is not None and two is not None
    assert torch.equal(one.places, two.places) and torch.equal(one.weights, two.weights)
