"""The page of a run and of a file, served: in a real browser, and while the run's checkpoint changes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from helpers.chromium import chromium
from helpers.edit_scenes import bar_scene
from helpers.tiny import tiny_config, tiny_dataset
from helpers.web_clients import get, key
from scgs_warp.errors import UserError
from scgs_warp.export.page_data import unpack
from scgs_warp.formats.gaussian_ply import write_gaussian_ply
from scgs_warp.live.run_view import packed, view_file, view_run
from scgs_warp.live.viewer import RunWatcher, SceneView
from scgs_warp.training.loop import fit

pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")
PATIENCE = 60.0


def until(condition: Callable[[], Any]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


@pytest.fixture
def view() -> Iterator[SceneView]:
    with SceneView("A <b>title</b>") as made:
        yield made


def state(page: Any) -> dict[str, Any]:
    return page.evaluate(
        "window.scgs.ready.then(({ player: p }) => ({ count: p.model.count, nodes: p.model.nodes, time: p.time,"
        " azimuth: p.orbit.azimuth, amount: p.amount, idle: !p.stale && !p.unsorted && !p.sorting }))"
    )


def test_a_page_follows_its_server(view):
    problems: list[str] = []
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 400, "height": 300})
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(f"{view.server.url}&paused&t=1")
        until(lambda: "waiting for the scene" in page.locator("#message").inner_text())
        assert view.wanted.is_set()
        view.publish(packed(bar_scene(gaussians=300)), "step 1 of 2")
        page.evaluate("window.scgs.ready.then(() => 1)")
        assert page.title() == "A <b>title</b>" and page.locator("#status").inner_text() == "step 1 of 2"
        until(lambda: state(page)["idle"] and state(page)["amount"] == 300)
        page.evaluate("window.scgs.ready.then(({ player }) => { player.orbit.turn(1, 0); player.changed(); })")
        before = state(page)
        assert before["time"] == 0.25
        view.publish(packed(bar_scene(gaussians=500)), "")
        until(lambda: state(page)["count"] == 500 and state(page)["amount"] == 500)
        after = state(page)
        assert (after["time"], after["azimuth"]) == (0.25, before["azimuth"]), "camera and time stay"
        assert page.locator("#status").is_hidden()
        port = view.server.port
        view.stop()
        until(lambda: "server has gone" in page.locator("#status").inner_text())
        assert state(page)["count"] == 500 and not view.wanted.is_set() and port
        assert problems == []


def test_a_page_says_in_words_that_the_scene_did_not_arrive(view):
    """Browsers say ``Failed to fetch``."""
    view.publish(packed(bar_scene(gaussians=300)))
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 400, "height": 300})
        page.route("**/scene", lambda route: route.abort())
        page.goto(view.server.url)
        until(lambda: "connection to the server was lost" in page.locator("#message").inner_text())


def test_the_scene_needs_the_token_and_may_be_missing(view):
    assert get(view.server.port, "/scene").status == 403
    assert get(view.server.port, "/scene", Cookie=key(view.server)).status == 404
    view.publish(b"content")
    assert get(view.server.port, "/scene", Cookie=key(view.server)).text == "content"
    page = get(view.server.port, Cookie=key(view.server))
    assert "connect-src 'self'" in page.text and "<b>" not in page.text.partition("<body>")[2][:2000]


def test_a_run_is_shown_again_when_its_checkpoint_changes(view, tmp_path, monkeypatch):
    monkeypatch.setattr(RunWatcher, "PAUSE", 0.05)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text("{}")
    watcher = view_run(tmp_path / "run", view, "cpu")
    try:
        assert "waiting for the training" in view._status and view._version == 0
        fit(tiny_config(20), tiny_dataset(6), output=tmp_path / "made")
        data = (tmp_path / "made" / "checkpoint.safetensors").read_bytes()
        (tmp_path / "run" / "config.json").write_bytes((tmp_path / "made" / "config.json").read_bytes())
        (tmp_path / "run" / "checkpoint.safetensors").write_bytes(data)
        until(lambda: view._version == 1)
        (tmp_path / "run" / "checkpoint.safetensors").write_bytes(data[:100])
        until(lambda: "checkpoint.safetensors" in view._status)
        assert view._version == 1, "the last good scene stays"
    finally:
        watcher.stop()


def test_what_cannot_be_shown_is_refused(view, tmp_path):
    (tmp_path / "checkpoint.safetensors").touch()
    with pytest.raises(UserError, match=f"is a file; give the folder of the run, such as {tmp_path}"):
        view_run(tmp_path / "checkpoint.safetensors", view, "cpu")
    with pytest.raises(UserError, match="no such run folder"):
        view_run(tmp_path / "missing", view, "cpu")
    with pytest.raises(UserError, match="no such file"):
        view_file(tmp_path / "missing.ply", view, "cpu")


def test_a_file_of_gaussians_is_shown(view, tmp_path):
    path = tmp_path / "scene.ply"
    write_gaussian_ply(path, bar_scene(nodes=12, gaussians=600).gaussians_at(0.5))
    view_file(path, view, "cpu")
    facts, columns = unpack(view._content)
    assert (facts["gaussians"], facts["nodes"], len(columns["mean0"])) == (600, 0, 600)
