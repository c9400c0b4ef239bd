"""Escaping of untrusted text for the panel, whose Markdown may contain raw HTML."""

from __future__ import annotations


def plain(text: str) -> str:
    """Escape a text for Markdown, by character references, which are never parsed as syntax.

    Names of handles may come from a stranger's edit, and the page would run a script in them.
    """
    return "".join(c if c.isalnum() or c == " " else f"&#{ord(c)};" for c in text)
