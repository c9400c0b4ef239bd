"""A page of the editor without a browser: it asks, and keeps what it hears."""

from __future__ import annotations

import asyncio
import json
import struct
import threading
from pathlib import Path
from typing import Any

import numpy as np

from helpers.edit_scenes import bar_scene
from helpers.web_clients import key
from scgs_warp.edit import EditSession
from scgs_warp.editor import Editor
from scgs_warp.editor.autosave import Autosave

PATIENCE = 60.0


def bar_editor(folder: Path, **scene: Any) -> Editor:
    """An editor of a bar (``edit_scenes.bar_scene``), whose edit is kept in a folder."""
    session = EditSession(bar_scene(**scene))
    keeper = Autosave(session, folder)
    keeper.start(restore=True)
    return Editor(session, folder, title="bar", port=0, autosave=keeper)


class Page:
    """Connection of one page, on a thread of its own."""

    def __init__(self, editor: Editor) -> None:
        self.editor = editor
        self.state: dict[str, Any] = {}
        self.hello: dict[str, Any] = {}
        self.heard: list[dict[str, Any]] = []
        self.poses: dict[int, np.ndarray] = {}
        self.pictures: list[bytes] = []
        self.closed = threading.Event()
        self._count = 0
        self._changed = threading.Condition()
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: self._loop.run_until_complete(self._run()), daemon=True)
        self._thread.start()
        assert self._ready.wait(PATIENCE)
        self.until(lambda: self.state and self.hello)

    async def _run(self) -> None:
        import aiohttp

        address = f"http://127.0.0.1:{self.editor.server.port}"
        headers = {"Cookie": key(self.editor.server), "Origin": address}
        async with aiohttp.ClientSession() as session:
            async with session.ws_connect(f"{address}/socket", headers=headers, max_msg_size=0) as wire:
                self._wire = wire
                self._ready.set()
                async for message in wire:
                    self._take(message.data)
        with self._changed:
            self.closed.set()
            self._changed.notify_all()

    def _take(self, data: str | bytes) -> None:
        with self._changed:
            if isinstance(data, bytes):
                kind, _, frame, _ = struct.unpack("<4i", data[:16])
                if kind == 1:
                    self.poses[frame] = np.frombuffer(data[16:], "<f4").reshape(-1, 28)
                else:
                    self.pictures.append(data[16:])
            else:
                message = json.loads(data)
                self.state = message.get("state", self.state)
                self.hello = message.get("hello", self.hello)
                self.heard.append(message)
            self._changed.notify_all()

    def until(self, condition: Any) -> None:
        with self._changed:
            assert self._changed.wait_for(condition, PATIENCE), (
                f"waited in vain: {self.heard[-3:]}, {self.editor.worker.idle}"
            )

    def send(self, message: Any) -> None:
        text = message if isinstance(message, str) else json.dumps(message)
        asyncio.run_coroutine_threadsafe(self._wire.send_str(text), self._loop).result(PATIENCE)

    def send_frame(self, content: bytes, kind: Any) -> None:
        """Send a frame that may break the protocol."""
        asyncio.run_coroutine_threadsafe(self._wire._writer.send_frame(content, kind), self._loop).result(PATIENCE)

    def ask(self, what: str, /, **fields: Any) -> dict[str, Any]:
        """The answer; the state that follows from it comes before it."""
        self._count += 1
        number = self._count
        self.send({"do": what, "id": number, **fields})
        self.until(lambda: any(message.get("id") == number for message in self.heard))
        return next(message for message in self.heard if message.get("id") == number)

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self._wire.close(), self._loop).result(PATIENCE)
        self._thread.join(PATIENCE)
