"""View of a scene in the browser: the page of an export, served, with a scene that may change."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import UserError
from ..export.page import SCRIPTS, document, program_text, read_web
from ..runtime import addresses
from .server import Client, PageServer

if TYPE_CHECKING:
    from aiohttp import web

WEB = Path(__file__).parent / "web"
WIRE = read_web("wire.js", WEB)
"""Script of a page's connection to its ``PageServer``."""


def digest(*contents: bytes) -> str:
    """Return a digest of what a page holds."""
    whole = hashlib.sha256()
    for content in contents:
        whole.update(len(content).to_bytes(8, "little") + content)
    return whole.hexdigest()


class SceneView:
    """Server of one scene's page. ``publish`` replaces the scene; every page follows and keeps its camera and time.

    Args:
        title: text shown on the page.
        port, shared, source: as for ``PageServer``.

    Raises:
        UserError: aiohttp is not installed, or the port is not available.
    """

    def __init__(self, title: str, *, port: int = 0, shared: bool = False, source: Path | None = None) -> None:
        program = program_text(SCRIPTS, [WIRE, read_web("live.js", WEB)])
        self._page = document(program, title, network="'self'")
        self._content, self._version, self._status = b"", 0, "waiting for the scene"
        self._lock = threading.Lock()
        self.wanted = threading.Event()
        """Set while at least one page is open."""
        routes = {"/": self._serve_page, "/scene": self._serve_scene}
        self.server = PageServer(
            routes,
            port=port,
            shared=shared,
            page=digest(self._page),
            source=source,
            connected=self._greet,
            left=self._bid_farewell,
        )

    def publish(self, content: bytes, status: str = "") -> None:
        """Show another scene, the result of ``pack``."""
        with self._lock:
            self._content, self._version, self._status = content, self._version + 1, status
        self._tell()

    def say(self, status: str) -> None:
        """Change the line below the title; an empty one is hidden."""
        with self._lock:
            self._status = status
        self._tell()

    @property
    def invitation(self) -> str:
        """Lines for the terminal that say where the page is."""
        lines = [f"open {self.server.url} in a browser; Ctrl-C ends"]
        if self.server.access.shared:
            lines.append("from other machines: the same with this machine's name; whoever has the token may look")
            lines.append("what is sent is not encrypted: outside a network that you trust, forward the port over SSH")
        return "\n".join(lines)

    def stop(self) -> None:
        self.server.stop()

    def __enter__(self) -> SceneView:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def _state(self) -> dict[str, Any]:
        with self._lock:
            return {"version": self._version, "status": self._status}

    def _tell(self) -> None:
        self.server.broadcast(self._state())

    def _greet(self, client: Client) -> None:
        self.wanted.set()
        client.send(self._state())

    def _bid_farewell(self, client: Client) -> None:
        if not self.server.clients:
            self.wanted.clear()

    async def _serve_page(self, request: web.Request) -> web.StreamResponse:
        from aiohttp import web

        return web.Response(body=self._page, content_type="text/html", charset="utf-8")

    async def _serve_scene(self, request: web.Request) -> web.StreamResponse:
        from aiohttp import web

        with self._lock:
            content = self._content
        if not content:
            return web.Response(status=404, text="there is no scene yet")
        return web.Response(body=content, content_type="application/octet-stream")


class RunWatcher:
    """Thread that publishes a run's scene again whenever its checkpoint changes, while another process trains it.

    Args:
        path: file to watch.
        read: returns the packed scene and a status line; a ``UserError`` is shown on the page.
    """

    PAUSE = 2.0
    """Seconds between two looks at the file."""

    def __init__(self, path: Path, view: SceneView, read: Callable[[], tuple[bytes, str]]) -> None:
        self._path, self._view, self._read = path, view, read
        self._seen = self._stamp()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="run watcher", daemon=True)
        addresses.start(self._thread)

    def _stamp(self) -> tuple[int, int] | None:
        try:
            facts = self._path.stat()
        except OSError:  # between the removal of the old file and the renaming of the new one
            return None
        return facts.st_mtime_ns, facts.st_size

    def _run(self) -> None:
        while not self._ended.wait(self.PAUSE):
            stamp = self._stamp()
            if stamp is None or stamp == self._seen:
                continue
            self._seen = stamp
            began = time.monotonic()
            try:
                self._view.publish(*self._read())
            except UserError as error:
                self._view.say(str(error))
            self._ended.wait(min(60.0, 10.0 * (time.monotonic() - began)))  # the training needs the processor

    def stop(self) -> None:
        self._ended.set()
        self._thread.join(60)
