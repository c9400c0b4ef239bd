"""The editor in a real browser: what a user does with mouse and buttons, seen on the screen."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from helpers.chromium import chromium
from helpers.edit_scenes import figure_scene
from scgs_warp.edit import EditSession, render_film
from scgs_warp.edit.edit_file import read
from scgs_warp.editor import Editor, Proxy
from scgs_warp.editor.gizmo_pose import surface_point
from scgs_warp.editor.views import ClientCamera
from scgs_warp.errors import UserError
from scgs_warp.types import Camera

pytest.importorskip("viser", reason="the package viser is not installed")

SIZE = {"width": 1000, "height": 640}
PATIENCE = 120.0


def until(condition: Callable[[], Any], seconds: float = PATIENCE) -> None:
    """Wait until something is true; browsers on busy machines take their time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


def still(editor: Editor) -> None:
    """Wait until the picture on the screen is the last and full one."""
    until(lambda: editor.worker.idle)
    time.sleep(1.5)  # until the page has drawn it


class Window:
    """One browser window with the editor in it."""

    def __init__(self, browser: Any, editor: Editor, url: str) -> None:
        self.editor, self.problems = editor, []
        self.page = browser.new_page(viewport=SIZE, accept_downloads=True)
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("console", lambda m: self.problems.append(m.text) if m.type == "error" else None)
        self.page.goto(url)
        self.page.set_default_timeout(1e3 * PATIENCE)
        self.page.get_by_text("Undo", exact=True).wait_for(timeout=1e3 * PATIENCE)
        until(lambda: len(editor.schedule))
        still(editor)

    def picture(self) -> np.ndarray:
        """[H, W, 3] what is on the screen beside the panel."""
        still(self.editor)
        image = np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB"), np.int32)
        return image[160:, : self.client().width]  # below what it says of WebGL in software

    def press(self, name: str) -> None:
        self.page.get_by_role("button", name=name, exact=True).click()

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name, exact=True).click()

    def hush(self) -> None:
        """Close what lies over the picture."""
        buttons = self.page.locator(".mantine-Notification-closeButton")
        while buttons.count():
            with suppress(Exception):  # it may have closed by itself
                buttons.first.click(timeout=1000)

    def field(self, label: str) -> Any:
        """The input beside a label."""
        return self.page.locator(f"xpath=//*[text()='{label}']/following::input[1]")

    def client(self) -> ClientCamera:
        return self.editor.camera(next(iter(self.editor.server.get_clients().values())))

    def camera(self) -> Camera:
        client = self.client()
        return client.at_size(max(client.width, client.height))

    def pixel(self, point: np.ndarray) -> tuple[float, float]:
        """Where a point of the world is on the screen."""
        camera = self.camera()
        seen = camera.K @ (camera.viewmat[:3, :3] @ torch.from_numpy(point).float() + camera.viewmat[:3, 3])
        return float(seen[0] / seen[2]), float(seen[1] / seen[2])

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        mouse = self.page.mouse
        mouse.move(*start)
        time.sleep(0.3)  # the gizmo notices who hovers
        mouse.down()
        for share in np.linspace(0, 1, 8)[1:]:
            mouse.move(*(np.array(start) + share * (np.array(end) - start)))
            time.sleep(0.1)
        self.latest = len(self.editor.latency)
        mouse.up()


@pytest.fixture
def editor(tmp_path) -> Iterator[Editor]:
    made = Editor(EditSession(figure_scene(nodes=200, points=5000)[0]), tmp_path / "edits", port=0, size=512)
    yield made
    made.stop()


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Share of the pixels that are clearly different."""
    return float((np.abs(before - after).max(-1) > 40).mean())


def take_arm(window: Window, key: str = "") -> None:
    """Click on what sticks out to the left, at half the figure's height, while a key is held."""
    editor = window.editor
    window.hush()
    camera, moment = window.client(), editor.model.moment()
    seen = np.array([window.pixel(point) for point in editor.session.node_positions(0.0)])
    seen = seen[(seen[:, 1] > 300) & (seen[:, 1] < 480)]

    def hit() -> np.ndarray:
        ordered = seen[seen[:, 0].argsort()] + [5, 0]
        screens = ordered / [camera.width, camera.height]
        met = (surface_point(editor.session, camera, tuple(screen), moment) is not None for screen in screens)
        return next(pixel for pixel, good in zip(ordered, met) if good)

    where = editor.worker.call(hit)
    if key:
        window.page.keyboard.down(key)
    window.page.mouse.click(*where)
    if key:
        window.page.keyboard.up(key)
    until(lambda: editor.model.selection)
    until(lambda: editor.overlays.gizmo.visible)
    still(editor)


def pull(window: Window, away: float = 90.0) -> None:
    """Drag the gizmo by its upward arrow."""
    gizmo, reach = window.editor.overlays.gizmo, window.editor.overlays.reach
    window.page.mouse.move(10, 630)
    world = window.editor.display.world
    start = window.pixel(world(gizmo.position + np.array([0, 0, 0.9 * reach])))
    base = np.array(window.pixel(world(gizmo.position)))
    step = (np.array(start) - base) / np.linalg.norm(np.array(start) - base)
    window.drag(start, tuple(np.array(start) + away * step))
    until(lambda: not window.editor.model.dragging)


