"""The page as a file: what its data say of the scene, what it costs, and that no text can become a program."""

from __future__ import annotations

import base64
import hashlib
import io
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
import torch
from PIL import Image

from helpers.edit_scenes import bar_scene, rich_scene, tinted_scene
from helpers.page_reader import PagePlayer, read_page
from scgs_warp.errors import UserError
from scgs_warp.export import page
from scgs_warp.export.poster import poster
from scgs_warp.geometry.cameras import orbit_camera


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(-10 * torch.log10(((a.clamp(0, 1) - b.clamp(0, 1)) ** 2).mean()))


@pytest.mark.parametrize("make", [bar_scene, rich_scene, tinted_scene])
def test_what_a_page_holds_renders_as_the_scene(make, tmp_path):
    scene = make()
    page.write_page(scene, tmp_path / "page.html")
    facts, columns = read_page(tmp_path / "page.html")
    player = PagePlayer(scene, facts, columns)
    assert facts["gaussians"] == scene.gaussian_count
    for time in (0.0, 0.41, 1.0):
        camera = orbit_camera(scene.overview, 70.0 + 200 * time, 96)
        assert psnr(player.render(camera, time).rgb, scene.render(camera, time, (0, 0, 0)).rgb) > 50


class Parts(HTMLParser):
    """Elements' texts, by name, as a browser reads them."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.found: list[tuple[str, dict, str]] = []
        self.open: list[int] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs), ""))
        if tag not in ("meta", "input", "br", "path", "link", "img"):
            self.open.append(len(self.found) - 1)

    def handle_endtag(self, tag):
        while self.open and self.found[self.open.pop()][0] != tag:
            pass

    def handle_data(self, data):
        if self.open:
            tag, attrs, text = self.found[self.open[-1]]
            self.found[self.open[-1]] = tag, attrs, text + data

    def texts(self, tag: str) -> list[str]:
        return [text for name, _, text in self.found if name == tag]


@pytest.mark.parametrize(
    "title", ["</title><script>alert(1)</script>", "{{program}} \"'&<b>", "ein Tänzer\nim Saal", "caf\udce9"]
)
def test_a_title_is_text(title, tmp_path):
    page.write_page(bar_scene(nodes=12, gaussians=20), tmp_path / "page.html", title=title)
    parts = Parts(tmp_path / "page.html")
    shown = title.replace("\n", " ").replace("\udce9", "?")  # a name that is no UTF-8
    assert parts.texts("title") == [shown] and parts.texts("h1") == [shown]
    assert len(parts.texts("script")) == 2 and not parts.texts("b")


def test_only_its_own_program_may_run(tmp_path):
    page.write_page(bar_scene(nodes=12, gaussians=20), tmp_path / "page.html")
    parts = Parts(tmp_path / "page.html")
    policy = next(attrs["content"] for tag, attrs, _ in parts.found if tag == "meta" and "http-equiv" in attrs)
    for text in (parts.texts("script")[0], parts.texts("style")[0]):
        assert base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() in policy
    assert "default-src 'none'" in policy and "unsafe" not in policy


def test_the_program_is_small_and_the_same_scene_gives_the_same_page(tmp_path):
    scene = bar_scene(nodes=12, gaussians=20)
    for name in ("a", "b"):
        page.write_page(scene, tmp_path / f"{name}.html")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert len(page.assemble(b"")) < 84 * 1024
    program = page.program_text((*page.SCRIPTS, "main"))
    assert "http://" not in program and "https://" not in program


def test_a_page_gives_up_degrees_until_it_fits_and_refuses_otherwise(tmp_path):
    scene = bar_scene(gaussians=3000)
    path = tmp_path / "page.html"
    page.write_page(scene, path)
    full = path.stat().st_size
    page.write_page(scene, path, max_mib=0.8 * full / page.MIB)
    smaller = path.read_bytes()
    assert len(smaller) <= 0.8 * full
    assert 0 < read_page(path)[0]["sh_degree"] < 3
    with pytest.raises(UserError, match=r"takes 0\.\d+ MiB even .* 0\.01 MiB of --max-mib"):
        page.write_page(scene, path, max_mib=0.01)
    assert path.read_bytes() == smaller and [p.name for p in tmp_path.iterdir()] == ["page.html"]
    with pytest.raises(UserError, match="above 0"):
        page.write_page(scene, path, max_mib=0)


def test_bad_places_are_refused(tmp_path):
    scene = bar_scene(nodes=12, gaussians=20)
    with pytest.raises(UserError, match=r"in \.html"):
        page.write_page(scene, tmp_path / "page.txt")
    (tmp_path / "folder.html").mkdir()
    with pytest.raises(UserError, match="is a folder"):
        page.write_page(scene, tmp_path / "folder.html")
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be made"):
        page.write_page(scene, tmp_path / "file" / "page.html")
    assert page.write_page(scene, tmp_path / "new" / "page.HTM") == 20
    assert (tmp_path / "new" / "page.HTM").is_file()


def test_a_link_to_a_published_page_has_a_picture(tmp_path):
    scene = bar_scene(gaussians=300)
    page.write_page(scene, tmp_path / "page.html", title="A & B", url='https://example.org/a"b/page.html')
    parts = Parts(tmp_path / "page.html")
    card = {attrs["property"]: attrs["content"] for tag, attrs, _ in parts.found if "property" in attrs}
    assert card["og:image"] == 'https://example.org/a"b/page.jpg' and card["og:title"] == "A & B"
    page.write_page(scene, tmp_path / "my page é.html", url="https://example.org/scenes/index.html?of=a/b")
    found = [attrs for _, attrs, _ in Parts(tmp_path / "my page é.html").found if attrs.get("property") == "og:image"]
    address = found[0]["content"]
    assert address.startswith("https://example.org/scenes/my%20page") and address.isascii()
    assert (tmp_path / unquote(address.rsplit("/", 1)[1])).is_file()
    with Image.open(tmp_path / "page.jpg") as picture, Image.open(io.BytesIO(poster(scene))) as small:
        assert max(picture.size) == 1200 and max(small.size) == 480
        assert np.asarray(small).max() > 50, "there is something to see"
    page.write_page(scene, tmp_path / "other.html")
    assert not any("og:image" in attrs.values() for _, attrs, _ in Parts(tmp_path / "other.html").found)
    assert not (tmp_path / "other.jpg").exists()


def test_no_picture_is_written_for_a_page_that_fails(tmp_path, monkeypatch):
    scene = bar_scene(nodes=8, gaussians=20)
    (tmp_path / "a.jpg").mkdir()
    with pytest.raises(UserError, match=r"a\.jpg: is a folder, and the picture for links goes there"):
        page.write_page(scene, tmp_path / "a.html", url="https://example.org/a.html")
    plain = page.write_atomically

    def full(path: Path, content: bytes) -> None:
        if path.suffix == ".html":
            raise UserError(f"{path}: cannot be written")
        plain(path, content)

    monkeypatch.setattr(page, "write_atomically", full)
    with pytest.raises(UserError, match="cannot be written"):
        page.write_page(scene, tmp_path / "b.html", url="https://example.org/b.html")
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.jpg"]
