"""Neighbouring parts that the motion does not tell apart."""

from __future__ import annotations

import math

import numpy as np
import pytest

from helpers.jointed_rods import chain
from scgs_warp.edit.parts import find_parts, fit_parts, relative_turns
from scgs_warp.edit.shared_motion import MOST_LOST, MOST_OFF, find_shared


@pytest.mark.parametrize(
    "degrees, noise, parts_found", [(30.0, 0.0, 2), (30.0, 0.005, 2), (30.0, 0.05, 1), (60.0, 0.05, 2)]
)
def test_a_turn_that_the_motion_hardly_shows_is_no_joint(degrees, noise, parts_found):
    patches, segment, _ = chain([degrees], noise=noise)
    pooled, motions = fit_parts(patches.moments, segment)
    assert math.degrees(relative_turns(pooled, motions, np.array([[0, 1]]))[0]) > 20.0, "the turn alone is a joint"
    assert find_parts(patches).max() + 1 == parts_found
    assert find_parts(patches, 2).max() + 1 == 2, "two are asked for"


def test_a_well_known_part_beside_a_badly_known_one_keeps_its_joint():
    """Most of the body is noisy, so that the turn of its end is small beside the distance of a typical patch; but the
    end's own motion explains it far better."""
    patches, segment, _ = chain([60.0, 60.0, 40.0], noise=[0.2, 0.2, 0.2, 0.01])
    pairs, fits = np.array([[0, 1], [1, 2], [2, 3]]), fit_parts(patches.moments, segment)
    own = patches.moments.errors_under(fits[1])[np.arange(len(segment)), segment]
    far = np.flatnonzero(segment == 3)
    both = patches.moments.take(np.flatnonzero(segment >= 2))
    errors = both.errors_under(fit_parts(both, np.zeros(20, np.int64))[1])[10:, 0]
    lost = errors.sum() / own[far].sum(), errors.mean() / np.median(own)
    assert lost[0] > MOST_LOST**2 and lost[1] < MOST_OFF**2, "the second bound alone would merge it"
    assert find_shared(patches.moments, segment, fits[1], pairs[2:], np.ones(1), fit_parts) is None


def test_of_several_pairs_the_one_that_shares_its_motion_best_is_merged():
    patches, segment, _ = chain([60.0, 20.0, 25.0], noise=0.02)
    pairs, motions = np.array([[0, 1], [1, 2], [2, 3]]), fit_parts(patches.moments, segment)[1]
    assert find_shared(patches.moments, segment, motions, pairs, np.ones(3), fit_parts) == 1
    assert find_shared(patches.moments, segment, motions, pairs[[0, 2]], np.ones(2), fit_parts) == 1
    assert find_shared(patches.moments, segment, motions, pairs[:1], np.ones(1), fit_parts) is None


def test_two_badly_known_parts_of_a_well_known_body_do_not_merge():
    """One motion explains both nearly as well as their own do, but not as well as others explain theirs."""
    patches, segment, _ = chain([60.0, 60.0, 60.0, 40.0], noise=[0.01, 0.01, 0.01, 0.2, 0.2])
    last, motions = np.array([[3, 4]]), fit_parts(patches.moments, segment)[1]
    own = patches.moments.errors_under(motions)[np.arange(len(segment)), segment]
    both = patches.moments.take(np.flatnonzero(segment >= 3))
    errors = both.errors_under(fit_parts(both, np.zeros(20, np.int64))[1])[:, 0]
    assert errors.sum() < MOST_LOST**2 * own[segment >= 3].sum() and errors.mean() > MOST_OFF**2 * np.median(own)
    assert find_shared(patches.moments, segment, motions, last, np.ones(1), fit_parts) is None


def test_a_large_body_that_stands_still_does_not_keep_the_others_apart():
    """The first segment holds most of the patches, and its motion is known exactly."""
    patches, segment, _ = chain([60.0, 60.0, 20.0], noise=[0.0, 0.05, 0.05, 0.05])
    rows = np.concatenate([np.flatnonzero(segment == 0)] * 5 + [np.flatnonzero(segment > 0)])
    moments, labels, pair = patches.moments.take(rows), segment[rows], np.array([[2, 3]])
    motions = fit_parts(moments, labels)[1]
    own = moments.errors_under(motions)[np.arange(len(labels)), labels]
    assert np.median(own) < 1e-3 * np.median(own[labels > 0]), "most patches stand still"
    assert find_shared(moments, labels, motions, pair, np.ones(1), fit_parts) == 0


@pytest.mark.parametrize(
    "degrees, noise, decides",
    [([50.0], [0.01, 0.01], "lost"), ([60.0, 60.0, 60.0, 40.0], [0.01, 0.01, 0.01, 0.2, 0.2], "off")],
)
def test_doubt_raises_both_limits_of_a_shared_motion(degrees, noise, decides):
    patches, segment, _ = chain(degrees, noise=noise)
    pair, motions = np.array([len(degrees) - 1, len(degrees)]), fit_parts(patches.moments, segment)[1]
    own = patches.moments.errors_under(motions)[np.arange(len(segment)), segment]
    rows = np.flatnonzero(segment >= pair[0])
    both = patches.moments.take(rows)
    errors = both.errors_under(fit_parts(both, np.zeros(len(rows), np.int64))[1])[:, 0]
    mine = [segment[rows] == part for part in pair]
    lost = max(errors[each].sum() / own[rows][each].sum() for each in mine)
    usual = np.median([np.median((own / patches.moments.count)[segment == part]) for part in range(len(degrees) + 1)])
    off = max(errors[each].sum() / both.count[each].sum() for each in mine) / usual
    needed = {"lost": math.sqrt(lost) / MOST_LOST, "off": math.sqrt(off) / MOST_OFF}
    least = max(needed.values())
    assert needed[decides] == least > 1.2, "without doubt the parts stay apart"
    for doubt, row in ((0.98 * least, None), (1.02 * least, 0)):
        assert find_shared(patches.moments, segment, motions, pair[None], np.array([doubt]), fit_parts) == row


def test_of_several_doubted_pairs_the_one_with_the_least_distance_for_its_doubt_is_merged():
    patches, segment, _ = chain([60.0, 20.0, 25.0], noise=0.02)
    pairs, motions = np.array([[0, 1], [1, 2], [2, 3]]), fit_parts(patches.moments, segment)[1]
    assert find_shared(patches.moments, segment, motions, pairs, np.array([1.0, 1.0, 3.0]), fit_parts) == 2
