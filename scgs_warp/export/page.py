"""A page that plays a moving scene in a browser, as one file without server or network; see docs/page.md."""

from __future__ import annotations

import base64
import functools
import hashlib
import html
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, urljoin

from ..errors import UserError
from ..scene.scene import Scene
from ..storage.files import write_atomically
from .page_data import pack
from .page_scene import PageMotion, page_scene
from .poster import CARD_SIZE, POSTER_SIZE, poster

SCRIPTS = ("loading", "data", "camera", "renderer", "player", "controls", "page")
POSE_SCRIPTS = ("rotations", "solver", "reach", "figure", "hand")
SHADERS = ("shared", "splat.frag", "draw.vert", "draw.frag", "screen.vert", "screen.frag")
MAX_DEGREE = 3
WEB = Path(__file__).parent / "web"
TITLE = "Moving scene"
MIB = 2**20
PART = 768 << 10
"""Bytes of data in one element, a multiple of 3. The page decodes one element while the browser reads the next."""


@dataclass(frozen=True)
class Card:
    """What other sites show of a link to the page."""

    description: str = "A moving scene in three dimensions: turn it, stop it, look from anywhere."
    url: str = ""
    """Address at which the page will be; with it, the card has a picture."""
    picture: str = "page.jpg"
    """Name of the picture's file, which will be in the same folder as the page."""

    def tags(self, title: str) -> str:
        """Return the elements of the page's head."""
        values = {"og:type": "website", "og:title": title, "og:description": self.description}
        if self.url:
            values |= {"og:url": self.url, "og:image": self.image, "twitter:card": "summary_large_image"}
        rows = [f'<meta property="{name}" content="{html.escape(value)}">' for name, value in values.items()]
        return "\n".join([f'<meta name="description" content="{html.escape(self.description)}">', *rows]) + "\n"

    @property
    def image(self) -> str:
        """Address of the card's picture."""
        return urljoin(self.url, quote(os.fsencode(self.picture)))


@dataclass(frozen=True)
class PageOptions:
    """What a page holds beside the scene."""

    title: str = ""
    """Text shown on the page."""
    max_mib: float | None = None
    """Largest size of the file in MiB. Colours lose their highest degrees of spherical harmonics, one by one, until it
    fits."""
    url: str = ""
    """Address at which the page will be published. A picture for links to it is then written beside the page, under the
    page's name with .jpg at the end, and must be published beside it."""
    motion: PageMotion | None = None
    """Motion that replaces the scene's, such as an edit's film or one with parts to pull."""
    captions: Sequence[Mapping[str, Any]] = ()
    """Cues with ``from`` and ``to`` in seconds, and ``text``."""
    picture: Callable[[int], bytes] | None = None
    """Returns a JPEG of the page's first view with the given longer side; None: of the scene at time 0."""


def write_page(scene: Scene, path: Path, options: PageOptions | None = None, **fields: Any) -> int:
    """Write one HTML file that plays ``scene``; an existing file is replaced once the new one is complete.

    Args:
        scene: scene with control points, or a static one.
        path: name that ends in .html or .htm; missing folders are made.
        options: what the page holds; ``fields`` of :class:`PageOptions` may be given instead.

    Returns:
        Number of Gaussians on the page, which holds the visible ones only.

    Raises:
        UserError: the name does not end in .html, the motion model has no control points, the page does not fit, or the
            file cannot be written.
    """
    path, options = Path(path), options or PageOptions(**fields)
    if path.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"{path}: end the name of a page in .html")
    if path.is_dir():
        raise UserError(f"{path}: is a folder; give the page another name")
    if options.url and card_path(path).is_dir():
        raise UserError(f"{card_path(path)}: is a folder, and the picture for links goes there; rename one of the two")
    if options.max_mib is not None and not options.max_mib > 0:
        raise UserError(f"--max-mib (max_mib) is {options.max_mib:g}; give a size in MiB above 0, or none")
    picture = options.picture or functools.partial(poster, scene)
    page, count = fitting_page(scene, path, options, picture)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{path.parent}: cannot be made ({error.strerror}); give another folder") from None
    card = picture(CARD_SIZE) if options.url else None
    write_atomically(path, page)
    if card is not None:
        write_atomically(card_path(path), card)
    return count


def card_path(page: Path) -> Path:
    """Return the path of the picture for links to a page."""
    return page.with_suffix(".jpg")


