"""Local server of a page: aiohttp on a thread of its own, behind the rules of ``access``."""

from __future__ import annotations

import asyncio
import itertools
import json
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import UserError
from ..runtime import addresses
from ..storage.json_files import parse_json
from .access import NO_TOKEN, Access, Request, cookies
from .return_key import ReturnKey, is_number, kept_key, key_file

if TYPE_CHECKING:
    from aiohttp import web

LOCAL, EVERYWHERE = "127.0.0.1", "0.0.0.0"
PORTS_TRIED = 50
"""Number of ports that are tried if the wanted one is taken on this machine."""
PATIENCE = 10.0
"""Seconds within which a connection must have sent a request that is accepted."""
MAX_STRANGERS = 200
"""Largest number of connections without an accepted request; the oldest are closed first."""
MAX_MESSAGE = 4 << 20
"""Largest message of a page in bytes."""
MESSAGES_PER_SECOND, BURST = 400.0, 1200.0
"""Rate and burst of messages that a page may send; beyond them its connection is closed."""
MAX_BACKLOG = 64 << 20
"""Largest number of bytes that may wait for a page that does not read; beyond it its connection is closed."""
HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
}
RETURN = "/return"
"""Path at which pages of an earlier start ask to be let in; the only one that needs no token."""
Handler = Callable[["web.Request"], Awaitable["web.StreamResponse"]]


def import_aiohttp() -> Any:
    """Import the package that serves the page.

    Raises:
        UserError: the package is not installed.
    """
    try:
        import aiohttp.web
    except ImportError:
        raise UserError("pages need the package aiohttp; install it with: pip install 'scgs_warp[edit]'") from None
    return aiohttp


class Client:
    """One page that is connected by a WebSocket. ``send`` may be called from any thread."""

    def __init__(
        self,
        number: int,
        wire: web.WebSocketResponse,
        loop: asyncio.AbstractEventLoop,
        transport: asyncio.Transport | None = None,
    ) -> None:
        self.number, self._wire, self._loop, self._transport = number, wire, loop, transport
        self._waiting: dict[str | int, str | bytes] = {}
        """Messages in the order in which they are sent: by kind those of which only the newest counts, others by
        number."""
        self._backlog = 0
        """Bytes of numbered messages."""
        self._numbers = itertools.count()
        self._ready = asyncio.Event()
        self._lock = threading.Lock()
        self._allowance, self._refilled = BURST, time.monotonic()

    def send(self, message: Mapping[str, Any] | bytes, latest: str | None = None) -> None:
        """Send a JSON object or bytes. A page that leaves ``MAX_BACKLOG`` unread is cut off.

        Args:
            latest: kind of the message. A later one of the same kind takes its place while it waits, so that a slow
                page gets the newest state instead of all states. What is sent after a state does not overtake it.
        """
        content = message if isinstance(message, bytes) else json.dumps(message, allow_nan=False)
        with self._lock:
            if latest is not None:
                self._waiting[latest] = content
            elif self._backlog <= MAX_BACKLOG:
                self._waiting[next(self._numbers)] = content
                self._backlog += len(content)
            full = self._backlog > MAX_BACKLOG
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._cut if full else self._ready.set)

    def _cut(self) -> None:
        if self._transport is not None:
            self._transport.abort()

    async def pump(self) -> None:
        """Send what waits, until the connection is closed."""
        while not self._wire.closed:
            await self._ready.wait()
            self._ready.clear()
            with self._lock:
                messages, self._waiting = self._waiting, {}
            for message in messages.values():
                await (self._wire.send_bytes(message) if isinstance(message, bytes) else self._wire.send_str(message))
            with self._lock:
                self._backlog = sum(len(content) for key, content in self._waiting.items() if isinstance(key, int))

    def allows(self) -> bool:
        """Count a message of the page; return False if there are too many."""
        now = time.monotonic()
        self._allowance = min(BURST, self._allowance + MESSAGES_PER_SECOND * (now - self._refilled)) - 1.0
        self._refilled = now
        return self._allowance >= 0.0


