"""How an open page finds its way back to a server that was started anew, and what keeps others out."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from helpers.free_ports import free_port
from helpers.web_clients import get, key, talk
from scgs_warp.live import server as module
from scgs_warp.live.return_key import LIFE, ReturnKey, kept_key, key_file
from scgs_warp.live.server import PageServer

DRAWN = "0123456789abcdef" * 4


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def port(monkeypatch) -> int:
    monkeypatch.setattr(module, "EVERYWHERE", "127.0.0.1")
    return free_port()


@pytest.fixture
def server(port, tmp_path) -> Iterator[PageServer]:
    pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")
    made = PageServer({}, port=port, page="one", source=tmp_path / "run")
    yield made
    made.stop()


def greeting(server: PageServer) -> dict[str, Any]:
    return talk(server, lambda wire: wire.receive_json())["server"]


def ask(server: PageServer, **query: str) -> Any:
    return get(server.port, "/return?" + "&".join(f"{name}={value}" for name, value in query.items()))


def test_the_key_is_kept_for_its_owner_alone(tmp_path, home):
    path = key_file(tmp_path / "run", 8080)
    assert path.is_relative_to(home) and path != key_file(tmp_path / "run", 8081) != key_file(tmp_path / "other", 8081)
    first = kept_key(path)
    assert kept_key(path) == first and path.read_text() == first
    if sys.platform != "win32":
        assert path.stat().st_mode & 0o777 == 0o600 and path.parent.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("spoil", ["old", "text", "long", "readable", "link"])
def test_a_key_that_is_not_to_be_trusted_is_replaced(tmp_path, spoil):
    if sys.platform == "win32" and spoil in ("readable", "link"):
        pytest.skip("permissions of POSIX")
    path = key_file(tmp_path / "run", 8080)
    first = kept_key(path)
    if spoil == "old":
        os.utime(path, (1e9, path.stat().st_mtime - LIFE - 10))
    elif spoil == "readable":
        path.chmod(0o644)
    elif spoil == "link":
        path.rename(tmp_path / "elsewhere")
        path.symlink_to(tmp_path / "elsewhere")
    else:
        path.write_text("x" * 64 if spoil == "text" else first + "00")
    second = kept_key(path)
    assert second != first and kept_key(path) == second


def test_a_key_that_cannot_be_kept_holds_for_one_start(tmp_path, home):
    home.write_text("a file is in the way")
    path = key_file(tmp_path / "run", 8080)
    assert len(kept_key(path)) == 64 and kept_key(path) != kept_key(path)


def test_a_proof_is_for_one_side_one_port_and_one_start():
    secret, other = DRAWN, DRAWN[::-1]
    one = ReturnKey(secret, 8080)
    assert one.knows(DRAWN, one.proof("page", DRAWN))
    for proof in (one.proof("server", DRAWN), one.proof("page", other), "", "\udce9"):
        assert not one.knows(DRAWN, proof)
    assert not one.knows(DRAWN, ReturnKey(secret, 8080).proof("page", DRAWN)), "another start"
    for stranger in (ReturnKey(secret, 8081), ReturnKey(other, 8080)):
        stranger.start = one.start
        assert not one.knows(DRAWN, stranger.proof("page", DRAWN))
    assert not one.knows("short", one.proof("page", "short"))


def test_a_page_of_an_earlier_start_gets_the_token(server, tmp_path, port):
    back = greeting(server)["back"]
    server.stop()
    again = PageServer({}, port=port, page="one", source=tmp_path / "run")
    try:
        assert again.access.token != server.access.token and get(port, Cookie=key(server)).status == 403
        said = json.loads(ask(again, drawn=DRAWN).text)
        known = ReturnKey(back["key"], back["port"])
        known.start = said["start"]
        assert said["proof"] == known.proof("server", DRAWN)
        cookie = ask(again, drawn=DRAWN, proof=known.proof("page", DRAWN)).getheader("Set-Cookie") or ""
        assert cookie.startswith(key(again) + ";") and "HttpOnly" in cookie and "SameSite=Lax" in cookie
        for proof in (said["proof"], "0" * 64, ""):
            refused = ask(again, drawn=DRAWN, proof=proof)
            assert refused.status == 403 and refused.getheader("Set-Cookie") is None
        for drawn in ("", "x", DRAWN + "0"):
            assert ask(again, drawn=drawn).status == 404
    finally:
        again.stop()


def test_foreign_pages_may_not_even_ask(server):
    for header in ({"Origin": "http://evil.example"}, {"Host": "evil.example"}):
        assert get(server.port, f"/return?drawn={DRAWN}", **header).status == 403


def test_other_runs_other_machines_and_any_port_have_no_way_back(server, tmp_path, port):
    first = greeting(server)
    server.stop()
    for served, same in ({"source": tmp_path / "other"}, False), ({"source": tmp_path / "run"}, True):
        made = PageServer({}, port=port, page="two", **served)
        assert (greeting(made)["back"]["key"] == first["back"]["key"]) is same and greeting(made)["page"] == "two"
        made.stop()
    for served in {"source": tmp_path / "run", "shared": True}, {"source": tmp_path / "run", "port": 0}, {}:
        made = PageServer({}, **{"port": port, "page": "two", **served})
        assert greeting(made)["back"] is None and ask(made, drawn=DRAWN).status == 404
        made.stop()
