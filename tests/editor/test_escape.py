"""Escaping of untrusted text for the panel."""

from __future__ import annotations

import html

import pytest

from scgs_warp.editor.escape import plain


@pytest.mark.parametrize("text", ["arm 1", "<script>alert(1)</script>", "**bold** [a](javascript:x)", "&lt;", "a\nb|c"])
def test_text_has_no_syntax_and_stays_readable(text):
    shown = plain(text)
    assert html.unescape(shown) == text
    assert all(c.isalnum() or c in " &#;" for c in shown)
