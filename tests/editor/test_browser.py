"""The editor in a real browser: what a user does with mouse and keys, and what the page then shows."""

from __future__ import annotations

import io
from itertools import pairwise

import numpy as np
import pytest
import torch
from PIL import Image

from helpers.edit_scenes import bar_scene
from helpers.editor_windows import Window, serve, until
from helpers.node_packages import package
from scgs_warp.edit import EditSession

pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")


def test_a_limb_is_pulled_keyed_undone_and_kept(browser, editor):
    window = Window(browser, editor)
    window.still()
    part = window.lowest_limb()
    x, y = window.part_on_screen(part)
    window.page.mouse.move(x, y)
    until(lambda: window.ask("player.tools.lit") == part)
    azimuth = window.ask("player.orbit.azimuth")
    window.ask(
        """(() => { const { link } = studio, tell = link.tell.bind(link);
        link.tell = (what, fields) => { if (what === "drag") window.dragged = fields; tell(what, fields); }; })()"""
    )
    window.drag((x, y), (25, -45))
    until(lambda: not window.ask("studio.link.state.unedited"))
    window.still()
    sent, script = window.page.evaluate("window.dragged"), EditSession(editor.session.scene)
    script.pull(window.ask("studio.link.state.part"), sent["to"], 0.0, sent["grip"])
    for name, target in script.edit.targets.items():
        np.testing.assert_allclose(editor.session.edit.targets[name].rotation, target.rotation, atol=1e-6)
    moved = np.array(window.part_on_screen(part)) - (x, y)
    assert np.linalg.norm(moved - (25, -45)) < 25, "the part follows the pointer"
    assert window.ask("player.orbit.azimuth") == azimuth and window.ask("studio.link.state.part")
    until(lambda: window.page.locator("#status").inner_text() == "saved")
    turn = window.page.get_by_label("Turn, degrees, z")
    pulled = window.ask("studio.link.state.target.degrees")
    turn.fill("3.5")
    turn.press("Enter")
    until(lambda: abs(window.ask("studio.link.state.target.degrees[2]") - 3.5) < 1e-3)
    typed = window.ask("studio.link.state.target.degrees")
    assert np.abs(np.subtract(typed, pulled)[:2]).max() < 1e-3, "what is not typed stays, though it is shown rounded"
    window.page.locator("#view").focus()
    window.page.keyboard.press("Control+z")
    until(lambda: window.ask("studio.link.state.target.degrees") == pulled)
    edit = editor.session.edit

    window.page.keyboard.press("k")
    until(lambda: window.page.locator(".key").count() > 1)
    window.ask("player.seek(0.5)")
    window.still()
    window.drag(window.part_on_screen(part), (-20, -20))
    until(lambda: len(editor.session.edit.keyframes) == 2)
    keys = window.page.locator("#tracks .ruler .key")
    box = keys.nth(1).bounding_box()
    window.page.mouse.move(box["x"] + 8, box["y"] + 8)
    window.page.mouse.down()
    window.page.mouse.move(box["x"] + 120, box["y"] + 8, steps=4)
    window.page.mouse.up()
    until(lambda: window.ask("studio.link.state.keyframes.at(-1).at") > 2.2)
    window.ask("studio.link.ask('film', { seconds: 1 })")
    until(lambda: "left: 100%" in (keys.nth(1).get_attribute("style") or ""))
    window.page.keyboard.press("Control+z")
    until(lambda: "left: 100%" not in (keys.nth(1).get_attribute("style") or ""))
    keys.nth(1).click()
    window.page.keyboard.press("Delete")
    until(lambda: len(editor.session.edit.keyframes) == 1)
    for _ in range(4):
        window.page.keyboard.press("Control+z")
    until(lambda: editor.session.edit == edit)
    window.page.keyboard.press("Control+z")
    until(lambda: window.ask("studio.link.state.unedited"))
    window.page.keyboard.press("Control+y")
    until(lambda: editor.session.edit == edit)

    window.page.keyboard.press(" ")
    until(lambda: window.ask("clock.playing && player.time > 0.05"))
    window.page.keyboard.press(" ")
    window.page.keyboard.press("2")
    window.page.reload()
    window.page.evaluate("window.scgs.ready.then(() => 1)")
    assert window.ask("player.time") > 0.05, "the moment and the view survive a reload"
    assert window.ask("player.tools.kind") == "turn"
    assert not window.ask("studio.link.state.unedited")
    window.close()


