"""Access control of a local server: who may send a request. No network here; ``server`` asks for every request."""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Mapping, Sequence
from typing import NamedTuple
from urllib.parse import urlsplit

LOCAL_HOSTS = {"127.0.0.1", "localhost", "::1"}
COOKIE = "scgs_"
"""Prefix of the cookie's name. The port follows, because cookies belong to hosts and a host may run several servers."""
ELSEWHERE = "a page from elsewhere may not use this server"
NO_TOKEN = "open the address that the program printed, token and all"


class Request(NamedTuple):
    """Part of a request on which access depends."""

    hosts: Sequence[str]
    """Values of the Host header, one if the request is sound."""
    origins: Sequence[str]
    upgrades: bool
    """True if the request asks for a WebSocket."""
    tokens: Sequence[str]
    """Values of ``token`` in the address."""
    cookies: Mapping[str, str]


def same_origin(origin: str, host: str) -> bool:
    """Return whether a page of this origin came from the host that it sends a request to."""
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and bool(host) and parts.netloc.lower() == host.lower()


def cookies(header: str) -> dict[str, str]:
    """Parse a Cookie header. Malformed cookies, which other pages of the host may set, do not hide the others."""
    pairs = (part.strip().partition("=") for part in header.split(";"))
    return {name: value for name, _, value in pairs}


def is_local(host: str) -> bool:
    """Return whether a Host header names this machine; a foreign name that resolves to 127.0.0.1 does not."""
    try:
        return urlsplit(f"//{host}").hostname in LOCAL_HOSTS
    except ValueError:
        return False


class Access:
    """Rules of one server.

    Args:
        port: port of the server, part of the cookie's name.
        shared: whether other machines may use the server, so that its name may be any.

    Attributes: ``token`` (secret of the printed address), ``cookie`` (name of the cookie that holds it).
    """

    def __init__(self, port: int, shared: bool) -> None:
        self.shared = shared
        self.token = secrets.token_urlsafe(24)
        self.cookie = f"{COOKIE}{port}"

    def foreign(self, request: Request) -> str | None:
        """Return why a request cannot be one of this server's pages, whatever its token; None: it can.

        The name of the host keeps out pages that turn a name of their own into this machine's address (DNS rebinding),
        the origin all other pages: a browser sends the cookie for them, too.
        """
        if len(request.hosts) != 1 or len(request.origins) > 1:
            return "not a request of this page"
        if not self.shared and not is_local(request.hosts[0]):
            return "this server answers to 127.0.0.1 and localhost only"
        origin = request.origins[0] if request.origins else None
        if (request.upgrades or origin is not None) and not same_origin(origin or "", request.hosts[0]):
            return ELSEWHERE
        return None

    def refusal(self, request: Request) -> str | None:
        """Return the reason to refuse a request; None accepts it. The token keeps out other users and machines."""
        foreign = self.foreign(request)
        if foreign is not None:
            return foreign
        given = request.tokens if request.tokens else [request.cookies.get(self.cookie, "")]
        if len(given) != 1 or not hmac.compare_digest(given[0].encode("utf-8", "replace"), self.token.encode()):
            return NO_TOKEN
        return None
