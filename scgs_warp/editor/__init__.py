"""The editor in the browser: an ``EditSession`` on a page that viser serves, seen through our own renderer."""

from __future__ import annotations

from .app import Editor
from .proxy import Proxy

__all__ = ["Editor", "Proxy"]
