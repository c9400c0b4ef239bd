"""Any order of scrubbing, playing, dragging, keying, undoing and redoing, against a model of what must be kept."""

from __future__ import annotations

import functools
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, settings
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import EditSession, edit_file
from scgs_warp.edit.field_reader import FieldReader
from scgs_warp.editor.app import REQUESTS
from scgs_warp.editor.model import EditorModel
from scgs_warp.editor.parts_tool import PartsTool
from scgs_warp.errors import UserError

SECONDS = st.sampled_from([0.0, 0.5, 1.0, 1.5, 2.0, 4.0])


@functools.cache
def loaded() -> EditSession:
    return EditSession(bar_scene(nodes=24, gaussians=200))


class Desk:
    """What requests of a page work on, without a server."""

    def __init__(self) -> None:
        self.session = loaded().fork()
        self.model = EditorModel(self.session)
        self.parts = PartsTool(self.model)
        self.parts.set(False)
        self.held = None
        self.title = "bar"


class Histories(RuleBasedStateMachine):
    """The Python model: all edits so far as bytes, the place in them, and the keyframes by second."""

    @initialize()
    def open(self) -> None:
        self.desk: Any = Desk()
        self.past, self.future = [self.bytes()], []
        self.keys: set[float] = set()

    def bytes(self) -> str:
        return edit_file.to_json(self.desk.session.edit, self.desk.session.engine)

    def ask(self, what: str, at: float | None = None, /, **fields: Any) -> bool:
        """Do as the editor does with a request; return whether it was accepted."""
        if at is not None:
            self.desk.model.look(at)
        try:
            REQUESTS[what](self.desk, FieldReader(fields, "the page"))
        except UserError:
            return False
        return True

    def changed(self) -> None:
        now = self.bytes()
        if now != self.past[-1]:
            self.past.append(now)
            self.future = []

    @rule(at=SECONDS, up=st.integers(-3, 3), moves=st.integers(0, 3), escape=st.booleans())
    def drag(self, at: float, up: int, moves: int, escape: bool) -> None:
        grip = self.desk.session.node_positions(0.0)[0].tolist()
        self.ask("pick", at, point=grip, how="replace")
        if not self.ask("grab", at):
            return
        for move in range(moves):
            self.ask("drag", grip=grip, to=[grip[0], grip[1], grip[2] + 0.1 * up * (move + 1)])
        self.ask("cancel" if escape else "release", at)
        if self.keys and moves and not escape and self.bytes() != self.past[-1]:
            self.keys.add(at)
        self.changed()

    @rule(at=SECONDS)
    def key(self, at: float) -> None:
        if self.ask("key", at, easing="smooth"):
            self.keys.add(at)
        self.changed()

    @precondition(lambda self: self.keys)
    @rule(data=st.data())
    def unkey(self, data: st.DataObject) -> None:
        at = data.draw(st.sampled_from(sorted(self.keys)))
        assert self.ask("change_key", what="delete", **{"from": at})
        self.keys.discard(at)
        self.changed()

    @precondition(lambda self: self.keys)
    @rule(data=st.data(), to=SECONDS, copy=st.booleans())
    def move_key(self, data: st.DataObject, to: float, copy: bool) -> None:
        at = data.draw(st.sampled_from(sorted(self.keys)))
        assert self.ask("change_key", what="copy" if copy else "move", to=to, **{"from": at})
        self.keys = (self.keys if copy else self.keys - {at}) | {to}
        self.changed()

    @rule(at=SECONDS)
    def scrub(self, at: float) -> None:
        self.desk.model.look(at)
        self.ask("tool", rings=2)
        assert self.bytes() == self.past[-1], "looking elsewhere changes nothing"

    @rule(begin=SECONDS, fps=st.sampled_from([10, 30]))
    def play(self, begin: float, fps: int) -> None:
        for frame in range(5):
            self.desk.model.look(begin + frame / fps)
        assert self.bytes() == self.past[-1], "playing changes nothing"

    @rule()
    def undo(self) -> None:
        assert self.ask("undo") == (len(self.past) > 1)
        if len(self.past) > 1:
            self.future.append(self.past.pop())
        self.remember_keys()

    @rule()
    def redo(self) -> None:
        assert self.ask("redo") == bool(self.future)
        if self.future:
            self.past.append(self.future.pop())
        self.remember_keys()

    def remember_keys(self) -> None:
        assert self.bytes() == self.past[-1], "undo and redo return to the same bytes"
        self.keys = {frame.at for frame in self.desk.session.edit.keyframes}

    @invariant()
    def no_keyframe_is_lost(self) -> None:
        if hasattr(self, "keys"):
            assert {frame.at for frame in self.desk.session.edit.keyframes} == self.keys
            assert not self.desk.model.dragging


def run(examples: int, steps: int) -> None:
    quiet = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
    chosen = settings(
        max_examples=examples, stateful_step_count=steps, deadline=None, database=None, suppress_health_check=quiet,
        derandomize=True,
    )  # fmt: skip
    run_state_machine_as_test(Histories, settings=chosen)


def test_no_order_of_actions_loses_anything():
    run(8, 30)


@pytest.mark.slow
def test_two_thousand_actions():
    run(80, 50)
