"""Fingers on a page."""

from __future__ import annotations

from typing import Any


class Touch:
    """The fingers on a page whose context has touch."""

    def __init__(self, context: Any, page: Any) -> None:
        self._session = context.new_cdp_session(page)

    def at(self, kind: str, *places: tuple[float, float]) -> None:
        """Send ``touchStart``, ``touchMove`` or ``touchEnd`` with the places of all fingers that are down."""
        fingers = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(places)]
        self._session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})
