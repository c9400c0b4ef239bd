"""The editor's page as HTML with its program, and what tells it from the pages of other scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..edit import EditSession
from ..edit.edit_file import scene_of
from ..export.page import SCRIPTS, document, program_text, read_web
from ..live.viewer import WIRE

WEB = Path(__file__).parent / "web"
OWN_SCRIPTS = (
    "connection",
    "overlay",
    "gizmo",
    "pivot",
    "areas",
    "scene_player",
    "tools",
    "pictures",
    "timeline",
    "panel",
    "parts",
    "commands",
    "studio",
)
"""Scripts of ``web/``, after those of the exported page."""
SHADERS = ("overlay.vert", "overlay.frag")


def held_by_pages(session: EditSession) -> dict[str, Any]:
    """Return what tells a session from others whose scene an open page does not hold."""
    scene = session.scene
    return {"scene": scene_of(session.engine), "step": scene.step, "gaussians": scene.gaussian_count}


def page_of(title: str) -> bytes:
    """Return the editor's page for a scene."""
    scripts = [WIRE, *(read_web(f"{name}.js", WEB) for name in OWN_SCRIPTS)]
    shaders = {name: read_web(f"{name}.glsl", WEB) for name in SHADERS}
    program = program_text((*SCRIPTS, "rotations"), scripts, shaders)
    template, style = read_web("editor.html", WEB), read_web("editor.css", WEB)
    return document(program, title, network="'self'", template=template, further_style=style)
