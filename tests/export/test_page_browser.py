"""The page in a real browser: its pictures beside ours, and what a visitor does with it."""

from __future__ import annotations

import base64
import dataclasses
import io
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from helpers import page_visits
from helpers.chromium import chromium, lose_context, restore_context
from helpers.edit_scenes import bar_scene, rich_scene, tinted_scene
from helpers.page_visits import RENDER, SIZE, psnr, until
from helpers.touch import Touch
from scgs_warp.export.page import write_page
from scgs_warp.export.request import ExportRequest
from scgs_warp.export.run import export
from scgs_warp.export.still import write_still
from scgs_warp.geometry.cameras import orbit_camera
from scgs_warp.motion import build_motion
from scgs_warp.scene.from_gaussians import open_gaussians, with_control_points
from scgs_warp.scene.scene import Scene

ROWS = slice(40, 400)  # of the window: below the title, above the panel
STATE = """() => window.scgs.ready.then(({ player: p, clock: c }) => ({ time: p.time, playing: c.playing,
  azimuth: p.orbit.azimuth, elevation: p.orbit.elevation, distance: p.orbit.distance, target: p.orbit.target,
  idle: !p.stale && !p.unsorted && !p.sorting && !p.moving, frames: p.frames, worker: p.worker !== null,
  size: [p.canvas.width, p.canvas.height] }))"""


class Visit(page_visits.Visit):
    """A visit of a page that plays, which may fail to become ready."""

    def __init__(self, browser: Any, path: Path, *, prepare: str = "", **context: Any) -> None:
        super().__init__(browser, path, "", prepare=prepare, awaited=False, **context)

    def still(self) -> None:
        """Stop the film and wait for the last frame."""
        self.page.evaluate("window.scgs.ready.then(({ clock }) => clock.play(false))")
        until(lambda: self.state()["idle"])

    def state(self) -> dict[str, Any]:
        return self.page.evaluate(STATE)

    def screen(self) -> np.ndarray:
        """[H, W, 3] the canvas as it is shown, without the panel."""
        until(lambda: self.state()["idle"])
        image = Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")
        return np.asarray(image, np.float64)[ROWS] / 255


def changed(a: np.ndarray, b: np.ndarray) -> float:
    """Share of the pixels that clearly differ."""
    return float((np.abs(a - b).max(-1) > 0.1).mean())


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def bar(tmp_path_factory) -> tuple[Scene, Path]:
    scene, path = bar_scene(shaded=True), tmp_path_factory.mktemp("page") / "bar.html"
    write_page(scene, path, title="</title><script>window.broken = 1</script>")
    return scene, path


def plain(scene: Scene) -> Scene:
    scene.motion = build_motion("static", scene.config)
    return scene


SCENES = {
    "shaded": lambda: bar_scene(shaded=True),
    "corrected": lambda: bar_scene(shaded=True, corrected=True),
    "rich": rich_scene,
    "tinted": lambda: tinted_scene(shaded=True),
    "tinted, with a mask": lambda: tinted_scene(share=0.6),
    "one neighbour": lambda: with_neighbors(bar_scene(), 1),
    "static": lambda: plain(bar_scene()),
    "static with control points": lambda: with_control_points(plain(bar_scene()), 20),
}


def with_neighbors(scene: Scene, count: int) -> Scene:
    scene.motion.config = dataclasses.replace(scene.motion.config, neighbors=count)
    scene.freeze_binding()
    return scene


@pytest.mark.parametrize("name", SCENES)
def test_frames_are_those_of_our_renderer(browser, name, tmp_path):
    scene = SCENES[name]()
    write_page(scene, tmp_path / "page.html")
    visit = Visit(browser, tmp_path / "page.html")
    pictures = []
    for azimuth in (30.0, 200.0):
        for moment in (0.0, 0.43, 1.0):
            camera = orbit_camera(scene.overview, azimuth, 120)
            ours = scene.render(camera, moment, (0, 0, 0)).rgb.clamp(0, 1).numpy()
            assert (ours > 0.1).mean() > 0.02, "there is something to see"
            pictures.append(visit.render(camera, moment))
            assert psnr(pictures[-1], ours) > 45
    if scene.motion.moves:
        assert changed(pictures[0], pictures[2]) > 0.01, "it moves"
    assert not visit.problems
    visit.context.close()


def test_a_file_of_gaussians_is_shown(browser, tmp_path):
    write_still(tmp_path / "a.sog", bar_scene(shaded=True).gaussians_at(0.2))
    export(ExportRequest(tmp_path / "a.html", ply=tmp_path / "a.sog"))
    scene, visit = open_gaussians(tmp_path / "a.sog"), Visit(browser, tmp_path / "a.html")
    for azimuth in (30.0, 200.0):
        camera = orbit_camera(scene.overview, azimuth, 120)
        ours = scene.render(camera, 0.0, (0, 0, 0)).rgb.clamp(0, 1).numpy()
        assert (ours > 0.1).mean() > 0.02 and psnr(visit.render(camera, 0.0), ours) > 45
    assert not visit.problems
    visit.context.close()


