"""The editor in the browser: a page that draws the scene itself, and a server that poses its control points."""

from __future__ import annotations

from .app import Editor

__all__ = ["Editor"]
