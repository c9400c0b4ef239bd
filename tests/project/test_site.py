"""The documentation builds without a warning; commands, options and public names in it exist."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlparse

import pytest

import scgs_warp
from helpers.chromium import chromium
from helpers.paths import ROOT


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, built strictly: a broken link, a page in no menu, a docstring that does not parse are errors."""
    for module in ("mkdocs", "material", "mkdocstrings_handlers.python"):
        pytest.importorskip(module, reason=f'{module} is not installed: pip install -e ".[docs]"')
    output = tmp_path_factory.mktemp("site") / "html"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(output)]
    # the theme advertises its successor in a banner that is no warning about the site
    environ = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environ, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "WARNING" not in done.stderr, done.stderr[-3000:]
    return output


class References(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value for name, value in attrs if name in ("href", "src") and value]


def test_every_page_image_and_script_is_there(site):
    """Check links in raw HTML and the theme, too; nothing is loaded from another server."""
    pages = sorted(site.rglob("index.html"))
    assert len(pages) >= 12
    checked = 0
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert not re.search(r"<(?:script|img)[^>]*src=\"?https?:", text), f"{page} fetches from elsewhere"
        for reference in References(text).found:
            url = urlparse(reference)
            if url.scheme or url.netloc or not url.path or url.path.startswith("/"):
                continue
            target = (page.parent / unquote(url.path)).resolve()
            target = target / "index.html" if target.is_dir() else target
            assert target.is_file(), f"{page.relative_to(site)}: {reference}"
            checked += 1
    assert checked > 200


def test_the_readme_is_the_first_page(site):
    text = (site / "index.html").read_text(encoding="utf-8")
    pictures = [name for name in References(text).found if name.startswith("images/")]
    assert "images/edit-jumpingjacks.png" in pictures
    assert "docs/" not in " ".join(References(text).found), "a link of the README leads out of the site"


def test_the_first_page_opens_with_a_scene_to_pull(site):
    with chromium() as browser:
        page = browser.new_page()
        page.goto((site / "index.html").as_uri())
        frame = next(one for one in page.frames if one.url.endswith("live/figure.html"))
        parts = frame.evaluate(
            "window.scgs.ready.then(({ player }) => player.figure.owner && player.model.facts.parts)"
        )
        assert len(parts) >= 10, "each can be pulled"
        top = page.locator("iframe").bounding_box()["y"]
        assert top < page.viewport_size["height"], "it is seen without scrolling"


def test_every_public_name_is_in_the_api(site):
    text = (site / "api/index.html").read_text(encoding="utf-8")
    found = {match.rsplit(".", 1)[-1] for match in re.findall(r'id="(scgs_warp[\w.]*)"', text)}
    assert set(scgs_warp.__all__) - {"__version__"} <= found
    assert {"EditSession", "load", "UserError", "TrainConfig", "look_at", "film"} <= found
    assert not re.search(r":(class|func|meth):", text), "markup that is not rendered"


def test_every_example_is_on_its_page(site):
    text = (site / "examples/index.html").read_text(encoding="utf-8")
    for script in (ROOT / "examples").glob("*.py"):
        assert f"examples/{script.name}</code>" in text


def test_pages_name_only_programs_that_exist():
    """``scgs-warp NAME`` and ``apps/NAME.py`` in the guide, and every option it gives them."""
    text = (ROOT / "docs/getting-started.md").read_text(encoding="utf-8")
    used = re.findall(r"scgs-warp (\w+)([^\n`|]*)", text)
    assert len(used) >= 8
    for name, rest in used:
        source = (ROOT / "apps" / f"{name}.py").read_text(encoding="utf-8")
        elsewhere = {"train": "apps/settings.py", "export": "scgs_warp/export/request.py"}
        source += (ROOT / elsewhere[name]).read_text(encoding="utf-8") if name in elsewhere else ""
        for option in re.findall(r"--([\w-]+)", rest.split("#")[0]):
            field = option.replace("-", "_")
            assert re.search(rf"^    {field}:", source, re.MULTILINE), f"{name}.py has no --{option}"


@pytest.mark.parametrize("name", sorted(set(scgs_warp.__all__) - {"__version__"}))
def test_public_names_say_what_they_are(name):
    public = getattr(scgs_warp, name)
    assert inspect.getdoc(public)
    if inspect.isfunction(public):
        methods = {name: public}
    else:
        methods = {key: value for key, value in vars(public).items() if not key.startswith("_")}
        methods = {key: getattr(value, "__func__", getattr(value, "fget", value)) for key, value in methods.items()}
        methods = {key: value for key, value in methods.items() if inspect.isfunction(value)}
    for key, function in methods.items():
        if name == "Scene" and key in ("tensors", "metadata", "freeze_binding", "frame_graph"):
            continue  # for the trainer
        assert inspect.getdoc(function), f"{name}.{key} has no docstring"
    if dataclasses.is_dataclass(public):
        source = inspect.getsource(public)
        for field in dataclasses.fields(public):
            said = re.search(rf'^    {field.name}: .*\n    """', source, re.MULTILINE)
            assert said, f"{name}.{field.name}: of what shape?"
