"""Posing parts by clicks and drags: which part a click takes, and what a drag does with it. Independent of the browser.

A click takes the part under it, a second click on the same part its control points. A drag that moves a part pulls it
(inverse kinematics), a drag that turns it turns its joint (forward kinematics).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..edit import EditSession, Target
from ..errors import UserError
from .gizmo_pose import region_at
from .model import Combine, EditorModel, Moment, Region


class Hit(NamedTuple):
    """What a click at a surface point means."""

    part: str | None
    """None: the scene has a single part, which nobody wants to pose."""
    nodes: tuple[int, ...]
    """Control points that a click on the surface selects."""


def hit(session: EditSession, point: np.ndarray, region: Region, moment: Moment) -> Hit:
    """Say what a click at a surface point [3], world units, means.

    This may solve, and find the skeleton: call it on the worker's thread.
    """
    single = len(session.parts()) < 2
    part = None if single else session.part_at(point.tolist(), moment.time, moment.at)
    return Hit(part, region_at(session, point, region, moment))


class PartsTool:
    """Choice and posing of one part.

    Args:
        model: shared state; its lock guards this object, too.

    Attributes: ``on``, whether clicks take parts at all.
    """

    def __init__(self, model: EditorModel) -> None:
        self.model = model
        self.on = True
        self._chosen: tuple[int, ...] | None = None
        """Control points of the chosen part: its name may change."""
        self._inside: str | None = None
        """Part whose control points a second click has selected; further clicks on it select control points."""
        self._since = model.session.edit
        """Edit from which the present drag is measured."""

    @property
    def part(self) -> str | None:
        """The chosen part; None: none is chosen. Selecting anything else, and changes of the skeleton, unchoose it."""
        chosen = self._chosen
        if chosen is None or chosen != self.model.selection:
            return None
        return next((part.name for part in self.model.session.skeleton.parts if part.nodes == chosen), None)

    def click(self, hit: Hit | None, how: Combine = "replace", parts_first: bool | None = None) -> None:
        """Choose what a click means.

        Args:
            hit: None: the click was beside the scene, which clears the selection unless it is to be changed.
            parts_first: whether this click takes parts, for pages that each have a tool; None: as ``on`` says.
        """
        model, takes_parts = self.model, self.on if parts_first is None else parts_first
        with model.lock:
            part, inside = self.part, self._inside
            if hit is None:
                self._inside = None
                if how == "replace":
                    model.select(())
            elif takes_parts and how == "replace" and hit.part is not None and hit.part not in (part, inside):
                self.choose(hit.part)
            else:
                self._inside = hit.part if takes_parts else None
                self._take_points(hit, how)

    def _take_points(self, hit: Hit, how: Combine) -> None:
        handles = self.model.session.edit.handles
        held = [h.name for h in handles if h.part is None and how == "replace" and set(hit.nodes) <= set(h.nodes)]
        if held:
            self.model.activate(held[-1])
        else:
            self.model.select(hit.nodes, how)

    def choose(self, part: str) -> None:
        """Choose a part.

        Raises:
            UserError: there is no such part.
        """
        with self.model.lock:
            nodes = self.model.session.skeleton.part(part).nodes
            self._chosen = nodes
            self._inside = None
            self.model.select(nodes)

    def set(self, on: bool) -> None:
        """Set whether clicks take parts."""
        with self.model.lock:
            self.on, self._inside = on, None
        self.model.changed()

    # Dragging

    def grab(self) -> None:
        """Begin to drag the chosen part.

        Raises:
            UserError: no part is chosen.
        """
        model = self.model
        with model.lock:
            if self.part is None:
                raise UserError("no part is chosen; click on the picture first")
            self._since = model.begin_drag()
        model.changed()

    def pull(self, to: Sequence[float] | np.ndarray, grip: Sequence[float] | np.ndarray) -> None:
        """Pull the chosen part, as part of a drag: take the point ``grip`` [3], as it was before, to ``to`` [3].

        Raises:
            UserError: a number is not finite.
        """
        with self.model.lock:
            if self.part is not None and self.model.dragging:
                at = np.asarray(to).tolist(), self.model.time, np.asarray(grip).tolist()
                self.model.session.pull(self.part, *at, live=True, since=self._since)
                self._moved()
        self.model.changed()

    def turn(self, rotation: Sequence[float] | np.ndarray, about: Sequence[float] | None = None) -> None:
        """Turn the chosen part about its joint, as part of a drag, by a rotation [4] wxyz since its beginning.

        Args:
            about: [3] world point about which it turns instead.

        Raises:
            UserError: a number is not finite.
        """
        with self.model.lock:
            if self.part is not None and self.model.dragging:
                quat = np.asarray(rotation, np.float64).tolist()
                self.model.session.rotate(self.part, quat, self.model.time, about=about, live=True, since=self._since)
                self._moved()
        self.model.changed()

    def put(self, target: Target) -> None:
        """Set the target of the chosen part's joint in one step."""
        self.grab()
        with self.model.lock:
            draft = self.model.session.fork()
            handle = draft.pose_part(self.part or "", self.model.time)
            draft.move(handle.name, target.translation, target.rotation)
            self.model.session.preview(draft.edit)
            self._moved()
        self.release()

    def _moved(self) -> None:
        """Let handles that the drag has made act as the page says, and choose the one that poses the part."""
        model, edit = self.model, self.model.session.edit
        known = {handle.name for handle in self._since.handles} if self._since is not None else set()
        fields = {"lasts": model.lasts, "window": model.window, "stiffness": model.stiffness}
        made = (h if h.name in known else dataclasses.replace(h, **fields) for h in edit.handles)
        model.session.preview(dataclasses.replace(edit, handles=tuple(made)))
        model.dragged()
        model.active = next((h.name for h in reversed(edit.handles) if h.part == self.part and model.acts(h)), None)

    def release(self) -> None:
        """End the drag, which is one step for undo."""
        self.model.release()