class PageServer:
    """Server of one page, its data and its WebSockets, on a thread of its own until ``stop``.

    Args:
        routes: handlers of GET requests by path. ``/socket`` is the WebSocket's.
        port: port on this machine; if it is taken, one of the next. 0: any.
        shared: listen on all interfaces, on exactly this port.
        page: digest of what open pages hold. A page that finds another one after a return loads itself anew.
        source: run or file that is served. Pages find their way back to its next start on the same port, unless
            the port may be any, or other machines may use the server: its start then takes their access away.
        received: called on the server's thread with a page and a JSON object that it sent.
        connected, left: called on the server's thread when a page connects and when it is gone.

    Attributes: ``port``, ``access``, ``clients`` by number.

    Raises:
        UserError: aiohttp is not installed, or the port is not available.
        NotEnoughMemory: there is no room for the thread.
    """

    def __init__(
        self,
        routes: Mapping[str, Handler],
        *,
        port: int = 0,
        shared: bool = False,
        page: str = "",
        source: Path | None = None,
        received: Callable[[Client, dict[str, Any]], None] = lambda client, message: None,
        connected: Callable[[Client], None] = lambda client: None,
        left: Callable[[Client], None] = lambda client: None,
    ) -> None:
        self._aiohttp = import_aiohttp()
        self._received, self._connected, self._left = received, connected, left
        self._socket = _listen(port, shared)
        self.port: int = self._socket.getsockname()[1]
        self.access = Access(self.port, shared)
        self._page = page
        self._way_back: ReturnKey | None = None
        if source is not None and port and not shared:
            self._way_back = ReturnKey(kept_key(key_file(source, self.port)), self.port)
        self.clients: dict[int, Client] = {}
        self._count = 0
        self._since: dict[Any, float] = {}
        """Time at which a connection without an accepted request was first seen."""
        self._known: set[Any] = set()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="page server", daemon=True)
        addresses.start(self._thread)
        asyncio.run_coroutine_threadsafe(self._start(dict(routes)), self._loop).result(30)

    @property
    def url(self) -> str:
        """Address for a browser on this machine, with the token."""
        return f"http://{LOCAL}:{self.port}/?token={self.access.token}"

    def stop(self) -> None:
        """End every connection and stop listening."""
        if self._thread.is_alive():
            asyncio.run_coroutine_threadsafe(self._end(), self._loop).result(30)
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(10)
            self._loop.close()

    def broadcast(self, message: Mapping[str, Any] | bytes, latest: str | None = None) -> None:
        """Send a message to every page."""
        for client in list(self.clients.values()):
            client.send(message, latest)

    async def _start(self, routes: dict[str, Handler]) -> None:
        web = self._aiohttp.web

        @web.middleware
        async def admit(request: web.Request, handler: Handler) -> web.StreamResponse:
            return await self._admit(request, handler)

        application = web.Application(middlewares=[admit], client_max_size=1)
        for path, handler in {**routes, "/socket": self._serve_socket}.items():
            application.router.add_get(path, handler)
        self._runner = web.AppRunner(application, access_log=None, shutdown_timeout=2.0, keepalive_timeout=30.0)
        await self._runner.setup()
        await web.SockSite(self._runner, self._socket).start()
        self._sweeper = asyncio.ensure_future(self._sweep())

    async def _end(self) -> None:
        self._sweeper.cancel()
        await self._runner.cleanup()

    async def _admit(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse a request by the rules, or answer it. The token moves from the address, which would end up in the
        history and in Referer headers, to a cookie."""
        web, headers = self._aiohttp.web, request.headers
        asked = Request(
            headers.getall("Host", []),
            headers.getall("Origin", []),
            "upgrade" in headers,
            request.query.getall("token", []),
            cookies("; ".join(headers.getall("Cookie", []))),
        )
        if request.path == RETURN and self.access.foreign(asked) is None:
            return self._let_back(request)
        why = self.access.refusal(asked)
        if why is not None:
            refused = web.Response(status=403, text=why, headers=HEADERS)
            refused.force_close()
            return refused
        self._known.add(request.transport)
        if asked.tokens:
            rest = request.url.without_query_params("token")
            response = web.Response(status=303, headers={**HEADERS, "Location": str(rest.relative())})
            self._give_cookie(response)
            return response
        try:
            response = await handler(request)
        except web.HTTPException as error:
            response = web.Response(status=error.status, text=error.reason)
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    def _give_cookie(self, response: web.StreamResponse) -> None:
        response.set_cookie(self.access.cookie, self.access.token, path="/", httponly=True, samesite="Lax")

    def _let_back(self, request: web.Request) -> web.StreamResponse:
        """Answer a page of an earlier start: prove that this is the server that it knew, and give it the token if it
        proves the same."""
        web, known = self._aiohttp.web, self._way_back
        drawn, proof = request.query.get("drawn", ""), request.query.get("proof")
        if known is None or not is_number(drawn):
            response = web.Response(status=404, text=NO_TOKEN, headers=HEADERS)
        elif proof is None:
            response = web.json_response({"start": known.start, "proof": known.proof("server", drawn)}, headers=HEADERS)
        elif known.knows(drawn, proof):
            response = web.Response(status=204, headers=HEADERS)
            self._give_cookie(response)
        else:
            response = web.Response(status=403, text=NO_TOKEN, headers=HEADERS)
        response.force_close()
        return response

    def _introduce(self, client: Client) -> None:
        """Tell a page what it needs to find its way back."""
        if self._page:
            known = self._way_back
            way_back = None if known is None else {"key": known.key, "port": known.port}
            client.send({"server": {"page": self._page, "back": way_back}})

    async def _serve_socket(self, request: web.Request) -> web.StreamResponse:
        web, kinds = self._aiohttp.web, self._aiohttp.WSMsgType
        wire = web.WebSocketResponse(max_msg_size=MAX_MESSAGE, heartbeat=60.0, compress=False)
        await wire.prepare(request)
        self._count += 1
        client = Client(self._count, wire, self._loop, request.transport)
        self.clients[client.number] = client
        pumping = asyncio.ensure_future(client.pump())
        try:
            self._introduce(client)
            self._connected(client)
            async for message in wire:
                if message.type != kinds.TEXT or not client.allows():
                    await wire.close(code=self._aiohttp.WSCloseCode.POLICY_VIOLATION, message=b"too many messages")
                    break
                self._hear(client, message.data)
        finally:
            del self.clients[client.number]
            pumping.cancel()
            self._left(client)
        return wire

    def _hear(self, client: Client, text: str) -> None:
        """Pass a message on if it is a JSON object; ignore anything else. A page that asks whether the server is there
        is answered at once."""
        try:
            message = parse_json(text)
        except ValueError:
            return
        if isinstance(message, dict) and message.get("do") == "beat":
            client.send({"beat": True}, latest="beat")
        elif isinstance(message, dict):
            self._received(client, message)

    async def _sweep(self) -> None:
        """Close connections that have sent no accepted request in time, and the oldest of too many."""
        while True:
            await asyncio.sleep(1.0)
            now, server = time.monotonic(), self._runner.server
            assert server is not None
            open_now = {c.transport: c for c in server.connections if c.transport is not None}
            self._known &= set(open_now)
            strangers = [wire for wire in open_now if wire not in self._known]
            self._since = {wire: self._since.get(wire, now) for wire in strangers}
            strangers.sort(key=self._since.__getitem__)
            for row, wire in enumerate(strangers):
                if now - self._since[wire] > PATIENCE or row < len(strangers) - MAX_STRANGERS:
                    wire.abort()


def _listen(port: int, shared: bool) -> socket.socket:
    """Return a listening socket.

    Raises:
        UserError: the port is not available.
    """
    problem: OSError | None = None
    for candidate in range(port, port + (1 if shared or port == 0 else PORTS_TRIED)):
        try:
            return socket.create_server((EVERYWHERE if shared else LOCAL, min(candidate, 65535)), backlog=256)
        except OSError as error:
            problem = error
    why = "" if problem is None else f" ({problem.strerror})"
    raise UserError(f"--port {port}: cannot listen there{why}; give another port")
