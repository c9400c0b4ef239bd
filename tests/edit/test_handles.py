"""Handles: targets, strength over time, checked fields."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from helpers.edit_scenes import bar_scene
from helpers.edit_sessions import TURN, motion, part
from scgs_warp.edit import EditSession, Handle, Target
from scgs_warp.errors import UserError


@pytest.mark.parametrize("lasts", ["frame", "fade"])
@pytest.mark.parametrize("stiffness", [None, 0.5])
def test_handles_have_no_effect_outside_their_time(lasts, stiffness):
    """Beside another one, too: it is as if they were not there."""
    session = EditSession(bar_scene())
    session.pin(part(session, 0.0, 0.2))
    session.add_handle(part(session, 0.8, 1.0), 0.0, "end")
    session.move("end", [0.0, 0.1, 0.0], TURN)
    alone = [session.node_positions(time) for time in (0.0, 0.4, 0.69, 1.0)]
    session.add_handle(part(session, 0.45, 0.6), 0.5, "middle", lasts=lasts, window=0.18, stiffness=stiffness)
    for target in ([0.0, 0.0, 0.0], [0.0, 0.0, 0.1]):
        session.move("middle", target)
        beside = [session.node_positions(time) for time in (0.0, 0.4, 0.69, 1.0)]
        shown = [np.array_equal(a, b) for a, b in zip(alone, beside)]
        assert shown == [True, lasts == "frame", True, True]


def test_fading_handles_let_go_without_a_jump():
    session = EditSession(bar_scene())
    session.pin(part(session, 0.0, 0.2))
    session.add_handle(part(session, 0.8, 1.0), 0.0, "end")
    session.move("end", [0.0, 0.15, 0.0], TURN)
    session.add_handle(part(session, 0.45, 0.6), 0.0, "middle", lasts="fade", window=0.5)
    session.move("middle", [0.0, 0.0, 0.1])

    def jump(first: float, second: float) -> float:
        """Beyond what the motion does."""
        before, after = (session.node_positions(time) - motion(session, time) for time in (first, second))
        return float(np.abs(after - before).max())

    assert jump(0.0, 0.5) > 0.05, "it does something"
    for time in (0.0, 1e-4, 0.25, 0.49, 0.4999, 0.5 - 1e-7):
        assert jump(time, time + 2e-4) < 2e-3, time
    times = np.linspace(0.0, 0.52, 27)
    assert max(jump(a, b) for a, b in pairwise(times)) < 0.03


def test_a_fading_handle_alone_moves_its_piece_by_its_share():
    session = EditSession(bar_scene())
    session.add_handle(part(session, 0.8, 1.0), 0.0, "end", lasts="fade", window=1.0)
    session.move("end", [0.0, 0.0, 0.2], TURN)
    share = session.edit.handles[0].strength(0.4)
    assert 0.3 < share < 0.7
    base = session.engine.motion_at(0.4).positions
    bent = session.engine.bend(session.edit, 0.4)
    assert bent is not None
    lengths = [np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (base, bent.positions)]
    np.testing.assert_allclose(lengths[1], lengths[0], atol=2e-3)
    turned = np.degrees(2 * np.arccos(np.abs(bent.turns[:, 0]).clip(max=1.0)))
    np.testing.assert_allclose(turned, 40 * share, atol=0.5)


def test_target_is_unit():
    target = Target.of(None, [2.0, 0.0, 0.0, 0.0])
    assert target.rotation == (1.0, 0.0, 0.0, 0.0) and target.is_identity
    assert Target.of(None, [1e300, 0, 0, 1e300]).rotation == pytest.approx((2**-0.5, 0, 0, 2**-0.5))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("name", ""),
        ("name", "two\nlines"),
        ("time", 1.5),
        ("time", float("nan")),
        ("pivot", (0.0, 0.0)),
        ("pivot", (0.0, 0.0, float("inf"))),
        ("stiffness", 0.0),
        ("turns", "yes"),
        ("lasts", "for ever"),
        ("window", -1.0),
    ],
)
def test_a_handle_refuses_fields_that_no_file_may_hold(field, value):
    fields = {"name": "a", "nodes": (1,), field: value}
    with pytest.raises(UserError, match=field):
        Handle(**fields)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_handle_takes_numpy_values(kind):
    array = np.array([0.25, 1.0, 2.0], kind)
    for pivot in (array, tuple(array)):
        handle = Handle("a", (1,), time=kind(0.5), pivot=pivot, window=kind(0.25))
        assert handle == Handle("a", (1,), time=0.5, pivot=(0.25, 1.0, 2.0), window=0.25)
        assert type(handle.time) is float and all(type(x) is float for x in handle.pivot)
    with pytest.raises(UserError, match="pivot"):
        Handle("a", (1,), pivot=np.array([0.0, np.nan, 1.0], kind))


def test_a_handle_holds_plain_numbers():
    handle = Handle("a", (1,), time=1, pivot=[1, 2, 3], stiffness=np.float64(2.0))
    assert handle == Handle("a", (1,), 1.0, (1.0, 2.0, 3.0), 2.0) and hash(handle)
    assert [type(x) for x in (handle.time, *handle.pivot, handle.stiffness)] == [float] * 5


@pytest.mark.parametrize("numbers", [((0.0, 0.0, float("nan")),), ((0.0, 0.0, 0.0), (float("inf"), 0.0, 0.0, 0.0))])
def test_a_target_that_is_not_finite_is_refused(numbers):
    with pytest.raises(UserError, match=r"give 3 numbers from|give 4 finite numbers"):
        Target(*numbers)
