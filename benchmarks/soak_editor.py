"""Random user of the editor, without a browser, for ``soak.py``."""

from __future__ import annotations

import dataclasses
import math
import random
import shutil
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scgs_warp.edit import EditSession, Target, edit_file, render_film
from scgs_warp.edit.handles import STAY
from scgs_warp.editor.jobs import Jobs
from scgs_warp.editor.model import EditorModel, Moment, Region
from scgs_warp.editor.parts_tool import Hit, PartsTool, hit
from scgs_warp.editor.pictures import scene_jpeg
from scgs_warp.editor.pose_schedule import PoseSchedule, Wanted
from scgs_warp.editor.poses import picture_message, pose_message, pose_table
from scgs_warp.editor.worker import Worker
from scgs_warp.errors import UserError
from scgs_warp.geometry.cameras import orbit_camera
from scgs_warp.types import Camera

SIZE = 96
"""Longer side of a picture in pixels."""
CLIENTS = 2
AHEAD = 24
"""Largest number of frames that a page asks for at once."""


class RandomUser:
    """Model, worker and jobs, assembled as in the editor, and random input for them.

    Args:
        session: Scene to edit.
        folder: Folder for edits, films and exports; emptied now and then.
    """

    def __init__(self, session: EditSession, folder: Path, seed: int) -> None:
        self.random, self.folder = random.Random(seed), folder
        folder.mkdir(parents=True, exist_ok=True)
        self.done: Counter[str] = Counter()
        self.refused = 0
        self.schedule = PoseSchedule()
        self.worker = Worker(self.schedule, self._send_pose, self._pose_failed)
        self.model = EditorModel(session, self._changed)
        self.parts = PartsTool(self.model)
        self.sent = 0
        """Bytes of poses and pictures so far."""
        self.jobs = Jobs(lambda progress: None, lambda *ended: None)
        film = dataclasses.replace(session.edit.film, seconds=0.5, fps=10.0, size=SIZE)
        self.model.replace(film=film)
        self.worker.start()
        self.actions: list[tuple[int, Callable[[], Any]]] = [
            (12, self.click), (12, self.drag), (4, self.undo), (3, self.redo), (4, self.keyframe), (4, self.seek),
            (3, self.play), (2, self.put), (2, self.handle), (2, self.settings), (2, self.film), (2, self.save),
            (2, self.load), (1, self.export_film), (1, self.export_ply), (3, self.picture), (1, self.nonsense),
            (1, self.reset), (1, self.arrive_and_leave),
        ]  # fmt: skip

    def act(self) -> None:
        """Perform one random action."""
        action = self.random.choices([one for _, one in self.actions], [often for often, _ in self.actions])[0]
        try:
            action()
        except UserError:
            self.refused += 1
        self.done[action.__name__] += 1
        self.worker.call(lambda: None)
        if self.random.random() < 0.1:
            self._wait(lambda: self.worker.idle)

    def rest(self) -> None:
        """Wait until nothing runs."""
        self.jobs.wait(60.0)
        self._wait(lambda: self.worker.idle)

    def stop(self) -> None:
        self.jobs.stop()
        self.worker.stop()

    def _wait(self, over: Callable[[], bool], seconds: float = 5.0) -> None:
        end = time.monotonic() + seconds
        while not over() and time.monotonic() < end:
            time.sleep(0.01)

    # The page's part.

    def _changed(self) -> None:
        if self.model.dragging:
            with self.worker.changing() as schedule:
                schedule.ask_live()

    def _send_pose(self, client: int, wanted: Wanted | None) -> None:
        model, session = self.model, self.model.session
        moment, version, frame = model.moment(), 0, -1
        if wanted is not None:
            version, frame = wanted
            at = frame / session.edit.film.fps
            moment = Moment(session.scene_time(at), at if model.following else None, False)
        self.sent += len(pose_message(pose_table(session, moment), version, frame))

    def _pose_failed(self, client: int, error: Exception) -> None:
        raise error

    def _ask_frames(self, client: int) -> None:
        frames = self.model.session.edit.film.frames
        first = self.random.randrange(frames)
        wanted = [(first + k) % frames for k in range(self.random.randint(1, AHEAD))]
        with self.worker.changing() as schedule:
            schedule.ask_frames(client, self.random.randint(1, 2), wanted)

    def _camera(self) -> Camera:
        return orbit_camera(self.model.session.scene.overview, self.random.uniform(0, 360), SIZE)

    # Actions of the user.

    def _target(self) -> Target:
        reach = 0.3 * self.model.session.scene.overview.radius
        turn = [1.0, *(self.random.gauss(0.0, 0.3) for _ in range(3))]
        return Target.of([self.random.gauss(0.0, 0.2 * reach) for _ in range(3)], turn)

    def click(self) -> None:
        model, camera, moment = self.model, self._camera(), self.model.moment()
        x, y = (self.random.uniform(0.2, 0.8) * size for size in (camera.width, camera.height))

        def find() -> Hit | None:
            point = model.session.pick(camera, x, y, moment.time, moment.at)
            return None if point is None else hit(model.session, point, model.region, moment)

        self.parts.click(self.worker.call(find), self.random.choice(("replace", "add", "subtract")))

    def drag(self) -> None:
        part = self.parts.part is not None
        if part:
            self.parts.grab()
        else:
            self.model.grab(STAY)
        grip = self.model.session.node_positions(0.0)[self.model.selection[0]] if part else None
        for _ in range(self.random.randint(0, 8)):
            target = self._target()
            if grip is None:
                self.model.drag(target)
            elif self.random.random() < 0.5:
                self.parts.pull(grip + target.translation, grip)
            else:
                self.parts.turn(target.rotation)
            self.worker.call(lambda: None)
        if self.random.random() < 0.1:
            self.model.cancel()
        else:
            self.model.release()

    def put(self) -> None:
        """Set a target in the panel."""
        if self.parts.part is not None:
            self.parts.put(self._target())
        else:
            self.model.grab(STAY)
            self.model.drag(self._target())
            self.model.release()

    def undo(self) -> None:
        for _ in range(self.random.randint(1, 5)):
            self.model.undo()

    def redo(self) -> None:
        self.model.redo()

    def keyframe(self) -> None:
        self.model.add_keyframe(self.random.choice(("smooth", "linear", "ease", "step")))

    def seek(self) -> None:
        self.model.look(self.random.uniform(0.0, self.model.seconds))

    def play(self) -> None:
        self._ask_frames(self.random.randrange(CLIENTS))

    def arrive_and_leave(self) -> None:
        self._ask_frames(CLIENTS)
        self.worker.call(lambda: None)
        with self.worker.changing() as schedule:
            schedule.drop(CLIENTS)

    def handle(self) -> None:
        if self.random.random() < 0.5:
            self.model.remove_handle()
        else:
            self.model.change_handle(lasts=self.random.choice(("motion", "frame", "fade")))

    def settings(self) -> None:
        kind = self.random.choice(("rings", "brush"))
        self.model.set(
            region=Region(kind, self.random.randint(0, 3), self.random.uniform(0.05, 0.5)),
            pin_rings=self.random.choice((None, 1, 3)),
        )
        self.parts.set(self.random.random() < 0.5)

    def film(self) -> None:
        edit = self.model.session.edit
        playback = dataclasses.replace(edit.playback, repeat=self.random.choice(("once", "loop", "swing")))
        seconds = self.random.choice((0.3, 0.5, 0.8))
        self.model.replace(film=dataclasses.replace(edit.film, seconds=seconds), playback=playback)

    def reset(self) -> None:
        self.model.reset()
        if self.random.random() < 0.2:
            self.jobs.wait(30.0)
            shutil.rmtree(self.folder)
            self.folder.mkdir()

    def nonsense(self) -> None:
        """Send values that only a broken page would send."""
        self.model.look(math.nan)
        self.model.drag(Target((math.nan, 0.0, 0.0)))

    def _path(self, suffix: str) -> Path:
        return self.folder / f"file {self.random.randrange(10)}{suffix}"

    def save(self) -> None:
        with self.model.lock:
            self.model.session.save(self._path(".json"))

    def load(self) -> None:
        path = self._path(".json")
        edit = self.worker.call(lambda: edit_file.read(path, self.model.session.engine))
        with self.model.changing() as session:
            session.apply(edit)

    def export_film(self) -> None:
        path = self._path(self.random.choice((".mp4", ".gif")))
        with self.model.lock:
            session = self.model.session.fork()

        def work(advance: Callable[[], None]) -> Path:
            render_film(session, path, advance, lambda draw: self.worker.call(draw, patient=True))
            return path

        self.jobs.start(path.name, session.edit.film.frames, work)
        if self.random.random() < 0.2:
            self.jobs.cancel()

    def export_ply(self) -> None:
        path, moment = self._path(".ply"), self.model.moment()
        with self.model.lock:
            session = self.model.session.fork()
        self.worker.call(lambda: session.export_ply(path, moment.time, moment.at), patient=True)

    def picture(self) -> None:
        """Look from elsewhere with a page that cannot draw the scene."""
        camera, moment = self._camera(), self.model.moment()
        jpeg = self.worker.call(lambda: scene_jpeg(self.model.session, moment, camera))
        self.sent += len(picture_message(jpeg, 1))
