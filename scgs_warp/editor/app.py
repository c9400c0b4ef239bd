"""The editor: a page that draws the scene itself, and a server that sends it the poses of the control points."""

from __future__ import annotations

import json
import re
import sys
import time
import traceback
from collections import deque
from concurrent.futures import CancelledError
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..edit import EditSession
from ..edit.field_reader import FieldReader
from ..edit.skeleton import Skeleton
from ..errors import UserError, one_line
from ..export.page import MAX_DEGREE
from ..export.page_data import pack
from ..export.page_edit import own_motion
from ..export.page_pose import posable
from ..export.page_scene import page_scene
from ..live.server import Client, PageServer
from ..live.viewer import digest
from ..storage.json_files import as_number
from . import choice, files
from .actions import ACTIONS
from .autosave import Autosave
from .exports import EXPORTS, downloadable
from .gizmo_pose import GizmoFrame
from .jobs import JobProgress, Jobs
from .model import EditorModel, Moment
from .part_changes import PART_CHANGES, parts_message
from .parts_tool import PartsTool
from .pictures import camera_of, scene_jpeg
from .pose_schedule import PoseSchedule, Wanted
from .poses import picture_message, pose_message, pose_table
from .program import held_by_pages, page_of
from .state import film_camera_of, page_state, turn_curve
from .worker import Worker

if TYPE_CHECKING:
    from aiohttp import web

REQUESTS = {**ACTIONS, **PART_CHANGES, **EXPORTS}
LEAVE_A_DRAG_ALONE = {"tool", "save", "stop_job", "export_film", "export_ply", "export_page"}
"""Requests that a page may make while another one drags."""
MAX_WAITING = 200
"""Largest number of requests that may wait; further ones are refused."""


