"""Pages whose server ends and is started again."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from helpers.edit_scenes import bar_scene
from helpers.editor_windows import Window, until
from helpers.free_ports import free_port
from scgs_warp.export.run import write_still
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
