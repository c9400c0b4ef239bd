"""Controls for the shape: extent of a click's selection, handles, pins."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from ...edit import Target
from ...edit.handles import STAY
from ...edit.rotations import exponential, logarithm
from ...errors import UserError
from .host import Host

NEW = "new, from the selection"
EXACT = 0.0
"""Stiffness that stands for None in the panel: nodes go exactly to the target."""


class ShapeSection:
    """Selection, handle, pins."""

    def __init__(self, host: Host) -> None:
        self.host, self.model = host, host.model
        self._add_selection()
        self._add_handle()
        self._add_pins()

    def _add_selection(self) -> None:
        gui, model, on = self.host.server.gui, self.model, self.host.on_value
        unit = self.host.edge_length
        with gui.add_folder("Selection"):
            self.parts = on(
                gui.add_checkbox(
                    "Parts first", True, hint="A click takes the part under it, a second one its control points"
                ),
                self.host.parts.set,
            )
            self.kind = on(gui.add_dropdown("A click takes", ("rings", "brush")), lambda kind: self._region(kind=kind))
            self.rings = on(gui.add_slider("Rings", 0, 12, 1, model.region.rings), lambda n: self._region(rings=n))
            self.radius = on(
                gui.add_slider("Brush", 0.5 * unit, 12 * unit, 0.1 * unit, 2 * unit), lambda r: self._region(radius=r)
            )
            model.region = dataclasses.replace(model.region, radius=2 * unit)
            self.combine = on(
                gui.add_dropdown("and it is", ("replace", "add", "subtract")),
                lambda how: model.set(combine=how),
            )
            self.buttons = gui.add_button_group("", ("Grow", "All", "None"))
            self.buttons.on_click(self.host.guarded(lambda event: self._select(event.target.value)))

    def _region(self, **fields: Any) -> None:
        self.model.set(region=dataclasses.replace(self.model.region, **fields))

    def _select(self, what: str) -> None:
        model, session = self.model, self.model.session
        if what == "Grow":
            if not model.selection:
                raise UserError("nothing is chosen; click on the picture first")
            model.select(session.ring(model.selection, 1))
        else:
            model.select(tuple(range(len(session))) if what == "All" else ())

    def _add_handle(self) -> None:
        gui, model, on = self.host.server.gui, self.model, self.host.on_value
        with gui.add_folder("Handle"):
            self.handle = on(
                gui.add_dropdown("Handle", (NEW,)), lambda label: model.activate(self.handle_labels()[label])
            )
            self.move = on(
                gui.add_vector3("Move", (0.0, 0.0, 0.0), step=_round(0.1 * self.host.edge_length)), self.move_handle
            )
            self.turn = on(
                gui.add_vector3(
                    "Turn, degrees", (0.0, 0.0, 0.0), step=1.0, hint="About x, y and z at once: an axis times an angle"
                ),
                self.turn_handle,
            )
            self.lasts = on(
                gui.add_dropdown(
                    "It lasts", ("motion", "frame", "fade"), hint="The whole motion, one frame, or fading out"
                ),
                lambda lasts: self._set(lasts=lasts),
            )
            self.window = on(
                gui.add_number("Fades over", model.window, min=0.001, max=10.0, step=0.01),
                lambda w: self._set(window=w),
            )
            self.stiffness = on(
                gui.add_number("Stiffness", EXACT, min=0.0, max=1e6, step=0.01, hint="0: exactly at the target"),
                lambda s: self._set(stiffness=None if s == EXACT else s),
            )
            self.remove = gui.add_button_group("", ("Put back", "Remove"))
            self.remove.on_click(self.host.guarded(lambda event: self._ended(event.target.value)))

    def handle_labels(self) -> dict[str, str | None]:
        """Return the handles' names (None: a new handle) by the labels to show, which are made unique."""
        labels: dict[str, str | None] = {NEW: None}
        for handle in self.model.session.edit.handles:
            label = handle.name
            while label in labels:
                label += " (handle)"
            labels[label] = handle.name
        return labels

    def move_handle(self, where: tuple[float, float, float]) -> None:
        self.host.put(Target.of(where, self.model.target.rotation))

    def turn_handle(self, degrees: tuple[float, float, float]) -> None:
        if not all(map(math.isfinite, degrees)):
            raise UserError(f"turn {list(degrees)}: must be three finite numbers; the handle stays where it is")
        turn = exponential(np.radians(degrees))
        self.host.put(Target.of(self.model.target.translation, turn.tolist()))

    def _set(self, **fields: Any) -> None:
        """Change fields of the active handle and of handles made later."""
        self.model.set(**fields)
        if self.model.active is not None:
            self.model.change_handle(**fields)

    def _ended(self, what: str) -> None:
        if what == "Put back":
            self.host.put(STAY)
        else:
            self.model.remove_handle()

    def _add_pins(self) -> None:
        gui, model, on = self.host.server.gui, self.model, self.host.on_value
        with gui.add_folder("Pins"):
            self.rest = on(
                gui.add_checkbox(
                    "Pin the rest", model.pin_rings is not None, hint="A new handle pins everything far from it"
                ),
                lambda pinned: model.set(pin_rings=int(self.distance.value) if pinned else None),
            )
            self.distance = on(
                gui.add_slider("beyond so many rings", 0, 20, 1, model.pin_rings or 3),
                lambda rings: model.set(pin_rings=int(rings) if self.rest.value else None),
            )
            self.pins = gui.add_button_group("", ("Pin", "Unpin", "Pin rest", "Unpin all"))
            self.pins.on_click(self.host.guarded(lambda event: self._pin(event.target.value)))

    def _pin(self, what: str) -> None:
        model = self.model
        if what in ("Pin", "Unpin") and not model.selection:
            raise UserError("nothing is chosen; click on the picture first")
        if what == "Pin rest" and not model.session.edit.handles:
            raise UserError("there is no handle yet: all would be pinned; take hold of something first")
        with model.changing() as session:
            if what == "Pin":
                session.pin(model.selection)
            elif what == "Unpin":
                session.unpin(model.selection)
            elif what == "Pin rest":
                session.pin_rest(int(self.distance.value))
            else:
                session.unpin()

    def show(self) -> None:
        model, edit = self.model, self.model.session.edit
        self.parts.value = self.host.parts.on
        self.kind.value, self.rings.value, self.combine.value = model.region.kind, model.region.rings, model.combine
        self.rings.visible, self.radius.visible = model.region.kind == "rings", model.region.kind == "brush"
        labels = self.handle_labels()
        if self.handle.options != tuple(labels):
            self.handle.options = tuple(labels)
        self.handle.value = next((label for label, name in labels.items() if name == model.active), NEW)
        handle = edit.handle(model.active or "")
        source = handle or model
        self.lasts.value, self.window.value = source.lasts, source.window
        self.stiffness.value = EXACT if source.stiffness is None else source.stiffness
        self.window.visible = source.lasts == "fade"
        self.show_target()
        self.rest.value = model.pin_rings is not None

    def show_target(self) -> None:
        """Show the target of the active handle at the moment shown."""
        target = self.model.target
        turned = tuple(np.degrees(logarithm(np.array(target.rotation))).tolist())
        for control, value in ((self.move, target.translation), (self.turn, turned)):
            if control.value != value:
                control.value = value


def _round(length: float) -> float:
    """Return the largest power of ten up to a length, as a step that suits the scene's size."""
    return 10.0 ** math.floor(math.log10(length)) if length > 0 else 0.01
