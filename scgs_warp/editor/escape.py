"""Text that users and files made up, for the panel, which takes Markdown with raw HTML in it."""

from __future__ import annotations


def plain(text: str) -> str:
    """Markdown that shows just this text: the name of a handle may come from a stranger's edit, and the page would run
    a script that stood in it. A character reference is a letter and never syntax."""
    return "".join(c if c.isalnum() or c == " " else f"&#{ord(c)};" for c in text)
