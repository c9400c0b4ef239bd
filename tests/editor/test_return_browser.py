"""Pages whose server ends and is started again."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from helpers.edit_scenes import bar_scene
from helpers.editor_windows import Window, until
from helpers.free_ports import free_port
from scgs_warp.export.still import write_still
from scgs_warp.live.run_view import packed
from scgs_warp.live.viewer import SceneView

pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")


@pytest.fixture
def serve(tmp_path) -> Iterator[Callable[..., Any]]:
    """Start a program on a file of Gaussians; the process and the address that it prints."""
    ply, started = tmp_path / "scene.ply", []
    write_still(ply, bar_scene(gaussians=300).gaussians_at(0.0))

    def start(port: int) -> SimpleNamespace:
        command = [sys.executable, "-m", "scgs_warp.apps.edit", "--ply", str(ply), "--nodes", "24"]
        environment = {**os.environ, "XDG_DATA_HOME": str(tmp_path / "home")}
        process = subprocess.Popen(
            [*command, "--threads", "1", "--port", str(port)], stdout=subprocess.PIPE, text=True, env=environment
        )
        started.append(process)
        assert process.stdout is not None
        said = None
        while said is None:
            line = process.stdout.readline()
            assert line, "it has ended"
            said = re.search(r"http://\S+", line)
        return SimpleNamespace(process=process, url=said[0])

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


def end(served: SimpleNamespace, number: int) -> None:
    served.process.send_signal(number)
    served.process.wait(60)


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_the_editor_ends_and_returns(browser, serve, tmp_path):
    port = free_port()
    served = serve(port)
    window = Window(browser, served)
    page, gone = window.page, window.page.locator("#gone")
    page.evaluate("window.opened = 1")
    window.ask("(studio.link.ask('film', { seconds: 7.5 }), player.seek(0.4), player.orbit.turn(0.7, 0.1))")
    until(lambda: page.locator("#status").inner_text() == "saved" and window.ask("player.seconds") == 7.5)
    page.keyboard.press("3")
    kept = "[player.time, player.orbit.azimuth, player.orbit.elevation, player.seconds, player.tools.kind, opened]"
    before = window.ask(kept)
    for number in (signal.SIGKILL, signal.SIGINT):
        end(served, number)
        until(gone.is_visible)
        assert "has gone" in gone.inner_text() and "The edit is saved" in gone.inner_text()
        served = serve(port)
        until(gone.is_hidden)
        assert window.ask(kept) == before, "no reload, and everything is as it was"
        until(lambda: window.ask("studio.link.state.tool.parts_first") is False)
    window.ask("studio.link.ask('film', { seconds: 3 })")
    until(lambda: page.locator("#status").inner_text() == "saved" and window.ask("player.seconds") == 3)

    end(served, signal.SIGKILL)
    shutil.rmtree(tmp_path / "home")  # the new server cannot know the page
    served = serve(port)
    until(lambda: "Open the address" in gone.inner_text())
    other = window.context.new_page()
    other.goto(served.url)
    until(gone.is_hidden)
    assert page.evaluate("window.opened") == 1 and window.ask("player.seconds") == 3
    window.context.close()


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_what_is_chosen_returns(browser, serve):
    """After a kill: in the open page, after a reload, and in a new window; so does the tool."""
    port = free_port()
    served = serve(port)
    window = Window(browser, served)
    window.page.keyboard.press("3")
    window.ask("studio.link.ask('select', { what: 'nodes', nodes: [2, 3, 5], how: 'replace' })")
    chosen = "[studio.link.state.selection, studio.link.state.part, player.tools.kind]"
    until(lambda: window.ask(chosen) == [[2, 3, 5], None, "points"])
    window.page.wait_for_timeout(1000)
    end(served, signal.SIGKILL)
    until(window.page.locator("#gone").is_visible)
    served = serve(port)
    until(window.page.locator("#gone").is_hidden)
    assert window.ask(chosen) == [[2, 3, 5], None, "points"]
    window.page.reload()
    assert window.ask(chosen) == [[2, 3, 5], None, "points"]
    other = Window(browser, served)
    assert other.ask(chosen) == [[2, 3, 5], None, "points"]
    name = other.ask("studio.tools.parts[0].name")
    other.ask("studio.link.ask('choose_part', { name: argument })", name)
    until(lambda: window.ask("studio.link.state.part") == name)
    window.page.wait_for_timeout(1000)
    end(served, signal.SIGKILL)
    served = serve(port)
    until(lambda: window.page.locator("#gone").is_hidden() and window.ask("studio.link.open"))
    assert window.ask("studio.link.state.part") == name and window.page.locator("#chosen").inner_text() == name
    for one in (window, other):
        one.context.close()


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_server_that_hangs_is_named_and_goes_on(browser, serve):
    """Connections stay open while it is stopped. What was asked for before is done when it goes on, and nothing that
    it has confirmed is lost."""
    served = serve(free_port())
    window = Window(browser, served)
    page, gone = window.page, window.page.locator("#gone")
    page.evaluate("window.opened = 1")
    window.ask("studio.link.ask('select', { what: 'nodes', nodes: [1, 2], how: 'replace' })")
    window.ask("studio.link.ask('put', { translation: [0, 0, 0.1] })")
    window.ask("studio.link.ask('film', { seconds: 5 })")
    until(lambda: window.ask("player.seconds") == 5)
    edit = window.ask("[studio.link.state.handles, studio.link.state.target, studio.link.state.selection]")
    served.process.send_signal(signal.SIGSTOP)
    begin = time.monotonic()
    page.evaluate("window.answer = null; window.scgs.ready.then(({ studio }) => { studio.link.ask('film', { fps: 12 })"
                  ".then((answer) => { window.answer = answer; }); })")  # fmt: skip
    until(gone.is_visible)
    assert time.monotonic() - begin < 15 and "does not answer" in gone.inner_text()
    assert page.locator("#status").inner_text() == "no answer"
    azimuth = window.ask("player.orbit.azimuth")
    box = page.locator("#view").bounding_box()
    for x, y in ((0.5, 0.5), (0.02, 0.9)):
        page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
        page.mouse.down()
        page.mouse.move(box["x"] + x * box["width"] + 60, box["y"] + y * box["height"], steps=3)
        page.mouse.up()
    assert window.ask("player.orbit.azimuth") != azimuth, "the view can be turned"
    page.keyboard.press("Control+z")  # is not done later, when nobody expects it
    served.process.send_signal(signal.SIGCONT)
    until(gone.is_hidden)
    until(lambda: window.ask("player.fps") == 12)
    assert "problem" not in page.evaluate("window.answer"), "what waited is done"
    assert window.ask("[studio.link.state.handles, studio.link.state.target, studio.link.state.selection]") == edit
    assert window.ask("player.seconds") == 5 and page.evaluate("window.opened") == 1
    window.ask("studio.link.ask('film', { seconds: 6 })")
    until(lambda: window.ask("player.seconds") == 6)
    until(lambda: page.locator("#status").inner_text() == "saved")
    window.close()


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_drag_that_a_hanging_server_interrupts_is_kept(browser, serve):
    served = serve(free_port())
    window = Window(browser, served)
    page, gone = window.page, window.page.locator("#gone")
    until(lambda: window.ask("!player.stale && !player.unsorted"))
    until(lambda: window.ask("!player.stale && !player.unsorted"))
    x, y = window.part_on_screen(0)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 10, y - 30, steps=3)
    until(lambda: window.ask("studio.link.state.dragging && !studio.link.state.unedited"))
    served.process.send_signal(signal.SIGSTOP)
    page.mouse.move(x + 20, y - 60, steps=3)
    until(gone.is_visible)
    page.mouse.move(x + 200, y - 60, steps=3)  # nobody hears it
    page.mouse.up()
    served.process.send_signal(signal.SIGCONT)
    until(gone.is_hidden)
    until(lambda: window.ask("!studio.link.state.dragging && studio.link.state.undo"))
    assert window.ask("!studio.link.state.unedited && !studio.tools.drag")
    window.close()


def test_the_view_of_a_scene_ends_and_returns(browser, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "home"))
    port = free_port()

    def show(count: int, title: str = "scene") -> SceneView:
        view = SceneView(title, port=port, source=tmp_path / "run")
        view.publish(packed(bar_scene(gaussians=count)), f"{count} Gaussians")
        return view

    view = show(300)
    page = browser.new_page(viewport={"width": 400, "height": 300})
    page.goto(f"{view.server.url}&paused&t=1")

    def ask(what: str) -> Any:
        return page.evaluate(f"window.scgs.ready.then(({{ player }}) => {what})")

    before = ask("[player.orbit.turn(1, 0), player.time, player.orbit.azimuth, window.opened = 1].slice(1)")
    status = page.locator("#status")
    view.stop()
    until(lambda: "server has gone" in status.inner_text())
    assert ask("player.model.count") == 300
    view = show(500)
    try:
        until(lambda: ask("player.model.count") == 500 and status.inner_text() == "500 Gaussians")
        assert ask("[player.time, player.orbit.azimuth, window.opened]") == before, "no reload"
        view.stop()
        view = show(200, "another program")
        until(lambda: page.title() == "another program" and ask("player.model.count") == 200)
    finally:
        view.stop()
        page.close()
