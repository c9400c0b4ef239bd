"""Controls for the scene's own motion: regions held still, exaggeration and damping."""

from __future__ import annotations

import dataclasses
from typing import Any

from ...edit.playback import Exaggerate, Hold
from ...errors import UserError
from .host import Host

NONE = "none"
UNCHANGED = 1.0
MAX_FACTOR = 3.0
"""Strongest exaggeration that the slider offers; scripts may set more."""


class MotionSection:
    """Holds and exaggeration of the selection at the moment shown."""

    def __init__(self, host: Host) -> None:
        self.host, self.model = host, host.model
        self._add_holds()
        self._add_exaggeration()

    def _add_holds(self) -> None:
        gui = self.host.server.gui
        with gui.add_folder("Hold still"):
            self.list = gui.add_markdown("")
            self.frame = gui.add_dropdown(
                "It stays", ("body", "world"), hint="Follow the surrounding body, or stay in place"
            )
            self.rings = gui.add_slider("Rings that bend", 0, 12, 1, Hold(()).rings)
            self.add = gui.add_button("Hold the selection as it is now")
            self.add.on_click(self.host.guarded(lambda event: self.hold_selection()))
            self.chosen = self.host.on_value(gui.add_dropdown("Hold", (NONE,)), self.select_hold)
            self.remove = gui.add_button("Let go of this one")
            self.remove.on_click(self.host.guarded(lambda event: self.release_hold()))

    def _add_exaggeration(self) -> None:
        gui, on = self.host.server.gui, self.host.on_value
        with gui.add_folder("Exaggerate"):
            self.factor = on(
                gui.add_slider(
                    "Motion times", 0.0, MAX_FACTOR, 0.05, UNCHANGED, hint="Scales every turn; 1 changes nothing"
                ),
                lambda factor: self.exaggerate(factor=float(factor)),
            )
            self.buttons = gui.add_button_group("", ("Only selection", "All", "Off"))
            self.buttons.on_click(self.host.guarded(lambda event: self.set_extent(event.target.value)))
            self.about = gui.add_button_group("Unchanged", ("Mean pose", "This moment"))
            self.about.on_click(self.host.guarded(lambda event: self.set_reference(event.target.value)))
            self.extent = gui.add_markdown("")

    def hold_selection(self) -> None:
        nodes = self._selection()
        hold = Hold(nodes, self.model.time, self.frame.value, int(self.rings.value))
        kept = tuple(other for other in self.model.session.edit.holds if other.nodes != nodes)
        self.model.replace(holds=(*kept, hold))

    def _selection(self) -> tuple[int, ...]:
        if not self.model.selection:
            raise UserError("nothing is chosen; click on the picture first")
        return self.model.selection

    def select_hold(self, name: str) -> None:
        hold = self._holds().get(name)
        if hold is not None:
            self.model.select(hold.nodes)

    def release_hold(self) -> None:
        gone = self._holds().get(self.chosen.value)
        if gone is None:
            raise UserError("no hold is chosen; choose one from the list first")
        self.model.replace(holds=tuple(hold for hold in self.model.session.edit.holds if hold is not gone))

    def _holds(self) -> dict[str, Hold]:
        return {f"hold {i}": hold for i, hold in enumerate(self.model.session.edit.holds, 1)}

    def exaggerate(self, **fields: Any) -> None:
        present = self.model.session.edit.exaggerate or Exaggerate(UNCHANGED)
        self.model.replace(exaggerate=dataclasses.replace(present, **fields))

    def set_extent(self, what: str) -> None:
        if what == "Off":
            self.model.replace(exaggerate=None)
        else:
            self.exaggerate(nodes=() if what == "All" else self._selection())

    def set_reference(self, what: str) -> None:
        self.exaggerate(about=None if what == "Mean pose" else self.model.time)

    def show(self) -> None:
        holds, edit = self._holds(), self.model.session.edit
        rows = [f"| {name} | {len(h.nodes)} | {h.time:.2f} | {h.frame} |" for name, h in holds.items()]
        head = "| | control points | as at time | stays on |\n|---|---|---|---|\n"
        self.list.content = head + "\n".join(rows) if rows else "*None yet: choose a limb, then hold it.*"
        names = (NONE, *holds)
        if self.chosen.options != names:
            self.chosen.options = names
        match = (name for name, hold in holds.items() if hold.nodes == self.model.selection)
        self.chosen.value = next(match, NONE)
        exaggerate = edit.exaggerate or Exaggerate(UNCHANGED)
        self.factor.max = max(MAX_FACTOR, exaggerate.factor)
        self.factor.min = min(0.0, exaggerate.factor)
        self.factor.value = exaggerate.factor
        whom = f"{len(exaggerate.nodes)} control points" if exaggerate.nodes else "everything"
        about = "the mean pose" if exaggerate.about is None else f"the pose of time {exaggerate.about:.2f}"
        self.extent.content = f"*Of {whom}, away from {about}.*" if edit.exaggerate else "*Off.*"