def test_a_point_is_dragged_undone_and_filmed(editor, tmp_path):
    with chromium() as browser:
        window = Window(browser, editor, editor.url)
        session, model = editor.session, editor.model
        begin = window.picture()
        assert changed(begin, np.zeros_like(begin)) > 0.1, "the scene is on the screen"

        take_arm(window)
        part = editor.parts.part
        assert part is not None, "a click takes a part"
        before = window.picture()
        pull(window)
        assert {handle.part for handle in session.edit.handles} == set(session.chain(part))
        assert editor.latency and changed(before, window.picture()) > 0.005
        window.press("Undo")
        until(lambda: not session.edit.handles)

        take_arm(window)
        assert editor.parts.part is None, "a second click takes control points"
        chosen = window.picture()
        pull(window)
        assert len(session.edit.handles) == 1 and session.edit.pins
        lifted = session.edit.targets["handle 1"].translation
        assert lifted[2] > 0.05 and editor.latency, "the gizmo's arrow lifts the handle"
        moved = window.picture()
        assert changed(chosen, moved) > 0.005

        window.press("Undo")
        until(lambda: not session.edit.handles)
        assert changed(chosen, window.picture()) < 0.25 * changed(chosen, moved)
        window.press("Redo")
        until(lambda: session.edit.handles)

        window.tab("Film")
        window.press("Add keyframe here")
        until(lambda: len(session.edit.keyframes) == 1)
        window.field("Seconds").fill("0.5")
        until(lambda: session.edit.film.seconds == 0.5)  # The server's answer may overwrite a field filled meanwhile.
        window.field("Frames a second").fill("8")
        until(lambda: session.edit.film.fps == 8)
        window.field("Longer side").fill("64")
        until(lambda: session.edit.film.size == 64)
        model.seek(0.5)
        pull(window, -60.0)
        window.press("Add keyframe here")
        until(lambda: len(session.edit.keyframes) == 2)

        window.tab("Files")
        window.press("Export film")
        until(lambda: (editor.folder / "edit.mp4").is_file())
        window.press("Save edit")
        until(lambda: (editor.folder / "edit.json").is_file())
        window_size = window.client().width, window.client().height
        window.press("Screenshot")
        until(lambda: (editor.folder / "edit.png").is_file())
        window.press("Export PLY")
        until(lambda: (editor.folder / "edit.ply").is_file())
        edit = session.edit
        window.press("Reset")
        until(lambda: not session.edit.handles)
        window.press("Load edit")
        until(lambda: session.edit == edit)
        model.seek(0.0)
        window.press("Play")
        until(lambda: model.at > 0.2)
        window.press("Pause")
        until(lambda: not model.playing)
        assert window.problems == []

    assert read(editor.folder / "edit.json", session.engine) == session.edit
    script = EditSession(figure_scene(nodes=200, points=5000)[0])
    script.load(editor.folder / "edit.json")
    assert render_film(script, tmp_path / "script.mp4") == 4
    assert (tmp_path / "script.mp4").read_bytes() == (editor.folder / "edit.mp4").read_bytes()
    shown = np.asarray(Image.open(editor.folder / "edit.png"))
    assert shown.shape == (window_size[1], window_size[0], 3)


def test_mistakes_are_said_and_the_shared_editor_survives(tmp_path):
    key = "between the two"
    editor = Editor(EditSession(figure_scene(nodes=100, points=2000)[0]), tmp_path, port=0, size=256, key=key)
    proxy = Proxy(editor.port, key, "127.0.0.1")
    session, model = editor.session, editor.model

    def says(window: Window, words: str) -> None:
        window.page.get_by_text(words).first.wait_for(timeout=1e3 * PATIENCE)

    try:
        with chromium() as browser:
            window = Window(browser, editor, proxy.url)
            assert proxy.token not in window.page.url
            window.press("Undo")
            says(window, "nothing to undo")
            window.press("Grow")
            says(window, "click on the picture first")
            window.tab("Film")
            window.press("Add keyframe here")
            says(window, "a keyframe needs a handle")
            window.tab("Files")
            window.field("Name").fill("../../outside")
            until(lambda: editor.panel.files.name.value == "../../outside")
            window.press("Save edit")
            says(window, "take letters, digits")
            assert list(tmp_path.rglob("*.json")) == []

            editor.parts.set(False)
            take_arm(window)
            place = editor.gizmo_frame[0]
            with pytest.raises(UserError, match="finite"):
                editor.drag_gizmo("start", np.zeros(3), np.array([1.0, 0, 0, 0]))
                editor.drag_gizmo("update", np.array([np.nan, 0, 0]), np.array([1.0, 0, 0, 0]))
            editor.drag_gizmo("update", place.pivot + np.array([0, 0, 1000.0]), np.array([1.0, 0, 0, 0]))
            editor.drag_gizmo("end", place.pivot, np.array([1.0, 0, 0, 0]))
            still(editor)
            assert session.edit.targets["handle 1"].translation == pytest.approx((0, 0, 1000))
            window.page.mouse.click(5, 600)
            until(lambda: not model.selection)
            window.page.keyboard.press("Control+z")
            until(lambda: not session.edit.handles)
            take_arm(window, "Shift")
            window.tab("View")
            window.field("Show").click()
            window.page.get_by_role("option", name="side by side").click()
            until(lambda: model.show == "side by side")
            halves = window.picture()
            middle = halves.shape[1] // 2
            assert (halves[:, middle - 5 : middle + 6].max(axis=(1, 2)) > 60).all(), "a line between the halves"
            assert window.problems == []
    finally:
        proxy.stop()
        editor.stop()
