"""Steps of several views: their gradients are averaged, and their statistics added."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.errors import UserError
from scgs_warp.training.frames import Frames
from scgs_warp.training.multi_view import all_views, check_share
from scgs_warp.training.state import TrainState
from scgs_warp.training.step import one_view
from scgs_warp.types import Stats


def begin(batch: int) -> tuple[TrainState, Frames]:
    """A state past the stages in which the control points rest, and its frames."""
    data = tiny_dataset(6)
    config = tiny_config(40, batch=batch, freeze=0, pretrain={"steps": 0})
    state = TrainState.begin(config, data, "cpu")
    return state, Frames(data, state.normalisation, config, "cpu")


def test_a_batch_is_the_mean_of_its_views():
    state, frames = begin(3)
    views, sums = [], Stats.zeros(len(state.gaussians), "cpu")
    for view in range(3):
        result = one_view(state, frames, view, sums)
        views.append((result, {k: g.clone() for o in state.optimizers() for k, g in o.gradients()}))
        for optimizer in state.optimizers():
            optimizer.zero_grad()
    before = float(state.stats.count.sum())
    result = all_views(state, frames, one_view)
    assert before == 0 and torch.equal(state.stats.count, sums.count) and float(sums.count.max()) == 3
    assert torch.equal(state.stats.max_radii, sums.max_radii)
    assert torch.equal(state.stats.grad_norm, sums.grad_norm)
    assert float(result.loss) == pytest.approx(sum(float(one.loss) for one, _ in views) / 3, rel=1e-6)
    gradients = dict(pair for optimizer in state.optimizers() for pair in optimizer.gradients())
    assert gradients.keys() == views[0][1].keys() and "network.head.weight" in gradients
    for name, gradient in gradients.items():
        expected = (views[0][1][name] + views[1][1][name] + views[2][1][name]) / 3
        torch.testing.assert_close(gradient, expected, rtol=1e-5, atol=1e-9)


def test_every_view_once_an_epoch():
    for batch in (2, 3):
        _, frames = begin(batch)
        seen = [frames.index_at(step, False, view) for step in range(6 // batch) for view in range(batch)]
        assert sorted(seen) == list(range(6))


def test_a_failed_view_drops_the_step():
    state, frames = begin(2)

    def broken(state, frames, view, stats):
        result = one_view(state, frames, view, stats)
        return result._replace(failed="regulariser") if view == 1 else result

    assert all_views(state, frames, broken).failed == "regulariser"
    assert not state.stats.count.any(), "statistics of a dropped step do not count"


def test_a_batch_is_shared_evenly_or_refused():
    config = tiny_config(40, batch=6)
    for size in (1, 2, 3, 6):
        check_share(config, SimpleNamespace(size=size))  # type: ignore[arg-type]
    check_share(config, None)
    with pytest.raises(UserError, match=r"batch is 6, which 4 processes .* --batch a multiple of 4"):
        check_share(config, SimpleNamespace(size=4))  # type: ignore[arg-type]


def test_chunks_of_time_are_not_shared():
    """Each process would have gradients of other networks."""
    config = tiny_config(40, batch=2, motion={"chunks": 2})
    check_share(config, None)
    check_share(config, SimpleNamespace(size=1))  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"motion\.chunks is 2, which 2 processes cannot share"):
        check_share(config, SimpleNamespace(size=2))  # type: ignore[arg-type]
