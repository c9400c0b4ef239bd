"""A page that plays a moving scene in a browser, as one file without server or network; see docs/page.md."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from pathlib import Path

from ..errors import UserError
from ..scene.scene import Scene
from ..storage.files import write_atomically
from .page_data import pack
from .page_scene import page_scene

SCRIPTS = ("data", "camera", "renderer", "player", "controls", "main")
SHADERS = ("shared", "splat.frag", "draw.vert", "draw.frag", "screen.vert", "screen.frag")
MAX_DEGREE = 3
WEB = Path(__file__).parent / "web"
TITLE = "Moving scene"
MIB = 2**20


def write_page(scene: Scene, path: Path, *, title: str = "", max_mib: float | None = None) -> int:
    """Write one HTML file that plays ``scene``; an existing file is replaced once the new one is complete.

    Args:
        scene: scene with control points, or a static one.
        path: name that ends in .html or .htm; missing folders are made.
        title: text shown on the page.
        max_mib: largest size of the file in MiB. Colours lose their highest degrees of spherical harmonics, one by one,
            until it fits.

    Returns:
        Number of Gaussians on the page, which holds the visible ones only.

    Raises:
        UserError: the name does not end in .html, the motion model has no control points, the page does not fit, or the
            file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"{path}: end the name of a page in .html")
    if path.is_dir():
        raise UserError(f"{path}: is a folder; give the page another name")
    if max_mib is not None and not max_mib > 0:
        raise UserError(f"--max-mib (max_mib) is {max_mib:g}; give a size in MiB above 0, or none")
    page, count = _fitting(scene, path, title, max_mib)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{path.parent}: cannot be made ({error.strerror}); give another folder") from None
    write_atomically(path, page)
    return count


def _fitting(scene: Scene, path: Path, title: str, max_mib: float | None) -> tuple[bytes, int]:
    """Return the page with the highest degree of spherical harmonics that fits, and its number of Gaussians."""
    page = b""
    for degree in range(min(scene.gaussians.sh_degree, MAX_DEGREE), -1, -1):
        content = page_scene(scene, degree)
        page = assemble(pack(content.facts, content.columns), title)
        if max_mib is None or len(page) <= max_mib * MIB:
            return page, content.facts["gaussians"]
    least = len(page) / MIB
    raise UserError(
        f"{path}: takes {least:.2f} MiB even with colours that do not depend on the view, more than the "
        f"{max_mib:g} MiB of --max-mib (max_mib); allow that much, or train with a smaller --max-gaussians"
    )


def assemble(data: bytes, title: str = "") -> bytes:
    """Assemble the page from packed data, program and style, as UTF-8."""
    program, style = program_text(), _read("style.css")
    policy = (
        # No network access and no other script, whatever the title contains.
        f"default-src 'none'; script-src {_hash(program)} blob:; worker-src blob:; style-src {_hash(style)}; "
        "base-uri 'none'; form-action 'none'"
    )
    title = title.encode("utf-8", "replace").decode()  # file names may contain surrogates
    parts = {
        "policy": policy,
        "title": html.escape(" ".join(title.split()) or TITLE),
        "style": style,
        "data": base64.b64encode(data).decode("ascii"),
        "program": program,
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match.group(1)], _read("index.html")).encode()


def program_text() -> str:
    """Return all scripts as one program, with the shaders and the worker's source as strings."""
    shaders = json.dumps({name: _read(f"{name}.glsl") for name in SHADERS})
    sort = _read("sort.js")
    texts = [f"const SHADERS = {shaders};", f"const SHARED = {json.dumps({'sort': sort})};", sort]
    texts += [_read(f"{name}.js") for name in SCRIPTS]
    program = '(() => {\n"use strict";\n' + "\n".join(texts) + "\n})();\n"
    if "</" in program or "<!--" in program:
        raise AssertionError("the program would end its own script element")
    return program


def _read(name: str) -> str:
    return (WEB / name).read_text(encoding="utf-8")  # newlines as \n, as the browser hashes them


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"
