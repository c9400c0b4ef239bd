"""End-point error and jitter on tracks whose values are known by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from scgs_warp.errors import UserError
from scgs_warp.evaluation.motion_metrics import GroundTruth, load_ground_truth, score_motion, score_tracks

TIMES = torch.linspace(0, 1, 5)


def truth(points: torch.Tensor, visible: torch.Tensor | None = None, height: float = 2.0) -> GroundTruth:
    visible = torch.ones(3, points.shape[1], dtype=torch.bool) if visible is None else visible
    return GroundTruth(points, torch.linspace(0, 1, len(points)), visible, height)


def two_points() -> torch.Tensor:
    """One rests at (0, 0, 0), one moves from (1, 0, 0) to (1, 0, 1)."""
    points = torch.zeros(5, 2, 3)
    points[:, 1, 0] = 1.0
    points[:, 1, 2] = TIMES
    return points


def test_perfect_motion_with_an_offset_scores_zero():
    points = two_points()
    offset = torch.tensor([0.1, -0.05, 0.02])
    score = score_motion(truth(points), lambda time: points[round(time * 4)] + offset, torch.ones(2))
    assert score.epe == pytest.approx(0, abs=1e-5) and score.jitter == pytest.approx(0, abs=1e-5)


def test_no_motion_scores_the_mean_displacement():
    points = two_points()
    score = score_motion(truth(points), lambda time: points[0], torch.ones(2))
    # Displacements 0, 1/4, 1/2, 3/4, 1 of one of two points: mean 1/4, in percent of 2.
    assert score.epe == pytest.approx(12.5)
    assert score.jitter == pytest.approx(0, abs=1e-5)  # uniform motion bends nothing


def test_jitter_of_a_zigzag():
    true = torch.zeros(5, 1, 3)
    predicted = true.clone()
    predicted[1::2, 0, 1] = 0.03  # 0, .03, 0, .03, 0: second differences of norm 0.06
    score = score_tracks(predicted, true, height=1.5)
    assert score.jitter == pytest.approx(4.0)
    assert score.epe == pytest.approx(100 * 0.03 * 2 / 5 / 1.5)


def test_true_bends_do_not_count_as_jitter():
    true = torch.zeros(5, 1, 3)
    true[:, 0, 2] = torch.tensor([0.0, 0.5, -0.3, 0.2, 0.9])
    assert score_tracks(true + 1.0, true, 1.0).jitter == pytest.approx(0, abs=1e-4)


def test_only_opaque_gaussians_carry():
    points = two_points()
    start = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [1.3, 0, 0]])

    def positions(time: float) -> torch.Tensor:
        moved = start.clone()
        moved[1, 2] -= 7 * time  # nearest, but see-through, and wrong
        moved[2, 2] += time
        return moved

    assert score_motion(truth(points), positions, torch.tensor([0.9, 0.5, 0.51])).epe == pytest.approx(0, abs=1e-5)
    assert score_motion(truth(points), positions, torch.tensor([0.9, 0.6, 0.51])).epe == pytest.approx(8 * 12.5)
    # None opaque: all are candidates.
    assert score_motion(truth(points), positions, torch.full((3,), 0.1)).epe == pytest.approx(8 * 12.5)


def test_points_that_no_view_sees_are_left_out():
    points = two_points()
    visible = torch.tensor([[False, False], [True, False]])
    assert score_motion(truth(points, visible), lambda time: points[0], torch.ones(2)).epe == pytest.approx(0)
    visible = torch.tensor([[False, False], [False, True]])
    assert score_motion(truth(points, visible), lambda time: points[0], torch.ones(2)).epe == pytest.approx(25.0)


def test_nothing_to_score_is_nan():
    points = two_points()
    hidden = torch.zeros(2, 2, dtype=torch.bool)
    assert math.isnan(score_motion(truth(points, hidden), lambda time: points[0]).epe)
    assert math.isnan(score_motion(truth(points), lambda time: torch.zeros(0, 3), torch.zeros(0)).epe)
    single = score_motion(truth(points[:1]), lambda time: points[0])
    assert single.epe == 0 and math.isnan(single.jitter)


@pytest.mark.parametrize("seed", range(3))
def test_carriers_match_brute_force(seed):
    generator = torch.Generator().manual_seed(seed)
    true = torch.randn(4, 300, 3, generator=generator)
    centres = torch.randn(77, 3, generator=generator)
    motion = torch.randn(4, 77, 3, generator=generator)
    motion[0] = 0
    score = score_motion(truth(true), lambda time: centres + motion[round(time * 3)])
    total = 0.0
    for p in range(300):
        carrier = min(range(77), key=lambda n, p=p: float((true[0, p] - centres[n]).norm()))
        total += sum(float((true[0, p] + motion[t, carrier] - true[t, p]).norm()) for t in range(4))
    assert score.epe == pytest.approx(100 * total / 1200 / 2.0, rel=1e-5)


def test_wrong_shapes_raise():
    points = two_points()
    with pytest.raises(ValueError, match="opacities"):
        score_motion(truth(points), lambda time: points[0], torch.ones(3))
    with pytest.raises(ValueError, match="positions_at"):
        score_motion(truth(points), lambda time: points[0, : 2 - round(time)])


def test_ground_truth_file(tmp_path):
    assert load_ground_truth(tmp_path) is None
    points = two_points().numpy()
    good = {"points": points, "times": TIMES.numpy(), "visible": np.ones((3, 2), bool), "height": np.float32(2)}
    np.savez(tmp_path / "ground_truth.npz", **good)
    loaded = load_ground_truth(tmp_path)
    assert loaded is not None and loaded.height == 2.0 and torch.equal(loaded.points, two_points())
    changes = {"points": points[..., :2], "visible": np.ones((3, 1), bool), "height": np.float32(-1)}
    for name, value in changes.items():
        np.savez(tmp_path / "ground_truth.npz", **{**good, name: value})
        with pytest.raises(UserError, match=name):
            load_ground_truth(tmp_path)
    del good["times"]
    np.savez(tmp_path / "ground_truth.npz", **good)
    with pytest.raises(UserError, match="times"):
        load_ground_truth(tmp_path)
    (tmp_path / "ground_truth.npz").write_bytes(b"not a zip")
    with pytest.raises(UserError, match="no sound numpy file"):
        load_ground_truth(tmp_path)