class Editor:
    """Server of one session for any number of pages, until ``stop``.

    Args:
        session: scene and edit.
        folder: folder of edits, films and exports.
        title: name of the scene.
        port, shared, source: as for ``PageServer``.
        autosave: keeper of the session's edit; None: it is saved on request alone.

    Attributes: ``server``, ``model``, ``parts`` (what clicks and drags do with parts), ``worker``, ``jobs``, ``held``
    (frame and pose of the handle that is dragged; None: a part is), ``latency`` (seconds from a drag to its pose, the
    latest hundred).

    Raises:
        UserError: aiohttp is not installed, or the port is not available.
    """

    def __init__(
        self,
        session: EditSession,
        folder: Path,
        *,
        title: str = "scene",
        port: int = 8080,
        shared: bool = False,
        source: Path | None = None,
        autosave: Autosave | None = None,
    ) -> None:
        self.session, self.folder, self.title, self.autosave = session, folder, title, autosave
        self.schedule = PoseSchedule()
        self.model = EditorModel(session, self._changed)
        self.parts = PartsTool(self.model)
        self.worker = Worker(self.schedule, self._send_pose, self._pose_failed)
        self.jobs = Jobs(lambda progress: self._show_job(progress), self._job_ended)
        self.held: tuple[GizmoFrame, tuple[Any, Any]] | None = None
        self.latency: list[float] = []
        self._version, self._posed, self._film = 1, self._pose_key(), session.edit.film
        self._skeleton: Skeleton | None = None
        """Parts that pages know; None: no page has asked yet."""
        self._curve: tuple[tuple[Any, Any], list[list[float]]] = (None, None), []
        """Edit and active handle, and the curve of its turns."""
        self._asked: float | None = None
        """Time of the latest message of a drag whose pose is not sent yet."""
        self._drag: deque[tuple[float, Client, dict[str, Any]]] = deque(maxlen=1)
        """Time, page and latest message of the drag that is not yet applied."""
        self._dragger: int | None = None
        self._pictures: dict[int, dict[str, Any]] = {}
        self._job: JobProgress | None = None
        self._content: bytes | None = None
        self._page = page_of(title)
        routes = {"/": self._serve_page, "/scene": self._serve_scene, "/file/{name}": self._serve_file}
        self.server = PageServer(
            routes,
            port=port,
            shared=shared,
            page=digest(self._page, json.dumps(held_by_pages(session)).encode()),
            source=source,
            received=self._receive,
            connected=self._greet,
            left=self._dismiss,
        )
        if autosave is not None:
            kept, autosave.done = autosave.choice or "{}", self.tell
            self.worker.post(lambda: choice.restore(kept, self.model, self.parts))
        self.worker.start()

    @property
    def url(self) -> str:
        return self.server.url

    def stop(self) -> None:
        self.jobs.stop()
        self.worker.stop()
        self.server.stop()
        if self.autosave is not None:
            self.autosave.stop()

    # Pages

    def _greet(self, client: Client) -> None:
        self.worker.post(lambda: self._welcome(client))

    def _welcome(self, client: Client) -> None:
        scene, edges = self.session.scene, self.session.graph.edges.reshape(-1).tolist()
        hello = {
            "title": self.title,
            "said": "" if self.autosave is None else self.autosave.said,
            "edges": edges,
            "folder": str(self.folder),
            "files": list(files.saved_edits(self.folder)),
            "overview": scene.overview.to_dict(),
            "normalisation": {"centre": scene.normalisation.centre.tolist(), "scale": scene.normalisation.scale},
            "background": list(scene.background_color),
        }
        self._skeleton = self.session.skeleton
        client.send({"hello": hello})
        client.send({"parts": parts_message(self.session)}, latest="parts")
        client.send({"camera": film_camera_of(self.session)}, latest="camera")
        client.send({"state": self._state()}, latest="state")

    def _dismiss(self, client: Client) -> None:
        def forget() -> None:
            if client.number == self._dragger:  # the page was closed during a drag
                self._dragger = None
                self.model.release()

        with self.worker.changing() as schedule:
            schedule.drop(client.number)
        self.worker.post(forget)

    def _state(self) -> dict[str, Any]:
        state = page_state(self.model, self.parts, self._version, self.autosave, self._job)
        key = self.session.edit, self.model.active
        if not self.model.dragging and not all(new is old for new, old in zip(key, self._curve[0])):
            self._curve = key, turn_curve(self.session, *key)
        return {**state, "curve": self._curve[1]}

    def _pose_key(self) -> Any:
        return self.session.edit, self.model.following

    def _changed(self) -> None:
        """Keep the edit, and tell all pages; called after every change of the model."""
        key = self._pose_key()
        if key != self._posed:
            self._posed = key
            self._version += 1
        if self.model.dragging:
            with self.worker.changing() as schedule:
                schedule.ask_live()
        elif self.autosave is not None:
            self.autosave.note(self.session.edit, choice.to_json(self.model, self.parts))
        if self.session.edit.film is not self._film:
            self._film = self.session.edit.film
            self.server.broadcast({"camera": film_camera_of(self.session)}, latest="camera")
        self.tell()

    def tell(self) -> None:
        """Send the state to all pages, on the worker's thread: two threads could send an older state after a newer."""
        if self.worker.here:
            if self._skeleton is not None and self.session.skeleton is not self._skeleton:
                self._skeleton = self.session.skeleton
                self.server.broadcast({"parts": parts_message(self.session)}, latest="parts")
            self.server.broadcast({"state": self._state()}, latest="state")
        else:
            self.worker.post(self.tell, once=True)

    def say(self, client: Client | None, text: str, kind: str = "error") -> None:
        """Show a message on one page or, with None, on all of them."""
        message = {"said": {"text": text, "kind": kind}}
        (self.server.broadcast if client is None else client.send)(message)

    def _show_job(self, progress: JobProgress | None) -> None:
        self._job = progress
        self.tell()

    def _job_ended(self, who: Any, name: str, result: Path | None, problem: str | None) -> None:
        if result is None:
            self.say(None, f"{name}: {problem or 'nothing was written'}")
        else:
            self.server.broadcast({"file": result.name, "job": name})

    # What pages ask for

    def _receive(self, client: Client, message: dict[str, Any]) -> None:
        """Take a message, on the server's thread: nothing here computes."""
        what = message.get("do")
        if what == "frames":
            self._want(client, message)
        elif what == "picture":
            self._pictures[client.number] = message
            self.worker.post(self._draw_pictures, once=True)
        elif what == "drag":
            if self._dragger == client.number:
                self._drag.append((time.monotonic(), client, message))
                self.worker.post(self._apply_drag, once=True)
        elif isinstance(what, str) and what in REQUESTS:
            self._queue(client, what, message)

    def _queue(self, client: Client, what: str, message: dict[str, Any]) -> None:
        """Have the worker do what a page asks for, unless too much waits already."""
        if self.worker.backlog < MAX_WAITING:
            self.worker.post(lambda: self._act(client, what, message))
        else:
            client.send({"id": number_of(message), "done": what, "problem": "too many requests at once; try again"})

    def _want(self, client: Client, message: dict[str, Any]) -> None:
        version, frames = message.get("version"), message.get("frames")
        if version != self._version or not isinstance(frames, list):
            return
        wanted = [frame for frame in frames[:64] if isinstance(frame, int) and 0 <= frame <= 100_000]
        with self.worker.changing() as schedule:
            schedule.ask_frames(client.number, self._version, wanted)

    def _act(self, client: Client, what: str, message: dict[str, Any]) -> None:
        """Do what a page asks for, on the worker's thread, and answer it."""
        answer: dict[str, Any] = {"id": number_of(message), "done": what}
        if self._dragger not in (None, client.number) and what not in LEAVE_A_DRAG_ALONE:
            if what not in ("release", "cancel"):
                answer["problem"] = "another page drags at present; try again when it has let go"
            client.send(answer)
            return
        if what in ("grab", "release", "cancel"):
            self._apply_drag()
            self._dragger = client.number if what == "grab" else None
        fields = FieldReader({key: value for key, value in message.items() if key not in ("do", "id")}, "the page")
        try:
            self._seek(message.get("at"))
            result = REQUESTS[what](self, fields)
            if isinstance(result, str):
                answer["name"] = result
            if what == "save":
                answer["files"] = list(files.saved_edits(self.folder))
        except UserError as error:
            answer["problem"] = one_line(error)
        except CancelledError:
            return
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            answer["problem"] = f"internal error: {type(error).__name__}: {error}"
        if what == "grab" and "problem" in answer:
            self._dragger = None
        self.tell()
        client.send(answer)

    def _seek(self, at: Any) -> None:
        """Set the moment that the page shows: requests refer to it."""
        second = as_number(at)
        if second is not None and not self.model.dragging:
            self.model.look(second)

    def _apply_drag(self) -> None:
        if not self._drag:
            return
        asked, client, message = self._drag.pop()
        if not self.model.dragging:
            return
        fields = FieldReader({key: value for key, value in message.items() if key not in ("do", "id")}, "the page")
        try:
            ACTIONS["drag"](self, fields)
            self._asked = asked
        except UserError as error:
            self.say(client, one_line(error))

    # Poses

    def _send_pose(self, number: int, wanted: Wanted | None) -> None:
        """Compute a pose and send it, on the worker's thread."""
        if wanted is None:
            moment = self.model.moment()
            table = pose_table(self.session, moment)
            self.server.broadcast(pose_message(table, self._version, -1), latest="pose")
            if moment.live and not self.session.engine.settled(self.session.edit):
                with self.worker.changing() as schedule:
                    schedule.ask_live()
            asked, self._asked = self._asked, None
            if asked is not None:
                self.latency = [*self.latency[-99:], time.monotonic() - asked]
            return
        client = self.server.clients.get(number)
        if client is None or wanted.version != self._version:
            return
        at = wanted.frame / self.session.edit.film.fps
        moment = Moment(self.session.scene_time(at), at if self.model.following else None, False)
        client.send(pose_message(pose_table(self.session, moment), wanted.version, wanted.frame))

    def _draw_pictures(self) -> None:
        """Draw the newest view of each page that cannot draw itself, on the worker's thread."""
        for number in list(self._pictures):
            message, client = self._pictures.pop(number), self.server.clients.get(number)
            if client is None:
                continue
            try:
                self._seek(message.get("at"))
                jpeg = scene_jpeg(self.session, self.model.moment(), camera_of(FieldReader(message, "the page")))
                client.send(picture_message(jpeg, self._version), latest="picture")
            except UserError as error:
                self.say(client, one_line(error))
                client.send({"undrawn": True})
            except Exception:
                client.send({"undrawn": True})
                raise

    def _pose_failed(self, number: int, error: Exception) -> None:
        if isinstance(error, UserError):
            self.say(self.server.clients.get(number), str(error))
        else:
            traceback.print_exc(file=sys.stderr)
            self.say(None, f"internal error: {type(error).__name__}: {error}")

    # Routes

    async def _serve_page(self, request: web.Request) -> web.StreamResponse:
        from aiohttp import web

        return web.Response(body=self._page, content_type="text/html", charset="utf-8")

    async def _serve_scene(self, request: web.Request) -> web.StreamResponse:
        from aiohttp import web

        if self._content is None:
            import asyncio

            self._content = await asyncio.to_thread(self.worker.call, self._pack)
        return web.Response(body=self._content, content_type="application/octet-stream")

    def _pack(self) -> bytes:
        scene = self.session.scene
        motion = posable(self.session, own_motion(self.session))
        content = page_scene(scene, min(scene.gaussians.sh_degree, MAX_DEGREE), motion_of=motion)
        return pack(content.facts, content.columns)

    async def _serve_file(self, request: web.Request) -> web.StreamResponse:
        from aiohttp import web

        try:
            path = downloadable(self.folder, request.match_info["name"])
        except UserError as error:
            return web.Response(status=404, text=str(error))
        quiet = re.sub(r"[^A-Za-z0-9 ._-]", "_", path.name)
        return web.FileResponse(path, headers={"Content-Disposition": f'attachment; filename="{quiet}"'})


def number_of(message: dict[str, Any]) -> int | None:
    """Return the number by which a page knows the answer to its request."""
    number = message.get("id")
    return number if isinstance(number, int) and abs(number) < 1 << 53 else None
