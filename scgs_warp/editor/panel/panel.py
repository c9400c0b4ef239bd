"""The panel beside the picture: sections of controls, each of which shows and changes the model."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

from ..escape import plain
from ..jobs import JobProgress, Jobs
from .files import FilesSection
from .film import FilmSection, TimeSection
from .host import Host
from .motion import MotionSection
from .shape import ShapeSection
from .view import ViewSection

HELP = (
    "**Click** the scene to choose a part; click again for its control points (shift: more, ctrl: fewer). Then drag "
    "the **gizmo**: arrows pull, arcs turn."
)


class Panel:
    """All controls beside the picture.

    Attributes: ``jobs`` (films and exports in progress) and the sections ``time``, ``shape``, ``motion``, ``film``,
    ``view``, ``files``.
    """

    def __init__(self, host: Host) -> None:
        self.host = host
        self.jobs = Jobs(self._progress, self._ended)
        self._lock = threading.RLock()
        gui = host.server.gui
        self.status = gui.add_markdown(HELP)
        self.work = gui.add_markdown("", visible=False)
        self.bar = gui.add_progress_bar(0.0, animated=True, visible=False)
        self.stop = gui.add_button("Stop the job", icon=None, color="red", visible=False)
        self.stop.on_click(host.guarded(lambda event: self.jobs.cancel()))
        self.history = gui.add_button_group("Edit", ("Undo", "Redo", "Reset"))
        self.history.on_click(host.guarded(self._history))
        self._commands()
        self.time = TimeSection(host)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Shape"):
            self.shape = ShapeSection(host)
        with tabs.add_tab("Motion"):
            self.motion = MotionSection(host)
        with tabs.add_tab("Film"):
            self.film = FilmSection(host)
        with tabs.add_tab("View"):
            self.view = ViewSection(host)
        with tabs.add_tab("Files"):
            self.files = FilesSection(host, self.jobs)
        self.show()

    def _commands(self) -> None:
        """Add keyboard shortcuts if this version of viser has them."""
        add = getattr(self.host.server.gui, "add_command", None)
        if add is None:
            return
        for label, key, modifier, action in (
            ("Undo", "Z", "cmd/ctrl", self.host.model.undo),
            ("Redo", "Z", "cmd/ctrl+shift", self.host.model.redo),
        ):
            add(label, hotkey=key, modifier=modifier).on_trigger(
                self.host.guarded(lambda event, action=action: action())
            )

    def _history(self, event: Any) -> None:
        model = self.host.model
        what = event.target.value
        if what == "Reset":
            model.reset()
        elif not (model.undo() if what == "Undo" else model.redo()):
            self.host.say(event.client, what, f"there is nothing to {what.lower()}", "gray")

    def show(self) -> None:
        """Set every control to the model's state."""
        with self._lock:
            for section in (self.time, self.shape, self.motion, self.film, self.view, self.files):
                section.show()
            self.status.content = f"{HELP}\n\n{self._said()}"
            self.host.color_overlays()

    def show_time(self) -> None:
        """Set the controls that depend on the moment shown."""
        with self._lock:
            self.time.show()
            self.shape.show_target()

    def _said(self) -> str:
        model = self.host.model
        edit = model.session.edit
        part = self.host.parts.part
        if part is not None:
            way = ", ".join(plain(name) for name in model.session.chain(part)[1:])
            chosen = f"**{plain(part)}**" + (f", pulled together with {way}" if way else "")
        else:
            chosen = f"**{plain(model.active)}**" if model.active else f"{len(model.selection)} control points chosen"
        counts = f"handles: {len(edit.handles)}, pinned: {len(edit.pins)}, keyframes: {len(edit.keyframes)}"
        return f"{chosen}; {counts}"

    # Jobs

    def _progress(self, progress: JobProgress | None) -> None:
        busy = progress is not None
        self.work.visible = self.bar.visible = self.stop.visible = busy
        if progress is not None:
            doing = "stopping" if progress.stopping else f"{progress.done} of {progress.total}"
            self.work.content = f"**{plain(progress.name)}**: {doing}"
            self.bar.value = progress.percent
            self.stop.disabled = progress.stopping

    def _ended(self, client: Any, name: str, result: Path | None, problem: str | None) -> None:
        if problem is not None or result is None:
            self.host.say(client, name, problem or "nothing was written", "orange")
            return
        self.host.say(client, name, f"done: {result}", "green")
        self.files.offer(client, result)
        self.show()
