"""Access to the editor: token, origin and host, for pages and WebSockets."""

from __future__ import annotations

import http.client
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import EditSession
from scgs_warp.editor import Editor, Proxy
from scgs_warp.editor import proxy as proxy_module
from scgs_warp.editor.proxy import KEY_HEADER, MAX_PENDING, cookies, guarded, is_local, parse_head, same_origin
from scgs_warp.errors import UserError
from scgs_warp.formats.gaussian_ply import write_gaussian_ply

viser = pytest.importorskip("viser", reason="the package viser is not installed")
websockets = pytest.importorskip("websockets.sync.client")
exceptions = pytest.importorskip("websockets.exceptions")
PROTOCOL = f"viser-v{viser.__version__}"


@pytest.fixture(scope="module")
def session() -> EditSession:
    return EditSession(bar_scene())


@pytest.fixture
def editor(session, tmp_path) -> Iterator[Editor]:
    made = Editor(session, tmp_path, port=0)
    yield made
    made.stop()


@pytest.fixture
def shared(session, tmp_path) -> Iterator[Proxy]:
    key = "a key that only the proxy knows"
    made = Editor(session, tmp_path, port=0, key=key)
    proxy = Proxy(made.port, key, host="127.0.0.1")
    yield proxy
    proxy.stop()
    made.stop()


def get(port: int, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    response = connection.getresponse()
    response.text = response.read().decode("utf-8", "replace")  # type: ignore[attr-defined]
    connection.close()
    return response


def opens(port: int, origin: str | None, name: str = "127.0.0.1", **headers: str) -> bool:
    """Whether a WebSocket of this origin is accepted, and hears something."""
    try:
        more = {name.replace("_", "-"): value for name, value in headers.items()}
        wire = socket.create_connection(("127.0.0.1", port), 20)
        with websockets.connect(
            f"ws://{name}:{port}",
            sock=wire,
            origin=origin,
            additional_headers=more,
            subprotocols=[PROTOCOL],
            max_size=None,
        ) as page:
            return len(page.recv(timeout=20)) > 0
    except exceptions.InvalidStatus as error:
        assert error.response.status_code == 403
        return False


def test_the_editor_listens_on_this_machine_only(editor):
    assert editor.url == f"http://127.0.0.1:{editor.port}"
    with socket.socket() as other:
        other.bind(("127.0.0.2", editor.port))  # free: it does not listen everywhere


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost"])
def test_its_own_page_may_use_it(editor, name):
    host = f"{name}:{editor.port}"
    assert get(editor.port, Host=host).status == 200
    assert opens(editor.port, f"http://{host}", name)


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "http://127.0.0.1:1", "null", None, "https://127.0.0.1.evil"]
)
def test_foreign_pages_are_refused(editor, origin):
    assert not opens(editor.port, origin)


def test_a_foreign_name_for_this_machine_is_refused(editor):
    """DNS that turns evil.example into 127.0.0.1 makes origin and host agree."""
    host = f"evil.example:{editor.port}"
    assert get(editor.port, Host=host).status == 403
    with socket.create_connection(("127.0.0.1", editor.port), 20) as raw:
        lines = ["GET / HTTP/1.1", f"Host: {host}", f"Origin: http://{host}", "Upgrade: websocket"]
        lines += ["Connection: Upgrade", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Version: 13"]
        raw.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        assert b" 403 " in raw.recv(4096)


def test_without_the_token_nothing_is_served(shared):
    for path in ("/", "/index.html", "/?token=", "/?token=wrong", f"/?token={shared.token}x", "/?token=a&token=b"):
        assert get(shared.public, path).status == 403, path
    for cookie in ("", f"{shared.cookie}=wrong", "other=1", f"{shared.cookie}="):
        assert get(shared.public, Cookie=cookie).status == 403
    assert not opens(shared.public, f"http://127.0.0.1:{shared.public}")


def test_the_token_becomes_a_cookie_that_opens_everything(shared):
    first = get(shared.public, f"/?token={shared.token}")
    assert first.status == 303 and first.getheader("Location") == "/"
    cookie = first.getheader("Set-Cookie") or ""
    assert "HttpOnly" in cookie and "SameSite" in cookie
    page = get(shared.public, Cookie=cookie.partition(";")[0])
    assert page.status == 200 and "<html" in page.text.lower()  # type: ignore[attr-defined]
    assert opens(shared.public, f"http://127.0.0.1:{shared.public}", Cookie=cookie.partition(";")[0])


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "null", None])
def test_with_the_token_foreign_pages_are_refused(shared, origin):
    cookie = f"{shared.cookie}={shared.token}"
    assert not opens(shared.public, origin, Cookie=cookie)
    if origin is not None:
        assert get(shared.public, Cookie=cookie, Origin=origin).status == 403