def test_a_point_drawn_on_the_tip_stays_there_while_the_view_turns(browser, tmp_path):
    """The tip's Gaussians are magenta; centroids of the canvas' pixels at 10 views."""
    scene = bar_scene(nodes=30, gaussians=600)
    motion, gaussians = scene.motion, scene.gaussians
    with torch.no_grad():
        tip = int(motion.positions[:, 0].argmin())
        away = (gaussians.means - motion.positions[tip]).norm(dim=1)
        mine = away.argsort()[:12]
        gaussians.sh_dc[:], gaussians.sh_rest[:] = -1.6, 0.0
        gaussians.opacity_logits[away < 0.6] = -9.0  # nothing hides it
        gaussians.means[mine] = motion.positions[tip].clone()
        gaussians.log_scales[mine], gaussians.opacity_logits[mine] = -3.2, 6.0
        gaussians.sh_dc[mine] = torch.tensor([1.7, -1.7, 1.7])
    scene.freeze_binding()
    editor = serve(scene, tmp_path)
    try:
        window = Window(browser, editor)
        window.still()
        window.ask("studio.link.ask('select', { what: 'nodes', nodes: [argument] })", tip)
        until(lambda: window.ask("studio.link.state.selection") == [tip])
        for view in range(10):
            window.ask("(player.orbit.turn(0.6, argument), player.changed())", 0.1 if view % 2 else -0.1)
            window.still()
            frame = window.ask(
                """(() => { const { width, height } = player.canvas, c = player.orbit.camera(width, height);
                const { pixels } = player.renderAt(player.time, c.viewmat, c.K, width, height, [0, 0, 0]);
                let x = 0, y = 0, n = 0;
                for (let i = 0; i < pixels.length; i += 4) {
                  const w = Math.max(0, Math.min(pixels[i], pixels[i + 2]) - pixels[i + 1]), p = i / 4;
                  x += w * (p % width + 0.5); y += w * (Math.floor(p / width) + 0.5); n += w; }
                return [x / n, y / n, n]; })()"""
            )
            assert frame[2] > 1000, "the tip is seen"
            shot = window.page.locator("#view").screenshot()
            image = np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), np.float64)
            weight = np.clip(np.minimum(image[..., 0], image[..., 1]) - image[..., 2] - 60, 0, None)  # the yellow point
            rows, columns = np.indices(weight.shape)
            point = [(weight * (columns + 0.5)).sum() / weight.sum(), (weight * (rows + 0.5)).sum() / weight.sum()]
            assert np.hypot(point[0] - frame[0], point[1] - frame[1]) < 1.5, view
        window.close()
    finally:
        editor.stop()


