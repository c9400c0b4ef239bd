"""The server at work: who is let in, what is sent, and what overloads it."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest

from helpers.web_clients import get, key, opens, talk
from scgs_warp.errors import UserError
from scgs_warp.live import server as module
from scgs_warp.live.server import Client, PageServer

aiohttp = pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")


async def hello(request: Any) -> Any:
    return aiohttp.web.Response(text="hello")


class Recorded(PageServer):
    """Server that keeps what pages send and answers each message with its count."""

    def __init__(self, **options: Any) -> None:
        self.heard: list[dict[str, Any]] = []
        self.gone = threading.Event()
        super().__init__({"/": hello}, received=self.hear, left=lambda client: self.gone.set(), **options)

    def hear(self, client: Client, message: dict[str, Any]) -> None:
        self.heard.append(message)
        client.send({"heard": len(self.heard)})


@pytest.fixture(params=["local", "shared"])
def server(request, monkeypatch) -> Iterator[Recorded]:
    monkeypatch.setattr(module, "EVERYWHERE", "127.0.0.1")  # tests open no port to other machines
    made = Recorded(shared=request.param == "shared")
    yield made
    made.stop()


def test_it_listens_on_this_machine_only():
    made = Recorded()
    try:
        with socket.socket() as other:
            other.bind(("127.0.0.2", made.port))  # free: it does not listen everywhere
    finally:
        made.stop()


def test_the_token_becomes_a_cookie_that_opens_everything(server):
    first = get(server.port, f"/?t=3&token={server.access.token}")
    assert first.status == 303 and first.getheader("Location") == "/?t=3"
    cookie = first.getheader("Set-Cookie") or ""
    assert "HttpOnly" in cookie and "SameSite=Lax" in cookie
    page = get(server.port, Cookie=cookie.partition(";")[0])
    assert page.status == 200 and page.text == "hello"
    assert page.getheader("X-Frame-Options") == "DENY" and page.getheader("Cache-Control") == "no-store"
    assert opens(server, "own")


def test_without_the_token_nothing_is_served(server):
    for path in ("/", "/missing", "/?token=", "/?token=wrong", f"/?token={server.access.token}x", "/?token=a&token=b"):
        assert get(server.port, path).status == 403, path
    assert not opens(server, "own", Cookie=f"{server.access.cookie}=wrong")
    assert server.heard == [] and server.clients == {}


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "null", None, "http://["])
def test_foreign_pages_are_refused(server, origin, capfd):
    assert not opens(server, origin)
    if origin is not None:
        assert get(server.port, Cookie=key(server), Origin=origin).status == 403
    assert "Traceback" not in capfd.readouterr().err


def test_odd_cookies_of_other_pages_hide_nothing(server):
    for others in ('x={"a":1}; ', "a b=c; ", "=; ;; ", 'q="; ', f"{server.access.cookie}x=wrong; "):
        assert get(server.port, Cookie=others + key(server)).status == 200, others


def test_every_request_of_a_connection_is_checked(server):
    good = f"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {key(server)}\r\n\r\n"
    bad = good.replace("Cookie", "Other")
    with socket.create_connection(("127.0.0.1", server.port), 20) as raw:
        raw.sendall((good + bad + good).encode())
        heard = b""
        while chunk := raw.recv(65536):
            heard += chunk
    assert heard.count(b" 200 OK") == 1 and heard.count(b" 403 ") == 1, "and then the connection is closed"


@pytest.mark.parametrize(
    "text",
    [b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 3\r\n\r\nabc", b"nonsense\r\n\r\n", b"\x16\x03\x01"],
)
def test_what_no_page_sends_does_no_harm(server, text):
    with socket.create_connection(("127.0.0.1", server.port), 20) as raw:
        raw.sendall(text)
        raw.shutdown(socket.SHUT_WR)
        assert b" 200 " not in raw.recv(4096)
    assert get(server.port, Cookie=key(server)).status == 200


def test_messages_of_a_page(server):
    async def chat(wire: Any) -> list[Any]:
        for text in ('{"a": 1}', "not JSON", "[1]", "[" * 100_000, '{"b": 2}'):
            await wire.send_str(text)
        return [await wire.receive_json(), await wire.receive_json()]

    assert talk(server, chat) == [{"heard": 1}, {"heard": 2}]
    assert server.heard == [{"a": 1}, {"b": 2}]
    assert server.gone.wait(10) and server.clients == {}


def test_a_page_hears_at_once_that_the_server_is_there(server):
    async def ask(wire: Any) -> Any:
        await wire.send_str('{"do": "beat"}')
        return await wire.receive_json()

    assert talk(server, ask) == {"beat": True} and server.heard == []


def test_a_slow_page_gets_the_newest_state(server):
    async def wait(wire: Any) -> list[bytes | str]:
        while not server.clients:
            await asyncio.sleep(0.01)
        (client,) = server.clients.values()

        def flood() -> None:  # on the server's loop: nothing is sent in between
            for number in range(100):
                client.send(bytes([number]), latest="pose")
            client.send({"said": "once"})
            client.send(bytes([100]), latest="pose")

        server._loop.call_soon_threadsafe(flood)
        return [(await wire.receive()).data for _ in range(2)]

    assert talk(server, wait) == [bytes([100]), '{"said": "once"}'], "what follows a state does not overtake it"


def test_a_page_that_does_not_read_is_cut_off(server, monkeypatch):
    monkeypatch.setattr(module, "MAX_BACKLOG", 1 << 20)

    async def sleep(wire: Any) -> bool:
        while not server.clients:
            await asyncio.sleep(0.01)
        (client,) = server.clients.values()
        wire._response.connection.transport.pause_reading()
        for _ in range(200):
            client.send(bytes(1 << 18))
            await asyncio.sleep(0.01)
        return await asyncio.to_thread(server.gone.wait, 20)

    assert talk(server, sleep)
    assert server.clients == {} and get(server.port, Cookie=key(server)).status == 200


@pytest.mark.parametrize("flood", ["messages", "size", "bytes"])
def test_a_page_that_sends_too_much_is_cut_off(server, flood):
    async def send(wire: Any) -> Any:
        try:
            if flood == "size":
                await wire.send_str('{"a": "' + "x" * (module.MAX_MESSAGE + 1) + '"}')
            elif flood == "bytes":
                await wire.send_bytes(b"{}")
            else:
                for _ in range(10_000):
                    await wire.send_str('{"a": 1}')
        except (ConnectionError, aiohttp.ClientError):
            return True
        while (message := await wire.receive()).type == aiohttp.WSMsgType.TEXT:
            pass
        return message.type in (aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.CLOSING)

    assert talk(server, send)
    assert len(server.heard) < 3000 and get(server.port, Cookie=key(server)).status == 200


def test_strangers_are_not_waited_for_without_end(server, monkeypatch):
    monkeypatch.setattr(module, "PATIENCE", 1.0)
    monkeypatch.setattr(module, "MAX_STRANGERS", 5)
    waiting = [socket.create_connection(("127.0.0.1", server.port), 20) for _ in range(12)]
    kept = socket.create_connection(("127.0.0.1", server.port), 20)
    kept.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {key(server)}\r\n\r\n".encode())
    assert b" 200 OK" in kept.recv(4096)
    begin = time.monotonic()
    for one in waiting:
        one.settimeout(20)
        with suppress(ConnectionResetError):
            assert one.recv(1) == b""
        one.close()
    assert time.monotonic() - begin < 15
    kept.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {key(server)}\r\n\r\n".encode())
    assert b" 200 OK" in kept.recv(4096), "a connection with the token stays"
    kept.close()


def test_of_too_many_strangers_the_oldest_go(server, monkeypatch):
    monkeypatch.setattr(module, "MAX_STRANGERS", 2)
    wires = []
    for _ in range(4):
        wires.append(socket.create_connection(("127.0.0.1", server.port)))
        time.sleep(1.2)  # seen by a sweep, one after the other
    try:
        open_still = []
        for wire in wires:
            wire.settimeout(0.2)
            try:
                open_still.append(wire.recv(1) != b"")
            except TimeoutError:
                open_still.append(True)
            except ConnectionError:
                open_still.append(False)
        assert open_still == [False, False, True, True]
    finally:
        for wire in wires:
            wire.close()


def test_a_port_that_is_taken(monkeypatch):
    monkeypatch.setattr(module, "EVERYWHERE", "127.0.0.1")
    first = Recorded()
    try:
        with pytest.raises(UserError, match=f"--port {first.port}: cannot listen"):
            Recorded(port=first.port, shared=True)
        second = Recorded(port=first.port)
        assert first.port < second.port <= first.port + module.PORTS_TRIED
        second.stop()
    finally:
        first.stop()
