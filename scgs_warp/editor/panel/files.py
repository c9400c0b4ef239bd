"""Controls for files: save and load edits, export screenshots, films and PLY files, to one folder and the browser."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ...edit import Edit, edit_file
from ...edit.field_reader import MAX_BYTES, parse_object
from ...edit.filming import render_film
from ...errors import UserError
from ...visualization.video import write_png
from .. import files
from ..escape import plain
from ..jobs import Jobs
from .host import Host

NONE: str = "none yet"
MAX_DOWNLOAD = 64 << 20
"""Size in bytes of the largest file offered to the browser, because the page holds all of it in memory."""


class FilesSection:
    """Save, load, export."""

    def __init__(self, host: Host, jobs: Jobs) -> None:
        self.host, self.model, self.jobs = host, host.model, jobs
        gui, click = host.server.gui, self._click
        gui.add_markdown(f"Files go to **{plain(host.folder.name)}** and to the browser.")
        with gui.add_folder("The edit"):
            self.name = gui.add_text("Name", "edit")
            self.replace = gui.add_checkbox(
                "Replace files", False, hint="Otherwise a number is added to names that exist"
            )
            click(gui.add_button("Save edit"), lambda event: self.save(event.client))
            self.saved = gui.add_dropdown("Saved", (NONE,))
            click(gui.add_button("Load edit"), lambda event: self.load(self.saved.value))
            self.upload = gui.add_upload_button("Load from this computer", mime_type="application/json")
            self.upload.on_upload(host.guarded(lambda event: self.load_bytes(event.target.value.content)))
        with gui.add_folder("Results"):
            click(gui.add_button("Screenshot"), lambda event: self.screenshot(event.client))
            self.format = gui.add_dropdown("Film as", (".mp4", ".gif"))
            click(gui.add_button("Export film"), lambda event: self.export_film(event.client))
            click(gui.add_button("Export PLY"), lambda event: self.export_ply(event.client))

    def _click(self, button: Any, action: Callable[[Any], Any]) -> None:
        button.on_click(self.host.guarded(action))

    def _path(self, suffix: str) -> Path:
        path = files.output_path(self.host.folder, self.name.value, suffix)
        return path if self.replace.value else files.unused_path(path)

    def offer(self, client: Any, path: Path) -> None:
        """Send a file to the browser, which shows a link to it."""
        if client is not None and path.is_file() and path.stat().st_size <= MAX_DOWNLOAD:
            client.send_file_download(path.name, path.read_bytes())

    def save(self, client: Any = None) -> Path:
        path = self._path(".json")
        with self.model.lock:
            self.model.session.save(path)
        self.host.say(client, "Saved", path.name, "green")
        self.offer(client, path)
        return path

    def load(self, name: str) -> None:
        """Load a saved edit.

        Raises:
            UserError: no edit is chosen, or a field is wrong; the edit stays unchanged.
        """
        if name == NONE:
            raise UserError("no edit is saved here yet; save one, or load one from this computer")
        path = files.output_path(self.host.folder, name, ".json")
        self._take(lambda: edit_file.read(path, self.model.session.engine))

    def load_bytes(self, content: bytes) -> None:
        """Load an edit that the browser sent.

        Raises:
            UserError: a field is wrong; the edit stays unchanged.
        """
        if len(content) > MAX_BYTES:
            raise UserError(f"the file is larger than {MAX_BYTES >> 20} MiB; give an edit's JSON")
        try:
            text = content.decode("utf-8")
        except UnicodeDecodeError:
            raise UserError("the file is not UTF-8 text; give an edit's JSON") from None
        self._take(lambda: edit_file.parse(parse_object(text, "the file"), "the file", self.model.session.engine))

    def _take(self, read: Callable[[], Edit]) -> None:
        edit = self.host.worker.call(read)  # turning places into control points evaluates the motion
        with self.model.changing() as session:
            session.apply(edit)

    def screenshot(self, client: Any) -> Path:
        """Write the picture as the client sees it, at full size, without overlays."""
        camera, moment = self.host.camera(client), self.model.moment()
        if not camera.usable:
            raise UserError("the browser's window has no size; open it and try again")
        picture = self.host.worker.call(lambda: self.host.take_picture(moment, camera))
        path = self._path(".png")
        try:
            write_png(path, picture.rgb)
        except OSError as error:
            raise UserError(f"{path}: cannot be written ({error.strerror}); free space") from None
        self.offer(client, path)
        return path

    def _start(self, client: Any, name: str, total: int, action: Callable[[Callable[[], None]], Path]) -> None:
        self.jobs.start(name, total, action, client)

    def export_film(self, client: Any = None) -> Path:
        """Start to write the film of the edit as it is now; later changes do not affect the film."""
        path = self._path(self.format.value)
        with self.model.lock:
            session = self.model.session.fork()

        def work(advance: Callable[[], None]) -> Path:
            compute = lambda draw: self.host.worker.call(draw, patient=True)  # noqa: E731
            render_film(session, path, advance, compute)
            return path

        self._start(client, f"Film {path.name}", session.edit.film.frames, work)
        return path

    def export_ply(self, client: Any = None) -> Path:
        """Start to write the edited Gaussians at the moment shown."""
        path = self._path(".ply")
        moment = self.model.moment()
        with self.model.lock:
            session = self.model.session.fork()

        def work(advance: Callable[[], None]) -> Path:
            self.host.worker.call(lambda: session.export_ply(path, moment.time, moment.at), patient=True)
            return path

        self._start(client, f"PLY {path.name}", 1, work)
        return path

    def show(self) -> None:
        names = files.saved_edits(self.host.folder) or (NONE,)
        if self.saved.options != names:
            self.saved.options = names
