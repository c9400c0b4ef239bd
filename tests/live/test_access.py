"""Rules of access, without a network."""

from __future__ import annotations

import pytest

from scgs_warp.live.access import ELSEWHERE, NO_TOKEN, Access, Request, cookies, is_local, same_origin

HOST = "127.0.0.1:8080"


def ask(access: Access, **changes) -> str | None:
    fields = {"hosts": [HOST], "origins": [], "upgrades": False, "tokens": [], "cookies": {}}
    return access.refusal(Request(**{**fields, "cookies": {access.cookie: access.token}, **changes}))


@pytest.mark.parametrize("shared", [False, True])
def test_the_token_opens_by_address_or_cookie(shared):
    access = Access(8080, shared)
    assert ask(access) is None and ask(access, cookies={}, tokens=[access.token]) is None
    assert ask(access, upgrades=True, origins=[f"http://{HOST}"]) is None
    for given in ("", "wrong", access.token + "x", access.token[:-1], "\udce9"):
        assert ask(access, cookies={access.cookie: given}) == NO_TOKEN
        assert ask(access, tokens=[given]) == NO_TOKEN, "the address counts, if it has a token"
    assert ask(access, tokens=[access.token, access.token]) == NO_TOKEN
    assert ask(access, cookies={"scgs_1": access.token}) == NO_TOKEN


def test_every_server_has_secrets_of_its_own():
    assert Access(1, False).token != Access(1, False).token and Access(1, False).cookie != Access(2, False).cookie


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "null", "file://", "http://[", "//[x"])
def test_foreign_pages_are_refused_even_with_the_token(origin):
    for shared in (False, True):
        access = Access(8080, shared)
        assert ask(access, origins=[origin]) == ELSEWHERE and ask(access, upgrades=True, origins=[origin]) == ELSEWHERE
        assert ask(access, upgrades=True) == ELSEWHERE, "browsers send the origin of every WebSocket"


def test_a_foreign_name_for_this_machine_is_refused():
    """DNS that turns evil.example into 127.0.0.1 makes origin and host agree."""
    attack = {"hosts": ["evil.example:8080"], "origins": ["http://evil.example:8080"], "upgrades": True}
    assert "127.0.0.1" in (ask(Access(8080, False), **attack) or "")
    assert ask(Access(8080, True), **attack) is None, "a shared server has any name, and the cookie is of its host"
    for hosts in ([], [HOST, HOST]):
        assert ask(Access(8080, True), hosts=hosts) is not None
    assert ask(Access(8080, True), origins=[f"http://{HOST}"] * 2) is not None


def test_hosts_origins_and_cookies():
    assert same_origin("http://a:1", "a:1") and same_origin("https://A", "a")
    assert not same_origin("http://a:1", "a:2") and not same_origin("file://a", "a") and not same_origin("http://", "")
    assert is_local("127.0.0.1:80") and is_local("localhost") and is_local("[::1]:5")
    assert not is_local("127.0.0.1.evil:80") and not is_local("evil") and not is_local("") and not is_local("[")
    assert cookies("a=1;b = 2; c") == {"a": "1", "b ": " 2", "c": ""}