def test_behind_a_proxy_the_editors_own_port_takes_nobody_else(shared):
    origin = f"http://127.0.0.1:{shared.port}"
    assert get(shared.port).status == 403
    assert not opens(shared.port, origin) and not opens(shared.port, origin, **{KEY_HEADER: "a guess"})
    assert not opens(
        shared.public, f"http://127.0.0.1:{shared.public}", **{KEY_HEADER: "a key that only the proxy knows"}
    )


@pytest.mark.parametrize(
    "text",
    [
        b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 3\r\n\r\nabc",
        b"GET / HTTP/1.1\r\nHost: a\r\nContent-Length: 3\r\n\r\nabc",
        b"GET / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n",
        b"GET http://elsewhere/ HTTP/1.1\r\nHost: a\r\n\r\n",
        b"GET / HTTP/1.0\r\nHost: a\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\n folded\r\n\r\n",
        b"GET / HTTP/1.1\r\nHo\x00st: a\r\n\r\n",
        b"nonsense\r\n\r\n",
        b"GET //[ HTTP/1.1\r\nHost: a\r\n\r\n",
        b"\r\n\r\n",
    ],
)
def test_what_no_page_sends_is_refused(shared, text):
    assert parse_head(text.partition(b"\r\n\r\n")[0] + b"\r\n\r\n") is None
    with socket.create_connection(("127.0.0.1", shared.public), 20) as raw:
        raw.sendall(text)
        assert raw.recv(4096).startswith(b"HTTP/1.1 400 ")


def test_odd_cookies_of_other_pages_hide_nothing(shared):
    for others in ('x={"a":1}; ', "a b=c; ", "=; ;; ", 'q="; ', "scgs_editor=old; scgs_editor_1=another; "):
        assert get(shared.public, Cookie=f"{others}{shared.cookie}={shared.token}").status == 200, others
        assert get(shared.public, Cookie=f"{others}{shared.cookie}=wrong").status == 403, others
    assert cookies("a=1;b = 2; c") == {"a": "1", "b ": " 2", "c": ""}


def test_two_shared_editors_on_one_host_have_cookies_of_their_own(shared):
    other = Proxy(1, "key", host="127.0.0.1")
    try:
        assert other.cookie != shared.cookie and other.cookie.endswith(str(other.public))
        both = f"{other.cookie}={other.token}; {shared.cookie}={shared.token}"
        assert get(shared.public, Cookie=both).status == 200
    finally:
        other.stop()


@pytest.mark.parametrize("origin", ["http://[", "http://]", "http://[::1", "//[x"])
def test_origins_that_are_no_address_are_refused(editor, shared, origin, capfd):
    assert get(shared.public, Cookie=f"{shared.cookie}={shared.token}", Origin=origin).status == 403
    assert get(editor.port, Origin=origin).status == 403
    assert "Traceback" not in capfd.readouterr().err and not same_origin(origin, "[")


def test_strangers_are_not_waited_for_without_end(shared):
    page = f"{shared.cookie}={shared.token}"
    waiting = [socket.create_connection(("127.0.0.1", shared.public), 20) for _ in range(MAX_PENDING)]
    try:
        with socket.create_connection(("127.0.0.1", shared.public), 20) as one_more:
            one_more.settimeout(5)
            assert one_more.recv(1) == b""
    finally:
        for one in waiting:
            one.close()
    until = time.monotonic() + 20
    while True:
        try:
            assert get(shared.public, Cookie=page).status == 200
            return
        except (http.client.HTTPException, OSError):
            assert time.monotonic() < until
            time.sleep(0.1)


