"""The editor: serves an ``EditSession`` to browsers and turns clicks and drags into edits."""

from __future__ import annotations

import contextlib
import functools
import io
import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import CancelledError
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..edit import EditSession, Target
from ..edit.handles import STAY
from ..edit.rotations import IDENTITY
from ..errors import UserError
from ..geometry.cameras import orbit_camera
from . import gizmo_pose
from .autosave import Autosave
from .display import RADIUS, Display
from .frame_image import FINE_QUALITY, QUALITY, Picture, take_picture
from .model import Combine, EditorModel, Moment
from .overlays import GIZMO, Overlays
from .panel.panel import Panel
from .parts_tool import Hit, PartFrame, PartsTool, hit
from .proxy import guarded
from .views import FULL, ClientCamera, Pace, PictureSchedule
from .worker import Worker

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"
MOVING_SECONDS, STILL_SECONDS = 0.11, 0.8
"""Target times for drawing a picture, in seconds: while something moves, and while all is still."""
MAX_SCREENSHOT_SIZE = 4096
"""Upper limit for the longer side of a screenshot in pixels, whatever window size a page reports."""
REPEAT_SECONDS = 1.5
"""Seconds during which the same message is not repeated."""


def import_viser() -> Any:
    """Import the package that serves the page.

    Raises:
        UserError: the package is not installed.
    """
    try:
        import viser
    except ImportError:
        raise UserError("the editor needs the package viser; install it with: pip install 'scgs_warp[edit]'") from None
    return viser