def test_the_screen_shows_the_same_as_an_exact_frame(browser, bar):
    """Gaussians sorted by the worker, drawn on the canvas."""
    scene, path = bar
    visit = Visit(browser, path)
    visit.still()
    visit.page.evaluate("window.scgs.ready.then(({ player }) => player.seek(0.62))")
    shown = visit.screen()
    assert visit.state()["worker"]
    camera = visit.page.evaluate(
        "window.scgs.ready.then(({ player: p }) => p.orbit.camera(p.canvas.width, p.canvas.height))"
    )
    ours = orbit_camera(scene.overview, scene.overview.azimuth, 520)
    assert np.allclose(camera["viewmat"], ours.viewmat, atol=1e-5), "the page begins where films begin"
    arguments = [0.62, camera["viewmat"], camera["K"], camera["width"], camera["height"], [0, 0, 0]]
    exact = np.frombuffer(base64.b64decode(visit.page.evaluate(RENDER, arguments)), np.uint8)
    exact = exact.reshape(camera["height"], camera["width"], 4)[ROWS, :, :3] / 255
    assert (exact > 0.1).mean() > 0.02 and psnr(shown, exact) > 50
    visit.context.close()


def test_nothing_is_asked_of_the_network(browser, bar):
    hits = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            hits.append(self.path)
            self.send_response(200)
            self.end_headers()

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        visit = Visit(browser, bar[1])
        visit.still()
        assert [url for url in visit.requests if not url.startswith(("file:", "blob:"))] == []
        address = f"http://127.0.0.1:{server.server_port}/"
        get = f"fetch('{address}fetch').then(() => 'came', () => 'refused')"
        assert visit.page.evaluate(get) == "refused", "and a script that was smuggled in could not"
        assert hits == []
        assert visit.page.evaluate("window.broken") is None
        assert visit.page.title() == "</title><script>window.broken = 1</script>"
        visit.page.goto(address)
        assert "/" in hits, "the server would have answered"
        visit.context.close()
    finally:
        server.shutdown()


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (
            "const get = HTMLCanvasElement.prototype.getContext; HTMLCanvasElement.prototype.getContext ="
            " function (name, ...rest) { return name === 'webgl2' ? null : get.call(this, name, ...rest); };",
            "needs WebGL 2",
        ),
        ("delete window.DecompressionStream;", "too old"),
        ("delete window.WebGL2RenderingContext;", "needs WebGL 2"),
    ],
)
def test_a_browser_that_cannot_says_why(browser, bar, prepare, words):
    visit = Visit(browser, bar[1], prepare=prepare)
    message = visit.page.locator("#message")
    until(lambda: words in message.inner_text())
    assert message.is_visible() and not visit.page.locator("#controls").is_visible()
    assert not visit.problems
    visit.context.close()


def test_without_a_worker_it_sorts_by_itself(browser, bar):
    visit = Visit(browser, bar[1], prepare="window.Worker = class { constructor() { throw new Error('no'); } };")
    visit.still()
    assert (visit.screen() > 0.1).mean() > 0.02 and not visit.state()["worker"]
    visit.context.close()


def test_time_is_played_and_moved(browser, bar):
    visit = Visit(browser, bar[1])
    until(lambda: visit.state()["playing"] and visit.state()["time"] > 0.02)
    visit.page.get_by_role("button", name="Pause").click()
    slider = visit.page.get_by_role("slider", name="Time")
    slider.press("Home")
    begin = visit.screen()
    assert visit.state()["time"] == 0 and not visit.state()["playing"]
    slider.press("End")
    end = visit.screen()
    assert visit.state()["time"] == 1 and changed(begin, end) > 0.01
    assert visit.page.locator("#clock").inner_text() == "4.00 / 4.00 s"
    visit.page.locator("#view").focus()
    visit.page.keyboard.press("ArrowLeft")
    assert abs(visit.state()["time"] - 0.99) < 1e-9
    visit.page.get_by_role("button", name="Settings").click()
    visit.page.get_by_label("At the end").select_option("stop")
    visit.page.get_by_label("Speed").select_option("4")
    visit.page.get_by_role("button", name="Play").click()
    until(lambda: not visit.state()["playing"])
    assert visit.state()["time"] == 1
    assert not visit.problems
    visit.context.close()


