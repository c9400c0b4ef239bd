"""Clients of a local server: requests with chosen headers, and WebSockets."""

from __future__ import annotations

import asyncio
import http.client
from collections.abc import Awaitable, Callable
from typing import Any

from scgs_warp.live.server import PageServer


def get(port: int, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    """One GET; ``response.text`` is the body."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    response = connection.getresponse()
    response.text = response.read().decode("utf-8", "replace")  # type: ignore[attr-defined]
    connection.close()
    return response


def key(server: PageServer) -> str:
    """The cookie that opens a server."""
    return f"{server.access.cookie}={server.access.token}"


def talk(
    server: PageServer, action: Callable[[Any], Awaitable[Any]], origin: str | None = "own", **headers: str
) -> Any:
    """Run ``action`` with a WebSocket of a page of this origin; raises aiohttp.WSServerHandshakeError if refused."""
    import aiohttp

    address = f"http://127.0.0.1:{server.port}"
    sent = {"Cookie": key(server), **{name.replace("_", "-"): value for name, value in headers.items()}}
    if origin is not None:
        sent["Origin"] = address if origin == "own" else origin

    async def run() -> Any:
        async with aiohttp.ClientSession() as session:
            async with session.ws_connect(f"{address}/socket", headers=sent, max_msg_size=0) as wire:
                return await asyncio.wait_for(action(wire), 60)

    return asyncio.run(run())


def opens(server: PageServer, origin: str | None, **headers: str) -> bool:
    """Whether a WebSocket of this origin is accepted."""
    import aiohttp

    async def nothing(wire: Any) -> None:
        pass

    try:
        talk(server, nothing, origin, **headers)
    except aiohttp.WSServerHandshakeError as error:
        assert error.status == 403
        return False
    return True