def fitting_page(scene: Scene, path: Path, options: PageOptions, picture: Callable[[int], bytes]) -> tuple[bytes, int]:
    """Return the page with the highest degree of spherical harmonics that fits, and its number of Gaussians.

    Args:
        path: its name, for messages.

    Raises:
        UserError: the motion model has no control points, or the page does not fit.
    """
    page, drawn, most = b"", b"", options.max_mib
    for degree in range(min(scene.gaussians.sh_degree, MAX_DEGREE), -1, -1):
        content = page_scene(scene, degree, motion_of=options.motion)
        drawn = drawn or picture(POSTER_SIZE)  # after the scene has been checked
        facts = {**content.facts, "captions": list(options.captions)}
        card = Card(url=options.url, picture=card_path(path).name)
        page = assemble(pack(facts, content.columns), options.title, drawn, card, "pose" in facts)
        if most is None or len(page) <= most * MIB:
            return page, content.facts["gaussians"]
    least = len(page) / MIB
    raise UserError(
        f"{path}: takes {least:.2f} MiB even with colours that do not depend on the view, more than the "
        f"{most:g} MiB of --max-mib (max_mib); allow that much, or train with a smaller --max-gaussians"
    )


def assemble(
    data: bytes, title: str = "", picture: bytes = b"", card: Card | None = None, posed: bool = False
) -> bytes:
    """Assemble the page from packed data, program and style, as UTF-8.

    Args:
        data: result of ``pack``.
        picture: JPEG that is shown while the page loads.
        card: what a link to the page shows; None: the title alone.
        posed: whether the page holds parts to pull.
    """
    parts = [base64.b64encode(data[i : i + PART]).decode("ascii") for i in range(0, len(data), PART)]
    scripts = "".join(f'<script class="data" type="text/plain">{part}</script>\n' for part in parts)
    names = (*SCRIPTS, *POSE_SCRIPTS, "main_posed") if posed else (*SCRIPTS, "main")
    count = f' data-parts="{len(parts)}"'
    return document(program_text(names), title, data=scripts, parts=count, picture=picture, card=card)


def document(
    program: str,
    title: str,
    *,
    data: str = "",
    parts: str = "",
    picture: bytes = b"",
    card: Card | None = None,
    network: str = "'none'",
    template: str | None = None,
    further_style: str = "",
) -> bytes:
    """Return a page's HTML around a program.

    Args:
        network: policy for its connections.
        template: HTML with the same places as ``index.html``, which it replaces.
        further_style: added to ``style.css``.
    """
    style = read_web("style.css") + further_style
    policy = (
        # No network access and no other script, whatever the title contains.
        f"default-src 'none'; script-src {_hash(program)} blob:; worker-src blob:; style-src {_hash(style)}; "
        f"img-src data: blob:; connect-src {network}; base-uri 'none'; form-action 'none'"
    )
    title = title.encode("utf-8", "replace").decode()  # file names may contain surrogates
    shown = " ".join(title.split()) or TITLE
    drawn = base64.b64encode(picture).decode("ascii")
    values = {
        "policy": policy,
        "card": (card or Card()).tags(shown),
        "title": html.escape(shown),
        "icon": quote(read_web("icon.svg")),
        "style": style,
        "poster": f'<img id="poster" alt="" src="data:image/jpeg;base64,{drawn}">\n' if picture else "",
        "parts": parts,
        "program": program,
        "data": data,
    }
    whole = read_web("index.html") if template is None else template
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match.group(1)], whole).encode()


def program_text(scripts: Sequence[str], further: Sequence[str] = (), shaders: Mapping[str, str] | None = None) -> str:
    """Return scripts of ``web/`` and further texts as one program, with the shaders, further ones by name, and the
    worker's source as strings."""
    texts_of_shaders = json.dumps({name: read_web(f"{name}.glsl") for name in SHADERS} | dict(shaders or {}))
    sort = read_web("sort.js")
    texts = [f"const SHADERS = {texts_of_shaders};", f"const SHARED = {json.dumps({'sort': sort})};", sort]
    texts += [*(read_web(f"{name}.js") for name in scripts), *further]
    program = '(() => {\n"use strict";\n' + "\n".join(texts) + "\n})();\n"
    if "</" in program or "<!--" in program:
        raise AssertionError("the program would end its own script element")
    return program


def read_web(name: str, folder: Path = WEB) -> str:
    """Return the text of a file of ``web/``, here or in another folder of the package."""
    return (folder / name).read_text(encoding="utf-8")  # newlines as \n, as the browser hashes them


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"
