"""Access control of the editor. viser checks neither the origin of a request nor its sender, so any page could drive an
editor on its visitor's machine. The editor has two entrances, and both check requests:

``guarded`` refuses foreign pages at the editor's own port, which listens on 127.0.0.1 only. ``Proxy`` listens where
other machines reach it, requires a token, checks the origin of pages and WebSockets, and forwards everything; while it
runs, the editor's own port accepts requests of the proxy alone.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import http
import secrets
import threading
import traceback
from collections.abc import Iterator
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

from ..errors import UserError

LOCAL_HOSTS = {"127.0.0.1", "localhost", "::1"}
KEY_HEADER = "x-editor-key"
COOKIE = "scgs_editor_"
"""Prefix of the cookie's name. The port follows, because cookies belong to hosts and a host may run several editors."""
MAX_HEAD_BYTES = 32 << 10
"""Largest size of a request's head in bytes."""
PATIENCE = 10.0
"""Seconds within which a request's head must arrive."""
MAX_PENDING = 200
"""Largest number of connections that have not shown the token yet; further ones are closed at once."""


class RequestHead(NamedTuple):
    """Request line and headers of an HTTP request."""

    method: str
    target: str
    headers: list[tuple[str, str]]
    """Names in lower case."""

    def get(self, name: str) -> str | None:
        """Return a header's value; None if it is missing, and an empty text, which passes no check, if it is
        repeated."""
        values = [value for key, value in self.headers if key == name]
        return None if not values else values[0] if len(values) == 1 else ""

    @property
    def upgrades(self) -> bool:
        return (self.get("upgrade") or "").lower() == "websocket"


def parse_head(text: bytes) -> RequestHead | None:
    """Parse a request's head; return None for a body, folded lines or control characters, which browsers never send."""
    try:
        first, *rest = text.decode("latin-1").removesuffix("\r\n\r\n").split("\r\n")
        method, target, version = first.split(" ")
        headers = [(line.partition(":")[0].lower(), line.partition(":")[2].strip()) for line in rest]
        urlsplit(target)
    except ValueError:
        return None
    plain = all(name and ":" in line and name.replace("-", "").isalnum() for (name, _), line in zip(headers, rest))
    printable = all(" " <= character != "\x7f" for line in (first, *rest) for character in line)
    head = RequestHead(method, target, headers)
    body = head.get("content-length") not in (None, "0") or head.get("transfer-encoding") is not None
    good = method in ("GET", "HEAD") and version == "HTTP/1.1" and target.startswith("/") and not body
    return head if good and plain and printable else None


def same_origin(origin: str | None, host: str | None) -> bool:
    """Return whether a page of this origin came from the host that it sends a request to."""
    if not origin or not host:
        return False
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower()


def cookies(header: str) -> dict[str, str]:
    """Parse a Cookie header. Malformed cookies, which other pages of the host may set, do not hide the others."""
    pairs = (part.strip().partition("=") for part in header.split(";"))
    return {name: value for name, _, value in pairs}


def is_local(host: str | None) -> bool:
    """Return whether a Host header names this machine; a foreign name that resolves to 127.0.0.1 does not."""
    try:
        return urlsplit(f"//{host}").hostname in LOCAL_HOSTS
    except ValueError:
        return False


def refusal(headers: Any, key: str | None) -> str | None:
    """Return the reason to refuse a request at the editor's own port; None accepts it.

    Args:
        headers: object with ``get_all(name)``.
        key: secret of the proxy if there is one; otherwise only pages of this machine are accepted.
    """
    host, origin, given = (
        values[0] if len(values) == 1 else None for values in map(headers.get_all, ("Host", "Origin", KEY_HEADER))
    )
    if key is not None:
        known = given is not None and hmac.compare_digest(given.encode(), key.encode())
        return None if known else "come in through the address that the editor printed"
    if not is_local(host):
        return "the editor answers to 127.0.0.1 and localhost only"
    if (headers.get_all("Upgrade") or headers.get_all("Origin")) and not same_origin(origin, host):
        return "a page from elsewhere may not use the editor"
    return None


@contextlib.contextmanager
def guarded(key: str | None) -> Iterator[None]:
    """Make servers started inside this context refuse requests by ``refusal``. viser has no hook for requests, so the
    function of ``websockets`` that starts its server is replaced.

    Raises:
        UserError: the server was started in another way, and so would accept any request.
    """
    import websockets.asyncio.server as module

    start, started = module.serve, False

    def serve(handler: Any, *args: Any, process_request: Any = None, **options: Any) -> Any:
        nonlocal started
        started = True

        async def patient(connection: Any) -> None:
            try:
                await handler(connection)
            except Exception as error:
                if not _is_malformed(error):
                    raise
                await connection.close(1007, "not a message of this page")

        def check(connection: Any, request: Any) -> Any:
            why = refusal(request.headers, key)
            if why is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, why)
            return None if process_request is None else process_request(connection, request)

        return start(patient, *args, process_request=check, **options)

    module.serve = serve  # type: ignore[assignment]
    try:
        yield
    finally:
        module.serve = start
    if not started:
        raise UserError("the editor cannot guard this version of viser; install: pip install 'viser>=1.1,<1.2'")