def test_points_are_chosen_by_lasso_and_brush(browser, editor):
    window = Window(browser, editor)
    window.still()
    window.page.keyboard.press("3")
    x, y = window.part_on_screen(window.lowest_limb())
    window.page.keyboard.down("Shift")
    mouse = window.page.mouse
    mouse.move(x - 40, y - 40)
    mouse.down()
    for corner in ((x + 40, y - 40), (x + 40, y + 40), (x - 40, y + 40)):
        mouse.move(*corner, steps=3)
    mouse.up()
    window.page.keyboard.up("Shift")
    until(lambda: window.ask("studio.link.state.selection.length") > 0)
    inside = window.ask(
        """(() => { const v = player.view(), p = player.places, b = player.canvas.getBoundingClientRect(), found = [];
        for (let m = 0; m < p.length / 3; m++) {
          const [x, y, z] = v.rows.map((r, k) => r[0] * p[3*m] + r[1] * p[3*m+1] + r[2] * p[3*m+2] + v.shift[k]);
          const s = b.width / player.canvas.width, at = [(v.lens[0] * x / z + v.lens[2]) * s + b.left,
            (v.lens[1] * y / z + v.lens[3]) * s + b.top];
          if (at.every((value, k) => Math.abs(value - argument[k]) < 38)) found.push(m);
        }
        return found; })()""",
        [x, y],
    )
    assert inside and set(inside) <= set(window.ask("studio.link.state.selection"))

    window.page.keyboard.press("Escape")
    until(lambda: window.ask("studio.link.state.selection.length") == 0)
    window.ask("studio.link.ask('tool', { region: 'brush', radius: 0.15 })")
    until(lambda: window.ask("studio.link.state.tool.region") == "brush")
    window.page.keyboard.down("Shift")
    window.drag((x, y), (4, 4))
    window.page.keyboard.up("Shift")
    until(lambda: window.ask("studio.link.state.selection.length") > 0)
    places = editor.session.node_positions(0.0)
    chosen = window.ask("studio.link.state.selection")
    far = np.linalg.norm(places[chosen][:, None] - places[chosen][None], axis=-1).max()
    assert far < 0.4, "what the brush covered, and nothing else"
    window.page.keyboard.down("Control")
    window.page.keyboard.down("Shift")
    window.drag((x, y), (4, 4))
    window.page.keyboard.up("Shift")
    window.page.keyboard.up("Control")
    until(lambda: window.ask("studio.link.state.selection.length") == 0)
    window.close()


def test_the_page_looks_through_the_camera_of_the_film(browser, editor):
    window = Window(browser, editor)
    window.still()
    own = window.ask("player.orbit.azimuth")
    window.page.keyboard.press("v")
    until(lambda: window.ask("studio.link.state.film.views.length") == 1)
    window.ask("(player.orbit.turn(1, 0), player.seek(0.5))")
    window.page.keyboard.press("v")
    until(lambda: window.page.locator(".key.camera").count() == 2)
    window.ask("(player.orbit.turn(1, 0), player.seek(0.25))")
    window.page.get_by_label("Film camera").check()
    window.still()
    assert own + 0.2 < window.ask("player.orbit.azimuth") < own + 0.8, "between its views"
    assert float(window.page.locator("#filmed").get_attribute("width") or 0) > 100
    box = window.page.locator("#view").bounding_box()
    window.drag((box["x"] + 10, box["y"] + 10), (40, 0))
    assert not window.ask("player.follows"), "the view is the user's again"
    window.close()


def test_undo_brings_the_background_back(browser, editor):
    window = Window(browser, editor)
    window.still()
    before = window.ask("[...player.background]")
    window.page.keyboard.press("b")
    until(lambda: window.ask("studio.link.state.film.background") is not None)
    assert window.ask("[...player.background]") != before
    window.page.keyboard.press("Control+z")
    until(lambda: window.ask("studio.link.state.film.background") is None)
    until(lambda: window.ask("[...player.background]") == before)
    window.close()


def test_a_page_without_webgl_shows_pictures(browser, editor):
    window = Window(browser, editor, "&pictures")
    until(lambda: window.ask("player.canvas.width > 100 && !player.waits && !player.stale"))
    shot = np.asarray(Image.open(io.BytesIO(window.page.locator("#view").screenshot())).convert("RGB"))
    assert (shot > 40).any(2).mean() > 0.02
    assert "The server draws instead" in window.page.locator("#notes").inner_text()
    window.ask("player.waits = true")
    window.ask("studio.link.hear({ undrawn: true })")
    assert not window.ask("player.waits"), "a picture that fails is not waited for"
    window.ask("(() => { player.waits = true; studio.link.gone(false); studio.found(); })()")
    until(lambda: window.ask("!player.waits && !player.stale"))
    window.page.get_by_label("Part", exact=True).select_option(index=2)
    until(lambda: window.ask("studio.link.state.part"))
    window.close()