def test_mouse_and_keys_move_the_view(browser, bar):
    visit = Visit(browser, bar[1])
    visit.still()
    mouse, before, begin = visit.page.mouse, visit.state(), visit.screen()

    def drag(dx: float, dy: float, button: Any = "left") -> dict[str, Any]:
        mouse.move(200, 150)
        mouse.down(button=button)
        mouse.move(200 + dx, 150 + dy, steps=3)
        mouse.up(button=button)
        return visit.state()

    turned = drag(60, -20)
    assert turned["azimuth"] < before["azimuth"] and turned["elevation"] < before["elevation"]
    assert changed(begin, visit.screen()) > 0.005
    moved = drag(30, 20, "right")
    assert moved["azimuth"] == turned["azimuth"] and moved["target"] != turned["target"]
    mouse.wheel(0, 300)
    until(lambda: visit.state()["distance"] > before["distance"])
    visit.page.keyboard.press("+")
    visit.page.get_by_role("button", name="Settings").click()
    visit.page.get_by_role("button", name="Reset view").click()
    visit.page.get_by_role("button", name="Settings").click()
    assert {k: visit.state()[k] for k in ("azimuth", "elevation", "distance", "target")} == {
        k: before[k] for k in ("azimuth", "elevation", "distance", "target")
    }
    assert np.array_equal(visit.screen(), begin)
    visit.page.locator("#view").focus()
    visit.page.keyboard.press("b")
    assert (visit.screen()[:5, 5:-5] == 1).all() and visit.page.locator("#background").input_value() == "#ffffff"
    visit.page.keyboard.press("h")
    assert visit.page.locator("#keys").is_visible()
    assert not visit.problems
    visit.context.close()


def test_controls_that_were_clicked_leave_keys_and_picture_to_the_page(browser, bar):
    visit = Visit(browser, bar[1])
    visit.still()
    page, keys = visit.page, visit.page.keyboard
    page.locator("#time").click()
    begin = visit.state()["time"]
    keys.press("ArrowRight")
    keys.press("ArrowUp")
    assert abs(visit.state()["time"] - begin - 0.02) < 1e-9, "hundredths of the motion, as beside the slider"
    keys.press("h")
    assert page.locator("#keys").is_visible()
    keys.press("Escape")
    assert page.locator("#keys").is_hidden()
    page.get_by_role("button", name="Settings").click()
    page.get_by_label("At the end").focus()
    keys.press("b")
    assert page.locator("#background").input_value() == "#000000", "a list has keys of its own"
    keys.press("Escape")
    assert page.locator("#settings").is_hidden()
    assert page.evaluate("document.activeElement.id") == "more"
    page.locator("#time").click()
    keys.press(" ")
    assert visit.state()["playing"]
    for _ in range(2):
        page.locator("#play").click()
    page.mouse.move(320, 100)
    until(lambda: page.evaluate("document.body.classList.contains('idle')"))
    assert not visit.problems
    visit.context.close()


def test_panning_keeps_what_is_under_the_pointer(browser, bar):
    visit = Visit(browser, bar[1])
    visit.still()
    begin = visit.screen()
    visit.page.mouse.move(320, 220)
    visit.page.mouse.down(button="right")
    visit.page.mouse.move(350, 240, steps=4)
    visit.page.mouse.up(button="right")
    moved = visit.screen()
    followed = changed(np.roll(begin, (20, 30), (0, 1)), moved)
    assert followed < 0.5 * changed(begin, moved), "but for the perspective"
    visit.context.close()


def test_two_fingers_pinch(browser, bar):
    visit = Visit(browser, bar[1], has_touch=True)
    visit.still()
    before, send = visit.state(), Touch(visit.context, visit.page).at
    send("touchStart", (200, 150), (260, 150))
    send("touchMove", (170, 150), (290, 150))
    send("touchEnd")
    until(lambda: visit.state()["distance"] < 0.9 * before["distance"])
    assert visit.state()["azimuth"] == before["azimuth"]
    send("touchStart", (200, 150))
    send("touchMove", (240, 150))
    send("touchEnd")
    until(lambda: visit.state()["azimuth"] != before["azimuth"])
    visit.context.close()


def test_the_picture_survives_other_sizes_and_a_lost_device(browser, bar):
    visit = Visit(browser, bar[1])
    visit.still()
    begin = visit.screen()
    visit.page.set_viewport_size({"width": 700, "height": 300})
    until(lambda: visit.state()["size"] == [700, 300])
    assert (visit.screen() > 0.1).mean() > 0.01
    visit.page.set_viewport_size(SIZE)
    until(lambda: visit.state()["size"] == [640, 520])
    assert np.array_equal(visit.screen(), begin)
    lose_context(visit.page)
    assert "reload the page" in visit.page.get_by_role("alert").inner_text()
    visit.page.mouse.move(320, 200)
    with pytest.raises(Exception, match="reload the page"):
        visit.render(orbit_camera(bar[0].overview, 0.0, 32), 0.0)
    restore_context(visit.page)
    assert np.array_equal(visit.screen(), begin) and visit.page.get_by_role("alert").is_hidden()
    assert not visit.problems
    visit.context.close()


def test_a_static_scene_has_no_time(browser, tmp_path):
    write_page(plain(bar_scene()), tmp_path / "page.html")
    visit = Visit(browser, tmp_path / "page.html")
    visit.still()
    visit.page.get_by_role("button", name="Settings").click()
    visible = {name: visit.page.locator(name).is_visible() for name in ("#play", "#time", "#speed", "#reset")}
    assert visible == {"#play": False, "#time": False, "#speed": False, "#reset": True}
    assert (visit.screen() > 0.1).mean() > 0.01
    visit.context.close()
