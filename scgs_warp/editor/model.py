"""State of the editor besides the edit: selection, moment shown, drag. It is independent of the browser."""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ..edit import Edit, EditSession, Handle, Target, edit_file
from ..edit.handles import STAY
from ..errors import UserError
from .keys import keyed

Combine = Literal["replace", "add", "subtract"]


@dataclass(frozen=True)
class Moment:
    """Instant of the edited scene."""

    time: float
    """Scene time."""
    at: float | None
    """Second of the film at which keyframes place the handles; None: present targets."""
    live: bool
    """True if the edit is previewed, as during a drag."""


BRUSH_EDGES = 2.0
"""Radius of a new editor's brush, in edges of the control graph."""


@dataclass(frozen=True)
class Region:
    """Extent of a click's selection."""

    kind: Literal["rings", "brush"] = "rings"
    rings: int = 2
    radius: float = 0.1
    """World units."""


class EditorModel:
    """State of one editor, shared by all its clients. ``lock`` guards it; no method solves or draws.

    Args:
        session: scene and edit.
        changed: called after every change, without the lock.
    """

    def __init__(self, session: EditSession, changed: Callable[[], None] = lambda: None) -> None:
        self.session = session
        self.changed = changed
        self.lock = threading.RLock()
        self.selection: tuple[int, ...] = ()
        self.active: str | None = None
        edge = session.graph.edge_length / session.engine.units[1]
        self.region = Region(radius=float(f"{BRUSH_EDGES * edge:.2g}"))
        self.pin_rings: int | None = 3
        """Number of rings of nodes around a new handle beyond which all nodes are pinned; None: no node is pinned."""
        self.lasts: Any = "motion"
        self.window = 0.1
        self.stiffness: float | None = None
        self.combine: Combine = "replace"
        self.at = 0.0
        self.dragging = False
        self._dragged: bool | None = None
        """True if the handle was moved since ``grab``; None: no drag."""
        self._led = False
        """True if keyframes placed the handles before ``grab``."""
        self._start: dict[str, Target] = {}
        """Targets when the drag began."""
        self._automatic: deque[tuple[int, ...]] = deque(maxlen=100)
        """Sets of pins that ``grab`` made automatically."""
        self._following = bool(session.edit.keyframes)
        """True if keyframes place the handles: always, once there are any, but during a drag."""

    # Time

    @property
    def seconds(self) -> float:
        return self.session.edit.film.seconds

    @property
    def time(self) -> float:
        """Scene time shown."""
        return self.session.scene_time(self.at)

    def look(self, at: float) -> None:
        """Take a second of the film as the one that a request refers to."""
        with self.lock:
            self.at = min(max(float(at), 0.0), self.seconds) if np.isfinite(at) else self.at

    def moment(self) -> Moment:
        with self.lock:
            at = self.at if self._following and not self.dragging else None
            return Moment(self.time, at, self.dragging)

    # The edit

    @contextlib.contextmanager
    def changing(self) -> Iterator[EditSession]:
        """Yield the session for a change of its edit, then report the change. A drag ends first: what it did is a step
        of its own."""
        with self.lock:
            self._let_go()
            try:
                yield self.session
            finally:
                self._check()
        self.changed()

    def _check(self) -> None:
        """Drop references to what the edit no longer contains."""
        edit = self.session.edit
        if edit.handle(self.active or "") is None:
            self.active = self._holder()
        self.at = min(self.at, self.seconds)
        self._following = bool(edit.keyframes) and not self.dragging

    def undo(self) -> bool:
        with self.changing() as session:
            return session.undo()

    def redo(self) -> bool:
        with self.changing() as session:
            return session.redo()

    def reset(self) -> None:
        """Remove the whole edit; can be undone."""
        with self.changing() as session:
            session.reset()

    def set(self, **fields: Any) -> None:
        """Set attributes of this model that are no part of the edit, such as region and pin_rings."""
        with self.lock:
            for name, value in fields.items():
                setattr(self, name, value)
        self.changed()

    def replace(self, **fields: Any) -> None:
        """Change fields of the edit, checked as if they came from a file: pages may send anything.

        Raises:
            UserError: a field is out of range; the edit stays unchanged.
        """
        with self.changing() as session:
            session.apply(edit_file.checked(dataclasses.replace(session.edit, **fields), session.engine))

    def change_handle(self, **fields: Any) -> None:
        """Change fields of the active handle."""
        with self.changing() as session:
            handle = session.edit.handle(self.active or "")
            if handle is None:
                raise UserError("no handle is chosen; click on the picture, then drag")
            changed = dataclasses.replace(handle, **fields)
            handles = tuple(changed if other is handle else other for other in session.edit.handles)
            session.apply(edit_file.checked(dataclasses.replace(session.edit, handles=handles), session.engine))

    def remove_handle(self) -> None:
        """Remove the active handle; with the last handle, remove automatic pins, too."""
        with self.changing() as session:
            if self.active is None:
                raise UserError("no handle is chosen; click on its control points first")
            draft = session.fork()
            draft.remove_handle(self.active)
            if not draft.edit.handles and self._pins_are_automatic():
                draft.unpin()
            session.apply(draft.edit)

    @property
    def target(self) -> Target:
        """Target of the active handle at the moment shown."""
        with self.lock:
            moment = self.moment()
            return self.session.engine.targets(self.session.edit, moment.at).get(self.active or "", STAY)

    # Selecting

    def select(self, nodes: tuple[int, ...], how: Combine = "replace") -> None:
        with self.lock:
            old, new = set(self.selection), set(nodes)
            chosen = {"replace": new, "add": old | new, "subtract": old - new}[how]
            self.selection = tuple(sorted(chosen))
            self.active = self._holder()
        self.changed()

    def _holder(self) -> str | None:
        """Return the handle that holds exactly the selection, so that no second one is made there; of several, the one
        that counts at the moment shown."""
        held = [handle for handle in self.session.edit.handles if handle.nodes == self.selection]
        acting = [handle.name for handle in held if self.acts(handle)]
        return acting[-1] if acting else held[-1].name if held else None

    def acts(self, handle: Handle) -> bool:
        """Return whether a handle acts at the moment shown."""
        return handle.strength(self.time, self.session.edit.reach) > 0.0

    def prefer_acting(self) -> None:
        """If the active handle does not act at the moment shown, so that dragging it would show nothing, choose another
        one on its control points that does, or only these."""
        with self.lock:
            held = self.session.edit.handle(self.active or "")
            if held is not None and not self.acts(held):
                self.selection = held.nodes
                other = self.session.edit.handle(self._holder() or "")
                self.active = other.name if other is not None and self.acts(other) else None

    def activate(self, name: str | None) -> None:
        """Choose an existing handle and select its nodes."""
        with self.lock:
            handle = self.session.edit.handle(name or "")
            self.active = None if handle is None else handle.name
            self.selection = self.selection if handle is None else handle.nodes
        self.changed()

    # Dragging

    def grab(self, target: Target) -> str:
        """Begin to drag the active handle, or a new one on the selection. A new one starts at ``target``, to which
        other handles have bent the selection, and pins the rest if ``pin_rings`` is set. One undo reverts all of it.

        Raises:
            UserError: nothing is selected; the edit stays unchanged.
        """
        with self.lock:
            self._let_go()
            if self.active is None and not self.selection:
                raise UserError("nothing is chosen; click on the picture first")
            self.begin_drag()
            self.prefer_acting()
            try:
                if self.active is None:
                    draft = self.session.fork()
                    self.active = self._take_hold(draft, target)
                    self.session.preview(draft.edit)
            except UserError:
                self._let_go()
                raise
            name = self.active
        self.changed()
        return name

    def begin_drag(self) -> Edit:
        """Begin a drag; return the edit from which it is measured, in which keyframes no longer place the handles.
        Until ``dragged`` is called, ``release`` restores the edit before it."""
        with self.lock:
            self._let_go()
            self._dragged, self._led = False, self._following
            self._take_over()
            self._start = dict(self.session.edit.targets)
            self.dragging = True
            return self.session.edit

    def dragged(self) -> None:
        """Say that the drag has changed the edit."""
        self._dragged = True

    def _take_hold(self, draft: EditSession, target: Target) -> str:
        """Add a handle on the selection and return its name."""
        automatic = self._pins_are_automatic()
        fields = {"lasts": self.lasts, "window": self.window, "stiffness": self.stiffness}
        handle = draft.add_handle(self.selection, self.time, **fields)
        *others, _ = draft.edit.handles
        row = next((row for row, other in enumerate(others) if other.nodes == handle.nodes), len(others))
        others.insert(row, handle)  # those of other moments count more
        draft.edit = dataclasses.replace(draft.edit, handles=tuple(others))
        if self.pin_rings is not None and (automatic or not draft.edit.pins):
            draft.pin_rest(self.pin_rings)
            self._automatic.append(draft.edit.pins)
        draft.unpin(set(handle.nodes) & set(draft.edit.pins))
        if not target.is_identity:
            draft.move(handle.name, target.translation, target.rotation)
        return handle.name

    def _pins_are_automatic(self) -> bool:
        """Return whether the pins were made by ``grab``, and so may be replaced for the next handle."""
        edit = self.session.edit
        held = {node for handle in edit.handles for node in handle.nodes}
        rings = self.pin_rings
        return edit.pins in self._automatic or (
            rings is not None and edit.pins == self.session.graph.beyond(held, rings)
        )

    def _take_over(self) -> None:
        """Set present targets to those of the keyframes at this moment, as part of the drag that begins."""
        if self._following:
            for name, target in self.session.engine.targets(self.session.edit, self.at).items():
                self.session.drag(name, target.translation, target.rotation)
            self._following = False

    def drag(self, target: Target) -> None:
        """Set the active handle's target.

        Raises:
            UserError: a number is not finite.
        """
        with self.lock:
            if self.active is None:
                return
            self._take_over()
            self.session.drag(self.active, target.translation, target.rotation)
            self._dragged = True
        self.changed()

    def release(self) -> None:
        """End the drag; if the handle was not moved, restore the edit before it."""
        with self.lock:
            self._let_go()
        self.changed()

    def cancel(self) -> None:
        """End the drag and restore the edit before it."""
        with self.lock:
            if self._dragged is not None:
                self._dragged = False
            self._let_go()
        self.changed()

    def _let_go(self) -> None:
        self.dragging = False
        if self._dragged is False:
            self.session.cancel()
            self._following = self._led
            self._check()
        elif self._dragged and self.session.edit.keyframes:
            edit = self.session.edit
            changed = {name: t for name, t in edit.targets.items() if t != self._start.get(name, STAY)}
            self.session.preview(keyed(edit, self.at, changed) if changed else edit)
            self._following = True
        self._dragged = None
        self.session.release()

    @property
    def following(self) -> bool:
        """True if keyframes place the handles."""
        return self._following

    def add_keyframe(self, easing: Any = "smooth") -> None:
        """Add a keyframe at the moment shown; from then on keyframes place the handles."""
        with self.changing() as session:
            draft = session.fork()
            if self._following:
                draft.show_keyframes(self.at)
            draft.add_keyframe(self.at, easing)
            session.apply(draft.edit)
            self._following = True