class Editor:
    """Server of one session for any number of browsers, until ``stop``.

    Args:
        session: scene and edit.
        folder: folder of edits, films and exports.
        port: port on 127.0.0.1; if it is taken, the next free one is used. 0: any.
        size: upper limit for the longer side of a picture in pixels.
        key: secret of the proxy in front of the editor, if there is one.
        autosave: keeper of the session's edit; None: it is saved on request alone.

    Attributes: ``server`` (viser's), ``model``, ``parts`` (what clicks and drags do with parts), ``worker``, ``port``,
    ``gizmo_frame`` (a pair, or None if no gizmo is shown: the gizmo's frame, of a handle or of a part, and the handle's
    target, translation and rotation, when a drag begins), ``latency`` (seconds from a drag to its picture, the latest
    hundred).

    Raises:
        UserError: viser is not installed.
    """

    def __init__(
        self,
        session: EditSession,
        folder: Path,
        port: int = 8080,
        size: int = 1024,
        key: str | None = None,
        autosave: Autosave | None = None,
    ) -> None:
        viser = import_viser()
        self.session, self.folder = session, folder
        self.schedule = PictureSchedule()
        self.quick, self.full = Pace(MOVING_SECONDS, 256, 512), Pace(STILL_SECONDS, min(640, size), size)
        self.worker = Worker(self.schedule, self._draw, lambda: self.model.busy, failed=self.picture_failed)
        self.autosave = autosave
        self._autosave_problem: str | None = None
        self.model = EditorModel(session, self._changed)
        self.parts = PartsTool(self.model)
        self.latency: list[float] = []
        self._notified: dict[str, float] = {}
        self._first = True
        """True if no picture has been drawn yet."""
        self._waiting: dict[int, Any] = {}
        self._dragger: int | None = None
        self._dragged_at: float | None = None
        self.gizmo_frame: tuple[gizmo_pose.GizmoFrame | PartFrame, Target] | None = None
        self.display = Display.of(session.scene.overview)
        with guarded(key), contextlib.redirect_stdout(io.StringIO()):  # viser's banner names its own port
            self.server: viser.ViserServer = viser.ViserServer(HOST, port, label="scgs_warp", verbose=False)
        self.port: int = self.server.get_port()
        self._set_up_page()
        self.panel = Panel(self)
        self.worker.start()
        self.server.on_client_connect(self._connect)
        self.server.on_client_disconnect(self._disconnect)
        self.refresh()

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.port}"

    def stop(self) -> None:
        self.panel.jobs.stop()
        self.worker.stop()
        if self.autosave is not None:
            self.autosave.stop()
        self.server.stop()

    def _set_up_page(self) -> None:
        """Set up direction, initial camera, overlays and click callbacks."""
        server, overview = self.server, self.session.scene.overview
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="large")
        server.gui.main_panel.dock_right()  # beside the picture, not over it
        server.scene.world_axes.visible = False
        server.scene.set_up_direction(overview.up)
        start = orbit_camera(overview, overview.azimuth, 256)
        camera = server.initial_camera
        camera.position = tuple(self.display.show(start.position.numpy()).tolist())  # type: ignore[assignment]
        camera.look_at, camera.up = (0.0, 0.0, 0.0), overview.up
        camera.fov = 2 * float(np.arctan(start.height / (2 * float(start.K[1, 1]))))
        camera.near, camera.far = 0.01 * RADIUS, 100.0 * RADIUS
        self.edge_length = self.session.graph.edge_length / self.session.engine.units[1]
        self.node_size = 0.16 * self.edge_length * self.display.scale
        points = self.display.show(self.session.node_positions(0.0))
        self.overlays = Overlays(server, self.session.graph.edges, points, self.node_size, GIZMO * RADIUS)
        self.overlays.gizmo.on_update(self._gizmo_moved)
        scene = server.scene
        for modifier, how in ((None, None), ("shift", "add"), ("cmd/ctrl", "subtract")):
            scene.on_click(modifier=modifier)(functools.partial(self._clicked, how=how))  # type: ignore[arg-type]

    # Clients

    def _connect(self, client: viser.ClientHandle) -> None:
        if self.autosave is not None and self.autosave.said:
            client.add_notification("Your edit", self.autosave.said, auto_close_seconds=10.0)
        if self._first:
            text = "Kernels are compiled on first use, which may take a minute."
            self._waiting[client.client_id] = client.add_notification("Drawing the scene", text, loading=True)
        client.camera.on_update(lambda camera: self._moved(client))
        self._moved(client)

    def _disconnect(self, client: viser.ClientHandle) -> None:
        if client.client_id == self._dragger:  # the window was closed during a drag
            self._dragger = None
            self.model.release()
        self._waiting.pop(client.client_id, None)
        with self.worker.changing() as schedule:
            schedule.drop(client.client_id)

    def _moved(self, client: viser.ClientHandle) -> None:
        if client.client_id not in self.server.get_clients():
            return
        with self.worker.changing() as schedule:
            schedule.move(client.client_id, self.camera(client), time.monotonic())

    def _changed(self) -> None:
        """Keep the edit, unless it is in the middle of a drag, and show it."""
        self.refresh()
        if self.autosave is None or self.model.dragging:
            return
        self.autosave.note(self.session.edit)
        problem, before = self.autosave.problem, self._autosave_problem
        self._autosave_problem = problem
        if problem is not None and problem != before:
            self.say(None, "The edit is not saved", problem)

    def refresh(self) -> None:
        """Request new pictures for all clients."""
        with self.worker.changing() as schedule:
            schedule.change(time.monotonic())

    def say(self, client: viser.ClientHandle | None, title: str, text: str, color: str = "red") -> None:
        """Notify one client or all (None). The same text is shown again only after ``REPEAT_SECONDS``, because every
        step of a drag repeats its error."""
        now = time.monotonic()
        if now - self._notified.get(text, -np.inf) < REPEAT_SECONDS:
            return
        self._notified = {said: at for said, at in self._notified.items() if now - at < REPEAT_SECONDS} | {text: now}
        everybody = self.server.get_clients().values()
        for one in [client] if client is not None else list(everybody):
            one.add_notification(title, text, auto_close_seconds=8.0, color=color)  # type: ignore[arg-type]

    def guarded(self, action: Callable[..., Any]) -> Callable[[Any], None]:
        """Wrap a callback such that errors become notifications. Events without a client, which the program causes by
        setting values in the panel, are ignored."""

        def callback(event: Any) -> None:
            if event.client is None:
                return
            try:
                action(event)
            except UserError as error:
                self.say(event.client, "That does not work", str(error))
            except CancelledError:
                pass
            except Exception as error:
                self._failed(event.client, error)
            self.panel.show()

        return callback

    def _failed(self, client: viser.ClientHandle | None, error: Exception) -> None:
        """Report an internal error; call it inside the ``except`` block."""
        traceback.print_exc(file=sys.stderr)
        self.say(client, "Internal error", f"{type(error).__name__}: {error}")

    def picture_failed(self, number: int, error: Exception) -> None:
        """Report that a client's picture could not be drawn; called on the worker's thread, inside the ``except``
        block."""
        client = self.server.get_clients().get(number)
        if client is None:
            return
        if isinstance(error, UserError):
            self.say(client, "The picture cannot be drawn", str(error))
        else:
            self._failed(client, error)

    def on_value(self, handle: Any, action: Callable[[Any], Any]) -> Any:
        """Call ``action`` with a control's value whenever a user changes it; return the control."""
        handle.on_update(self.guarded(lambda event: action(event.target.value)))
        return handle

    def color_overlays(self) -> None:
        model, edit = self.model, self.session.edit
        held = {node for handle in edit.handles for node in handle.nodes}
        part = self.parts.shown()
        if part is None:
            self.overlays.color(model.selection, held, edit.pins)
        else:
            self.overlays.color(*part)

    # Pictures

    def camera(self, client: viser.ClientHandle) -> ClientCamera:
        """Return a client's present camera, world units."""
        camera = client.camera
        try:
            width, height = int(camera.image_width), int(camera.image_height)
        except (TypeError, ValueError, OverflowError):
            width = height = 0
        position = self.display.world(np.asarray(camera.position, np.float64))
        wxyz = np.asarray(camera.wxyz, np.float64)
        return ClientCamera(tuple(wxyz.tolist()), tuple(position.tolist()), float(camera.fov), width, height)

    def take_picture(self, moment: Moment, camera: ClientCamera) -> Picture:
        """Render a picture at the client's full size; call it on the worker's thread."""
        return take_picture(self.session, moment, camera, min(max(camera.width, camera.height), MAX_SCREENSHOT_SIZE))

    def _draw(self, number: int, quality: str) -> None:
        """Draw a client's picture; runs on the worker's thread."""
        client = self.server.get_clients().get(number)
        with self.worker.changing() as schedule:
            camera = schedule.camera(number)
        if client is None or camera is None:
            return
        asked = self._dragged_at
        moment = self.model.moment()
        pace = self.full if quality == FULL else self.quick
        begin = time.perf_counter()
        picture = take_picture(self.session, moment, camera, min(pace.size, max(camera.width, camera.height)))
        depth = self.display.empty_depth
        if not self.model.through:
            behind = 0.5 * self.edge_length * self.display.scale  # control points lie inside the surface
            depth = self.display.depth(picture.depth, behind, 2 if quality == FULL else 1)
        client.scene.set_background_image(
            picture.rgb, format="jpeg", jpeg_quality=FINE_QUALITY if quality == FULL else QUALITY, depth=depth
        )
        client.flush()
        self._first = False
        waiting = self._waiting.pop(number, None)
        if waiting is not None:
            waiting.remove()
        took = time.perf_counter() - begin
        pace.took(took)
        if asked is not None and asked == self._dragged_at:
            self._dragged_at = None
        if asked is not None and moment.live:
            self.latency = [*self.latency[-99:], time.monotonic() - asked]
        self._update_page(moment)

    def _update_page(self, moment: Moment) -> None:
        """Update overlays, gizmo and panel after the picture."""
        points = self.session.node_positions(moment.time, moment.at, live=moment.live)
        self.overlays.move(self.display.show(points))
        self._place_gizmo(moment, points)
        self.panel.show_time()
        again = self.model.playing or (moment.live and not self.session.engine.settled(self.session.edit))
        if again:
            self.refresh()

    def _place_gizmo(self, moment: Moment, points: np.ndarray) -> None:
        """Place the gizmo at the control points' positions [M, 3]."""
        model = self.model
        if model.dragging:
            return
        part = self.parts.frame(points)
        if part is not None and moment.show not in ("original", "side by side"):
            self.gizmo_frame = part, STAY
            self.overlays.place_gizmo((self.display.show(part.point), IDENTITY))
            return
        handle = self.session.edit.handle(model.active or "")
        if moment.show in ("original", "side by side") or (handle is None and not model.selection):
            self.gizmo_frame = None
            self.overlays.place_gizmo(None)
            return
        if handle is None:
            frame, target = gizmo_pose.frame_of_selection(self.session, model.selection, moment)
        else:
            target = self.session.engine.targets(self.session.edit, moment.at).get(handle.name, STAY)
            frame = gizmo_pose.frame_of_handle(self.session, handle, moment)
        self.gizmo_frame = frame, target
        position, wxyz = frame.pose(target)
        self.overlays.place_gizmo((self.display.show(position), wxyz))

    # What users do in the picture

    def _clicked(self, event: Any, how: Combine | None) -> None:
        self.guarded(lambda event: self.pick(event.client, event.screen_pos, how))(event)

    def pick(self, client: viser.ClientHandle, screen: tuple[float, float], how: Combine | None = None) -> None:
        """Select by a click at a point of the canvas (0 to 1 from the upper left): a part, at the second click its
        control points. The background clears the selection unless it is to be extended or reduced."""
        model, moment = self.model, self.model.moment()

        def find() -> Hit | None:
            point = gizmo_pose.surface_point(self.session, self.camera(client), screen, moment)
            return None if point is None else hit(self.session, point, model.region, moment)

        self.parts.click(self.worker.call(find), how or model.combine)

    async def _gizmo_moved(self, event: Any) -> None:
        """Handle gizmo events in order on the server's loop, without waiting for solutions. One client drags at a
        time."""
        if self._dragger not in (None, event.client_id):
            return
        self._dragger = None if event.phase == "end" else event.client_id
        try:
            self.drag_gizmo(event.phase, self.display.world(event.target.position), np.array(event.target.wxyz))
        except UserError as error:
            self.say(event.client, "That does not work", str(error))
        except Exception as error:
            self._failed(event.client, error)

    def drag_gizmo(self, phase: str, position: np.ndarray, wxyz: np.ndarray) -> None:
        if self.gizmo_frame is None:
            return
        frame, target = self.gizmo_frame
        if phase == "start":
            if isinstance(frame, PartFrame):
                self.parts.grab()
            else:
                self.model.grab(target)
        elif phase == "update":
            if self.model.dragging:
                self._dragged_at = self._dragged_at or time.monotonic()
                if isinstance(frame, PartFrame):
                    self.parts.drag(frame, position, wxyz)
                else:
                    self.model.drag(frame.target(position, wxyz))
        else:
            self._dragged_at = None
            self.model.release()
            self.panel.show()

    def put(self, target: Target) -> None:
        """Move the chosen handle, or the joint of the chosen part, to a target in one step, for the panel's number
        fields."""
        if self.parts.part is not None:
            self.parts.put(target)
            return
        self.model.grab(STAY if self.gizmo_frame is None else self.gizmo_frame[1])
        try:
            self.model.drag(target)
        finally:
            self.model.release()