@pytest.mark.parametrize("size", [(1400, 900), (2560, 1440), (390, 844)])
def test_every_control_can_be_named_reached_and_read(browser, editor, size):
    """Labels, contrast, titles and roles, by axe-core; nothing sticks out of the window."""
    source = (package("axe-core") / "axe.min.js").read_text(encoding="utf-8")
    window = Window(browser, editor, size={"width": size[0], "height": size[1]})
    window.still()
    window.ask("studio.link.ask('choose_part', { name: studio.tools.parts[0].name })")
    until(lambda: window.page.locator("#chosen").is_visible())
    for name in ("dark", "light"):
        window.ask("studio.theme(argument)", name)
        window.page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        window.page.evaluate(source)
        found = window.page.evaluate("axe.run({ resultTypes: ['violations'] }).then((r) => r.violations)")
        told = [(v["id"], [node["html"][:120] for node in v["nodes"]][:3]) for v in found]
        assert told == [], name
        for key, dialog in (("Control+k", "#palette"), ("?", "#keys"), ("F2", "#changes")):
            window.page.keyboard.press(key)
            found = window.page.evaluate("(place) => axe.run(place).then((r) => r.violations.map((v) => v.id))", dialog)
            assert found == [], (name, dialog)
            window.page.locator(dialog).evaluate("(dialog) => dialog.close()")
        window.page.locator("#view").focus()
    assert window.page.evaluate("document.documentElement.scrollWidth") <= size[0]
    if window.page.evaluate("document.body.classList.contains('folded')"):
        window.page.get_by_role("button", name="Panel", exact=True).click()
    for label in ("It lasts", "A click takes", "Hold stays on"):
        window.page.get_by_role("button", name=f"About: {label}").click()
        assert window.page.get_by_role("heading", name=label).is_visible()
        width, height = window.page.evaluate(
            "(({ width, height }) => [width, height])(document.querySelector('#help use').getBBox())"
        )
        assert width > 100 and height > 50, "a picture explains it"
        assert window.page.evaluate("axe.run('#help').then((r) => r.violations.map((v) => v.id))") == []
        window.page.keyboard.press("Escape")
    assert window.page.title() == "figure - scgs_warp editor"
    window.page.keyboard.press("Control+k")
    window.page.locator("#sought").fill("trajec")
    window.page.keyboard.press("Enter")
    assert window.ask("player.tools.show.ribbons")
    window.page.keyboard.press("?")
    assert window.page.get_by_role("heading", name="Keys").is_visible()
    assert window.page.evaluate("document.getElementById('keys').scrollTop") == 0, "it begins with its beginning"
    window.close()


def test_the_scene_stays_in_sight_on_the_smallest_phones(browser, editor):
    window = Window(browser, editor, size={"width": 320, "height": 568})
    window.still()
    window.page.get_by_role("button", name="Panel", exact=True).click()
    marks = window.page.evaluate(
        """[...document.querySelectorAll("#tracks .ruler span")].map((mark) => mark.getBoundingClientRect())
        .filter(({ width }) => width).map(({ left, right }) => [left, right])"""
    )
    assert len(marks) > 2 and all(one[1] <= other[0] for one, other in pairwise(marks)), "marks do not overlap"
    for size in ({"width": 320, "height": 568}, {"width": 800, "height": 360}):
        window.page.set_viewport_size(size)
        window.still()
        boxes = [window.page.locator(f"#{name}").bounding_box() for name in ("stage", "panel", "time")]
        assert boxes[0]["height"] > 150 and boxes[1]["height"] > 60
        assert all(box["y"] + box["height"] <= size["height"] for box in boxes)
    window.close()
