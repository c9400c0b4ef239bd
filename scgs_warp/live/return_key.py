"""Secret by which an open page finds its way back to a server that was started anew.

A server's token is new at each start, so that a cookie which has leaked opens nothing later. The page and the server
instead prove to each other that they know a secret, and neither sends it: whoever has taken the port meanwhile learns
nothing.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import stat
import time
from contextlib import suppress
from pathlib import Path

from ..storage.files import read_text
from ..storage.own_folder import own_folder

LIFE = 30 * 86400.0
"""Seconds after the last start within which a secret is used again."""
LENGTH = 64
"""Hexadecimal digits of a secret, and of each number that is drawn."""


def key_file(source: Path, port: int) -> Path:
    """Return where the secret of a run or file that is served on a port is kept."""
    return own_folder("pages", source) / f"{port}.key"


def kept_key(path: Path) -> str:
    """Return the secret of a file that only its owner can read; make another if there is none of the last ``LIFE``
    seconds. One that cannot be kept holds for this start alone."""
    key = _read(path)
    with suppress(OSError):
        if key is not None:
            os.utime(path)
            return key
        key = secrets.token_hex(LENGTH // 2)
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as file:
            file.write(key)
    return key or secrets.token_hex(LENGTH // 2)


def _read(path: Path) -> str | None:
    try:
        facts = path.lstat()
        private = os.name == "nt" or (facts.st_uid == os.getuid() and not facts.st_mode & 0o077)
        if not (private and stat.S_ISREG(facts.st_mode) and abs(time.time() - facts.st_mtime) < LIFE):
            return None
        key = read_text(path, LENGTH)
    except (OSError, UnicodeDecodeError):
        return None
    return key if is_number(key) else None


def is_number(text: str) -> bool:
    """Return whether a text is a secret or a number that was drawn."""
    return len(text) == LENGTH and set(text) <= set("0123456789abcdef")


class ReturnKey:
    """One start of a server, towards pages that know its secret.

    Args:
        key: the secret.
        port: port of the server. It is part of each proof, so that no server passes on what another one is asked.

    Attributes: ``start`` (a number that this start has drawn).
    """

    def __init__(self, key: str, port: int) -> None:
        self.key, self.port, self.start = key, port, secrets.token_hex(LENGTH // 2)

    def proof(self, of: str, drawn: str) -> str:
        """Return the proof of the ``server`` or of the ``page`` for a number that the page has drawn."""
        text = f"{of} {self.port} {drawn} {self.start}"
        return hmac.new(bytes.fromhex(self.key), text.encode(), hashlib.sha256).hexdigest()

    def knows(self, drawn: str, proof: str) -> bool:
        """Return whether a page that has drawn this number knows the secret."""
        given, right = proof.encode("utf-8", "replace"), self.proof("page", drawn).encode()
        return is_number(drawn) and hmac.compare_digest(given, right)