def _is_malformed(error: Exception) -> bool:
    """Return whether an error is about a message that a page sent, and not about our answer to it: whether it was
    raised while viser decoded the message."""
    return any(frame.f_code.co_name == "_message_consumer" for frame, _ in traceback.walk_tb(error.__traceback__))


class Proxy:
    """Forwarder of requests that have the token to ``port`` on 127.0.0.1. It runs on a thread of its own until
    ``stop``.

    Args:
        port: port of the editor.
        key: secret that identifies the proxy to the editor's ``guarded`` port.
        host: interface to listen on.
        public: port to listen on; 0: any.

    Attributes: ``token``, ``public`` (the port), ``url`` (from this machine, with the token), ``cookie`` (name of the
    cookie that holds the token).

    Raises:
        UserError: the port is not available.
    """

    def __init__(self, port: int, key: str, host: str = "0.0.0.0", public: int = 0) -> None:
        self.port, self.key, self.host, self.public = port, key, host, public
        self.token = secrets.token_urlsafe(24)
        self._loop = asyncio.new_event_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self._pending = 0
        self._thread = threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True)
        self._thread.start()
        try:
            self._server = asyncio.run_coroutine_threadsafe(self._listen(), self._loop).result(10)
        except OSError as error:
            self._loop.call_soon_threadsafe(self._loop.stop)
            raise UserError(f"--port {public}: cannot listen there ({error.strerror}); give another port") from None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.public}/?token={self.token}"

    @property
    def cookie(self) -> str:
        return f"{COOKIE}{self.public}"

    def stop(self) -> None:
        """End every connection and stop listening."""

        async def close() -> None:
            self._server.close()
            for task in list(self._tasks):
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)

        if self._thread.is_alive():
            asyncio.run_coroutine_threadsafe(close(), self._loop).result(10)
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(10)

    async def _listen(self) -> asyncio.Server:
        server = await asyncio.start_server(self._serve, self.host, self.public, limit=MAX_HEAD_BYTES)
        self.public = server.sockets[0].getsockname()[1]
        return server

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            await self._answer(reader, writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, asyncio.TimeoutError):
            pass  # the client is gone, too slow, or sends no valid request
        finally:
            self._tasks.discard(task)
            writer.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._pending >= MAX_PENDING:
            return
        self._pending += 1
        try:
            head = await self._admit(reader, writer)
        finally:
            self._pending -= 1
        if head is None:
            return
        origin = head.get("origin")
        if (head.upgrades or origin is not None) and not same_origin(origin, head.get("host")):
            return await _reply(writer, "403 Forbidden", "a page from elsewhere may not use the editor")
        if "token" in parse_qs(urlsplit(head.target).query):
            # The cookie replaces the token in the address, which would end up in the history and in Referer headers.
            cookie = f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Lax"
            return await _reply(writer, "303 See Other", "", f"Location: /\r\nSet-Cookie: {cookie}\r\n")
        await self._pass_on(head, reader, writer)

    async def _admit(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> RequestHead | None:
        """Return the head of a request that has the token; None if the request was refused."""
        text = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), PATIENCE)
        head = parse_head(text)
        if head is None:
            await _reply(writer, "400 Bad Request", "not a request of this page")
            return None
        given = self._given(head)
        if given is None or not hmac.compare_digest(given.encode(), self.token.encode()):
            await _reply(writer, "403 Forbidden", "open the address that the editor printed, token and all")
            return None
        return head

    def _given(self, head: RequestHead) -> str | None:
        """Return the token of a request, from its address or from the cookie."""
        asked = parse_qs(urlsplit(head.target).query).get("token")
        if asked is not None:
            return asked[0] if len(asked) == 1 else None
        return cookies(head.get("cookie") or "").get(self.cookie)

    async def _pass_on(self, head: RequestHead, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Forward the head, then bytes in both directions. A connection carries one request, unless it becomes a
        WebSocket, so that no unchecked request is forwarded."""
        kept = [(name, value) for name, value in head.headers if name not in (KEY_HEADER, "cookie", "connection")]
        kept += [(KEY_HEADER, self.key), ("connection", "Upgrade" if head.upgrades else "close")]
        lines = [f"{head.method} {head.target} HTTP/1.1", *(f"{name}: {value}" for name, value in kept)]
        inside_reader, inside_writer = await asyncio.open_connection("127.0.0.1", self.port)
        try:
            inside_writer.write(("\r\n".join(lines) + "\r\n\r\n").encode("latin-1"))
            ways = [asyncio.create_task(_pump(inside_reader, writer))]
            if head.upgrades:
                ways.append(asyncio.create_task(_pump(reader, inside_writer)))
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)
        finally:
            inside_writer.close()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while chunk := await reader.read(1 << 16):
            writer.write(chunk)
            await writer.drain()


async def _reply(writer: asyncio.StreamWriter, status: str, text: str, more: str = "") -> None:
    body = text.encode()
    head = (
        f"HTTP/1.1 {status}\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: {len(body)}\r\n"
        f"Connection: close\r\nCache-Control: no-store\r\nReferrer-Policy: no-referrer\r\n{more}\r\n"
    )
    writer.write(head.encode("latin-1") + body)
    await writer.drain()
