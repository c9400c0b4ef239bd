"""The editor in the browser: viser serves the page, and the package's own renderer draws the scene on it."""

from __future__ import annotations

from .app import Editor
from .proxy import Proxy

__all__ = ["Editor", "Proxy"]
