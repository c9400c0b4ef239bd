"""Controls for time: moment shown, playback, keyframes and the film's settings."""

from __future__ import annotations

import dataclasses
from collections import Counter
from typing import Any

from ...edit.keyframes import Easing
from ...errors import UserError
from ..film_camera import view_of
from .host import Host

NONE = "none"
EASINGS: tuple[Easing, ...] = ("smooth", "linear", "ease", "step")
MIN_SECONDS, MAX_SECONDS = 0.04, 600.0
"""Range of film lengths in seconds that the panel offers; scripts may set others."""
MIN_FPS, MAX_FPS = 1.0, 120.0
"""Range of frames per second that the panel offers; scripts may set others."""
REPEATS = ("once", "loop", "swing", "stand still")


class TimeSection:
    """Time slider and play button."""

    def __init__(self, host: Host) -> None:
        gui, self.model = host.server.gui, host.model
        film = self.model.session.edit.film
        self.at = host.on_value(
            gui.add_slider(
                "Second", 0.0, film.seconds, min(1.0 / film.fps, film.seconds), 0.0, hint="Time in the film"
            ),
            self.model.seek,
        )
        self.play = gui.add_button("Play")
        self.play.on_click(host.guarded(lambda event: self.model.play(not self.model.playing)))

    def show(self) -> None:
        model = self.model
        film = model.session.edit.film
        self.at.max = film.seconds
        self.at.step = min(1.0 / film.fps, film.seconds)
        self.at.value = min(model.at, film.seconds)
        self.play.label = "Pause" if model.playing else "Play"


class FilmSection:
    """Keyframes, playback and the film's settings."""

    def __init__(self, host: Host) -> None:
        self.host, self.model = host, host.model
        gui, on = host.server.gui, host.on_value
        with gui.add_folder("Keyframes"):
            self.list = gui.add_markdown("")
            self.easing = gui.add_dropdown("Way to the next", EASINGS)
            self.add = gui.add_button("Add keyframe here")
            self.add.on_click(host.guarded(lambda event: self.model.add_keyframe(self.easing.value)))
            self.chosen = on(gui.add_dropdown("Keyframe", (NONE,)), self.seek_keyframe)
            self.remove = gui.add_button("Remove this keyframe")
            self.remove.on_click(host.guarded(lambda event: self._remove()))
        self._add_film()

    def _add_film(self) -> None:
        gui, on, film = self.host.server.gui, self.host.on_value, self.model.session.edit.film
        with gui.add_folder("Film"):
            self.seconds = on(
                gui.add_number(
                    "Seconds",
                    film.seconds,
                    min=min(MIN_SECONDS, film.seconds),
                    max=max(MAX_SECONDS, film.seconds),
                    step=0.01,
                ),
                lambda value: self._film(seconds=float(value)),
            )
            self.fps = on(
                gui.add_number(
                    "Frames a second", film.fps, min=min(MIN_FPS, film.fps), max=max(MAX_FPS, film.fps), step=1.0
                ),
                lambda value: self._film(fps=float(value)),
            )
            self.size = on(
                gui.add_number("Longer side", film.size, min=16, max=8192, step=1),
                lambda value: self._film(size=int(value)),
            )
            self.repeat = on(gui.add_dropdown("The motion plays", REPEATS), self._repeat)
            self.speed = on(gui.add_number("Speed", 1.0, min=-100.0, max=100.0, step=0.1), self._speed)
            self.camera = gui.add_button_group("Camera", ("Round", "From here"))
            self.camera.on_click(self.host.guarded(self._shot))

    def _film(self, **fields: Any) -> None:
        self.model.replace(film=dataclasses.replace(self.model.session.edit.film, **fields))

    def _repeat(self, how: str) -> None:
        still = how == "stand still"
        playback = self.model.session.edit.playback
        freeze = self.model.time if still else None
        repeat = playback.repeat if still else how
        self.model.replace(playback=dataclasses.replace(playback, repeat=repeat, freeze=freeze))

    def _speed(self, speed: float) -> None:
        self.model.replace(playback=dataclasses.replace(self.model.session.edit.playback, speed=float(speed)))

    def _shot(self, event: Any) -> None:
        shot = self.model.session.edit.film.shot
        if event.target.value == "Round":
            self._film(shot=dataclasses.replace(shot, kind="turntable"))
        else:
            view = view_of(self.model.session, self.host.camera(event.client))
            self._film(shot=dataclasses.replace(shot, kind="fixed", views=(view,), up=None))

    def seek_keyframe(self, name: str) -> None:
        if name != NONE:
            self.model.seek(self.keyframe_labels()[name])

    def keyframe_labels(self) -> dict[str, float]:
        times = [frame.at for frame in self.model.session.edit.keyframes]
        short = [f"{at:.3f} s" for at in times]
        often = Counter(short)
        return {label if often[label] == 1 else f"{at!r} s": at for label, at in zip(short, times)}

    def _remove(self) -> None:
        at = self.keyframe_labels().get(self.chosen.value)
        if at is None:
            raise UserError("no keyframe is chosen; choose one from the list first")
        with self.model.changing() as session:
            session.remove_keyframe(at)

    def show(self) -> None:
        edit = self.model.session.edit
        film, playback = edit.film, edit.playback
        rows = [f"| {frame.at:.2f} | {len(frame.targets)} | {frame.easing} |" for frame in edit.keyframes]
        head = "| second | handles | way to the next |\n|---|---|---|\n"
        self.list.content = head + "\n".join(rows) if rows else "*None yet: move a handle, then add one.*"
        names = (NONE, *self.keyframe_labels())
        if self.chosen.options != names:
            self.chosen.options = names
        self.chosen.value = next((n for n, at in self.keyframe_labels().items() if at == self.model.at), NONE)
        self.seconds.min, self.seconds.max = min(MIN_SECONDS, film.seconds), max(MAX_SECONDS, film.seconds)
        self.fps.min, self.fps.max = min(MIN_FPS, film.fps), max(MAX_FPS, film.fps)
        self.seconds.value, self.fps.value, self.size.value = film.seconds, film.fps, film.size
        self.repeat.value = playback.repeat if playback.freeze is None else "stand still"
        self.speed.min, self.speed.max = min(-100.0, playback.speed), max(100.0, playback.speed)
        self.speed.value = playback.speed
