"""A scene in a notebook: its page in a frame."""

from __future__ import annotations

import functools
import html
from pathlib import Path

from ..errors import UserError
from ..scene.scene import Scene
from .page import PageOptions, fitting_page
from .poster import poster

MOST_MIB = 12.0
"""Largest size of a page in MiB. A notebook keeps all that it shows."""
HEIGHT = 480


def framed_page(scene: Scene) -> str | None:
    """Return an element that plays a scene; None if its page is too large, or its motion has no control points."""
    name = scene.folder.name if scene.folder is not None else "scene"
    options = PageOptions(name, max_mib=MOST_MIB)
    try:
        page, _ = fitting_page(scene, Path(f"{name}.html"), options, functools.partial(poster, scene))
    except UserError:
        return None
    return (
        f'<iframe title="{html.escape(name)}" srcdoc="{html.escape(page.decode())}" allow="fullscreen" '
        f'style="width: 100%; height: {HEIGHT}px; border: 0"></iframe>'
    )
