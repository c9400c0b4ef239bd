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
from scgs_warp.edit.rotations import from_matrix
from scgs_warp.editor import gizmo_pose
from scgs_warp.editor.frame_image import take_picture
from scgs_warp.editor.jobs import Jobs
from scgs_warp.editor.model import EditorModel, Region
from scgs_warp.editor.views import FULL, ClientCamera, PictureSchedule
from scgs_warp.editor.worker import Worker
from scgs_warp.errors import UserError
from scgs_warp.geometry.cameras import orbit_camera
from scgs_warp.visualization.video import write_png

SIZE = 96
"""Longer side of a picture in pixels."""
CLIENTS = 2


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
        self.schedule = PictureSchedule()
        self.worker = Worker(self.schedule, self._draw, lambda: self.model.busy)
        self.model = EditorModel(session, self._changed)
        self.jobs = Jobs(lambda progress: None, lambda *ended: None)
        film = dataclasses.replace(session.edit.film, seconds=0.5, fps=10.0, size=SIZE)
        self.model.replace(film=film)
        self.worker.start()
        for client in range(CLIENTS):
            self._look_from(client)
        self.actions: list[tuple[int, Callable[[], Any]]] = [
            (12, self.click), (12, self.drag), (4, self.undo), (3, self.redo), (4, self.keyframe), (4, self.seek),
            (2, self.play), (3, self.look_around), (2, self.handle), (2, self.settings), (2, self.film), (2, self.save),
            (2, self.load), (1, self.export_film), (1, self.export_ply), (1, self.screenshot), (1, self.nonsense),
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
            self._wait(lambda: self.worker.idle or self.model.playing)

    def rest(self) -> None:
        """Wait until nothing runs."""
        self.model.play(False)
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
        with self.worker.changing() as schedule:
            schedule.change(time.monotonic())

    def _draw(self, client: int, quality: str) -> None:
        with self.worker.changing() as schedule:
            camera = schedule.camera(client)
        if camera is not None:
            moment = self.model.moment()
            take_picture(self.model.session, moment, camera, SIZE if quality == FULL else SIZE // 2)
            self.model.session.node_positions(moment.time, moment.at, live=moment.live)

    def _camera(self) -> ClientCamera:
        camera = orbit_camera(self.model.session.scene.overview, self.random.uniform(0, 360), SIZE)
        wxyz = from_matrix(camera.viewmat[:3, :3].double().numpy().T)
        fov = 2 * math.atan(camera.height / (2 * float(camera.K[1, 1])))
        return ClientCamera(tuple(wxyz.tolist()), tuple(camera.position.tolist()), fov, camera.width, camera.height)

    def _look_from(self, client: int) -> None:
        camera = self._camera()
        with self.worker.changing() as schedule:
            schedule.move(client, camera, time.monotonic())

    # Actions of the user.

    def _target(self) -> Target:
        reach = 0.3 * self.model.session.scene.overview.radius
        turn = [1.0, *(self.random.gauss(0.0, 0.3) for _ in range(3))]
        return Target.of([self.random.gauss(0.0, 0.2 * reach) for _ in range(3)], turn)

    def click(self) -> None:
        model, camera, moment = self.model, self._camera(), self.model.moment()
        screen = (self.random.uniform(0.2, 0.8), self.random.uniform(0.2, 0.8))

        def find() -> tuple[int, ...]:
            point = gizmo_pose.surface_point(model.session, camera, screen, moment)
            return () if point is None else gizmo_pose.region_at(model.session, point, model.region, moment)

        model.select(self.worker.call(find), self.random.choice(("replace", "add", "subtract")))

    def drag(self) -> None:
        self.model.grab(STAY)
        for _ in range(self.random.randint(0, 8)):
            self.model.drag(self._target())
            self.worker.call(lambda: None)
        self.model.release()

    def undo(self) -> None:
        for _ in range(self.random.randint(1, 5)):
            self.model.undo()

    def redo(self) -> None:
        self.model.redo()

    def keyframe(self) -> None:
        self.model.add_keyframe(self.random.choice(("smooth", "linear", "ease", "step")))

    def seek(self) -> None:
        self.model.seek(self.random.uniform(0.0, self.model.seconds))

    def play(self) -> None:
        self.model.play(not self.model.playing)

    def look_around(self) -> None:
        self._look_from(self.random.randrange(CLIENTS))

    def arrive_and_leave(self) -> None:
        self._look_from(CLIENTS)
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
            show=self.random.choice(("edited", "edited", "original", "side by side", "split")),
        )

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
        self.model.seek(math.nan)
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

    def screenshot(self) -> None:
        camera, moment = self._camera(), self.model.moment()
        picture = self.worker.call(lambda: take_picture(self.model.session, moment, camera, SIZE))
        write_png(self._path(".png"), picture.rgb)