def test_two_hosts_or_origins_are_none():
    head = parse_head(b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\nOrigin: http://a\r\n\r\n")
    assert head is not None and head.get("host") == ""
    assert not same_origin(head.get("origin"), head.get("host"))


def test_a_second_request_on_one_connection_is_not_passed_on(shared):
    cookie = f"Cookie: {shared.cookie}={shared.token}"
    one = f"GET /missing HTTP/1.1\r\nHost: a\r\n{cookie}\r\n\r\n"
    with socket.create_connection(("127.0.0.1", shared.public), 20) as raw:
        raw.sendall((one + one.replace(cookie, "Cookie: none=1")).encode())
        heard = b""
        while chunk := raw.recv(65536):
            heard += chunk
    assert heard.count(b"HTTP/1.1 404") == 1 and heard.count(b"HTTP/1.1") == 1


def test_hosts_and_origins():
    assert same_origin("http://a:1", "a:1") and same_origin("https://A", "a")
    assert not same_origin("http://a:1", "a:2") and not same_origin("file://a", "a") and not same_origin("null", "null")
    assert is_local("127.0.0.1:80") and is_local("localhost") and is_local("[::1]:5")
    assert not is_local("127.0.0.1.evil:80") and not is_local("evil") and not is_local(None) and not is_local("[")


def test_a_server_that_cannot_be_guarded_is_refused():
    with pytest.raises(UserError, match="cannot guard"), guarded(None):
        pass


def test_a_port_that_is_taken(shared):
    with pytest.raises(UserError, match=f"--port {shared.public}"):
        Proxy(1, "key", "127.0.0.1", shared.public)


@pytest.mark.parametrize("share", [False, True])
def test_the_app_serves_until_it_is_interrupted(tmp_path, share):
    ply = tmp_path / "scene.ply"
    write_gaussian_ply(ply, bar_scene().gaussians_at(0.0))
    command = [sys.executable, "-m", "scgs_warp.apps.edit", "--ply", str(ply), "--nodes", "40", "--port", "0"]
    process = subprocess.Popen(
        [*command, *(["--share"] if share else [])], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        said = re.search(r"http://127\.0\.0\.1:(\d+)/?(\S*)", process.stdout.readline())
        assert said is not None and ("token=" in said[2]) == share
        port = int(said[1])
        assert get(port, "/").status == (403 if share else 200)
        assert get(port, f"/{said[2]}").status == (303 if share else 200)
        process.send_signal(signal.SIGINT)
        assert "has ended" in process.communicate(timeout=60)[0] and process.returncode == 0
    finally:
        process.kill()
        process.wait()


def test_a_request_that_is_never_finished_ends(shared, monkeypatch):
    """A client that sends a head byte by byte would hold its connection for ever."""
    monkeypatch.setattr(proxy_module, "PATIENCE", 0.3)
    with socket.create_connection(("127.0.0.1", shared.public), 20) as slow:
        slow.sendall(b"GET / HTTP/1.1\r\nHost: a\r\n")
        slow.settimeout(20)
        assert slow.recv(1) == b""


@pytest.mark.parametrize(
    "message", ["text", b"", b"\xff\xff", b"\x81\xa4type\xa4Nope", b"\x93\x01\x02\x03", b"\xc1" * 9]
)
def test_a_malformed_message_closes_its_connection_alone(editor, message, capfd):
    """What a page sends is no reason for a traceback, and does not disturb other pages."""
    origin = f"http://127.0.0.1:{editor.port}"
    with websockets.connect(
        f"ws://127.0.0.1:{editor.port}", origin=origin, subprotocols=[PROTOCOL], max_size=None
    ) as page:
        page.send(message)
        with pytest.raises(exceptions.ConnectionClosed) as closed:
            while True:
                page.recv(timeout=20)
    assert closed.value.rcvd.code == 1007
    assert opens(editor.port, origin)
    said = capfd.readouterr()
    assert "Traceback" not in said.err + said.out and "Error" not in said.err + said.out
