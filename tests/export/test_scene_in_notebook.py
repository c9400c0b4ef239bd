"""What a notebook shows of a scene."""

from __future__ import annotations

import subprocess
import sys

from helpers.chromium import chromium
from helpers.edit_scenes import bar_scene
from scgs_warp.export import notebook
from scgs_warp.motion import build_motion


def test_a_scene_plays_in_a_frame(tmp_path):
    scene = bar_scene()
    shown = scene._repr_html_()
    assert shown is not None and shown.count("<iframe") == 1
    path = tmp_path / "notebook.html"
    path.write_text(f"<!doctype html><p>before</p>{shown}<p>after</p>", encoding="utf-8")
    with chromium() as browser:
        page = browser.new_page()
        problems = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", lambda m: problems.append(m.text) if m.type == "error" else None)
        page.goto(path.as_uri())
        frame = page.frames[1]
        ready = "window.scgs.ready.then(({ player, clock }) => [player.model.count, clock.playing])"
        assert frame.evaluate(ready) == [scene.gaussian_count, True]
        assert page.get_by_text("after").is_visible() and not problems


def test_a_scene_without_a_page_shows_its_name(monkeypatch):
    scene = bar_scene()
    monkeypatch.setattr(notebook, "MOST_MIB", 1e-3)
    assert scene._repr_html_() is None, "too large"
    monkeypatch.undo()
    scene.motion = build_motion("per-gaussian", scene.config)
    assert scene._repr_html_() is None, "no control points"


def test_the_page_is_found_however_the_scene_was_imported():
    """``import scgs_warp`` alone stays cheap."""
    code = (
        "import sys, scgs_warp; print('torch' in sys.modules, len(sys.modules['scgs_warp.scene.page_maker']._makers))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.split() == ["False", "1"]
