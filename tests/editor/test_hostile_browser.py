"""What no manual foresees: files of other scenes, extremes of the view, a folder that cannot be written, keys lost and
found."""

from __future__ import annotations

import json

import numpy as np
import pytest

from helpers.chromium import lose_context, restore_context
from helpers.edit_scenes import bar_scene
from helpers.editor_windows import Window, serve, until
from scgs_warp.edit import EditSession, edit_file

pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")


@pytest.fixture
def editor(tmp_path):
    made = serve(bar_scene(nodes=40, gaussians=600), tmp_path / "edits")
    yield made
    made.stop()


@pytest.fixture(autouse=True)
def folder(tmp_path):
    (tmp_path / "edits").mkdir()
    return tmp_path / "edits"


def drop(window: Window, *texts: str) -> None:
    """Drop files on the page."""
    window.page.evaluate(
        """(texts) => { const data = new DataTransfer();
        for (const text of texts) data.items.add(new File([text], "other.json"));
        document.getElementById("view").dispatchEvent(
          new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true })); }""",
        list(texts),
    )


def test_a_dropped_edit_is_loaded_or_refused_in_one_line(browser, editor):
    window, notes = Window(browser, editor), None
    window.still()
    notes = window.page.locator("#notes")
    other = EditSession(bar_scene(nodes=30, gaussians=300))
    other.add_handle([25, 28], 0.0, "hand")
    other.move("hand", (0.0, 0.1, 0.0))
    other.turn(other.parts()[0].name, 20, (0, 0, 1))
    foreign = edit_file.to_json(other.edit, other.engine)
    for texts, words in (
        ((foreign,), "scene"), (("{",), "not valid JSON"), (("<html></html>",), "not valid JSON"),
        ((foreign, foreign), "One edit"),
        (("x" * 2_100_000,), "too large"), ((json.dumps({"format": "scgs-warp edit", "version": 9}),), "version"),
    ):  # fmt: skip
        drop(window, *texts)
        until(lambda words=words: words in notes.locator("li").last.inner_text())
        assert "\n" not in notes.locator("li").last.inner_text()
        assert window.ask("studio.link.state.unedited && !studio.link.state.undo"), words
    own = editor.session.fork()
    own.add_handle([1, 2], 0.0, "<i>hand</i>")
    own.move("<i>hand</i>", (0.0, 0.1, 0.0))
    drop(window, edit_file.to_json(own.edit, own.engine))
    until(lambda: editor.session.edit == own.edit and "is loaded" in notes.inner_text())
    assert window.page.locator("#tracks .name").last.inner_text() == "<i>hand</i>"
    assert "editor" in window.page.title(), "the page has not been left for the file"
    window.close()


def test_the_view_stays_usable_at_its_extremes(browser, editor):
    window = Window(browser, editor)
    window.still()
    start = window.ask("[player.orbit.distance, player.orbit.azimuth]")
    box = window.page.locator("#view").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    window.page.mouse.move(*middle)
    window.ask("studio.link.ask('select', { what: 'nodes', nodes: [3], how: 'replace' })")
    window.page.keyboard.press("2")
    for wheel in (-4000, 8000):
        for _ in range(20):
            window.page.mouse.wheel(0, wheel)
        window.still()
        assert np.isfinite(window.ask("[player.orbit.distance, ...player.orbit.target]")).all()
        window.drag(middle, (30, 200))
        window.drag(middle, (0, -600))
        window.page.keyboard.down("Shift")
        window.drag((box["x"] + 5, box["y"] + 5), (500, 300))
        window.page.keyboard.up("Shift")
        assert np.isfinite(window.ask("player.view().shift")).all()
    window.page.keyboard.press("Escape")
    window.page.locator("#view").focus()
    window.page.keyboard.press("f")
    window.still()
    assert window.ask("[player.orbit.distance, player.orbit.azimuth]") == start
    assert window.ask("player.places.every(Number.isFinite)")
    window.close()


def test_a_folder_that_can_no_longer_be_written(browser, editor, folder, tmp_path):
    """The page says so, the edit goes on, and is saved when the folder is there again."""
    window = Window(browser, editor)
    window.still()
    status = window.page.locator("#status")
    folder.rename(tmp_path / "away")
    folder.write_text("a file where the folder was")
    window.ask("studio.link.ask('select', { what: 'nodes', nodes: [1, 2], how: 'replace' })")
    window.ask("studio.link.ask('put', { translation: [0, 0, 0.1] })")
    until(lambda: "not saved" in status.inner_text())
    window.ask("studio.link.ask('put', { translation: [0, 0, 0.2] })")
    window.page.keyboard.press("Control+s")
    until(lambda: "cannot be" in window.page.locator("#notes").inner_text())
    assert window.ask("!studio.link.state.unedited && studio.link.state.undo")
    folder.unlink()
    (tmp_path / "away").rename(folder)
    until(lambda: status.inner_text() == "saved")
    assert edit_file.read(folder / "autosave.json", editor.session.engine) == editor.session.edit
    window.close()


def test_all_keys_are_deleted_and_undone(browser, editor):
    window = Window(browser, editor)
    window.still()
    page = window.page
    window.ask("studio.link.ask('select', { what: 'nodes', nodes: [1, 2], how: 'replace' })")
    for row in range(4):
        window.ask("studio.link.ask('put', { at: 0.5 * argument, translation: [0, 0, 0.1 * argument + 0.1] })", row)
        window.ask("studio.link.ask('key', { at: 0.5 * argument })", row)
    keys = page.locator("#tracks .ruler .key")
    until(lambda: keys.count() == 4)
    edit = editor.session.edit
    while keys.count():
        count = keys.count()
        keys.first.click()
        page.keyboard.press("Delete")
        until(lambda count=count: keys.count() == count - 1)
    page.keyboard.press("Delete")
    until(lambda: not window.ask("studio.link.state.handles.length"))
    page.locator("#view").focus()
    for _ in range(5):
        page.keyboard.press("Control+z")
    until(lambda: editor.session.edit == edit)
    until(lambda: keys.count() == 4)
    for _ in range(30):
        page.keyboard.press("Control+z")
    until(lambda: window.ask("studio.link.state.unedited && !studio.link.state.undo"))
    for _ in range(30):
        page.keyboard.press("Control+y")
    until(lambda: window.ask("!studio.link.state.redo") and keys.count() == 0)
    window.close()


def test_a_key_follows_the_arrows_and_escape_leaves_it(browser, editor):
    window = Window(browser, editor)
    window.still()
    page, mouse = window.page, window.page.mouse
    window.ask("studio.link.ask('select', { what: 'nodes', nodes: [1, 2], how: 'replace' })")
    for at in (0.0, 1.0):
        window.ask("studio.link.ask('put', { at: argument, translation: [0, 0, 0.1 * argument + 0.1] })", at)
        window.ask("studio.link.ask('key', { at: argument })", at)
    keys = page.locator("#tracks .ruler .key")
    until(lambda: keys.count() == 2)
    keys.nth(1).focus()
    window.ask("(studio.timeline.shown = null, studio.timeline.show(studio.link.state))")  # another page changed it
    for step in range(1, 4):
        page.keyboard.press("ArrowRight")
        moment = 1.0 + step / editor.session.edit.film.fps
        until(lambda moment=moment: abs(editor.session.edit.keyframes[1].at - moment) < 1e-6)
        until(lambda: page.evaluate("document.activeElement.classList.contains('chosen')"))
    for _ in range(5):
        page.keyboard.press("ArrowLeft")
    window.still()
    assert page.locator("#notes").inner_text() == "", "no key is sent away from where it no longer is"
    frames = (editor.session.edit.keyframes[1].at - 1.0) * editor.session.edit.film.fps
    assert abs(frames + 2.0) < 1e-6, "every press counts, also those before the answer"
    edit, box = editor.session.edit, keys.nth(1).bounding_box()
    mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    mouse.down()
    mouse.move(box["x"] + 90, box["y"] + box["height"] / 2, steps=3)
    page.keyboard.press("Escape")
    mouse.up()
    window.still()
    assert editor.session.edit == edit and keys.nth(1).bounding_box() == box
    assert window.ask("studio.link.state.selection.length") == 2
    window.close()


def test_delete_takes_the_key_that_has_the_focus(browser, editor):
    window = Window(browser, editor)
    window.still()
    page = window.page
    window.ask("studio.link.ask('select', { what: 'nodes', nodes: [1, 2], how: 'replace' })")
    for at in (0.0, 1.0, 2.0):
        window.ask("studio.link.ask('put', { at: argument, translation: [0, 0, 0.1 * argument + 0.1] })", at)
        window.ask("studio.link.ask('key', { at: argument })", at)
    keys = page.locator("#tracks .lane:not(.ruler) .key")
    until(lambda: keys.count() == 3)
    moment = window.ask("player.time")
    for place in (keys.nth(2), page.locator("#tracks .ruler")):
        place.click(button="right")
        assert window.ask("player.time === argument && !studio.timeline.chosen", moment), "another button means a menu"
    keys.nth(1).focus()
    page.keyboard.press("Delete")
    until(lambda: keys.count() != 3)
    assert [frame.at for frame in editor.session.edit.keyframes] == [0.0, 2.0]
    until(lambda: page.evaluate("document.activeElement.its?.at") == 0.0)  # no way back through the whole page
    page.keyboard.press("Enter")
    page.keyboard.press("Escape")
    assert window.ask("studio.timeline.chosen === null && studio.link.state.selection.length === 2")
    page.locator("#view").focus()
    page.keyboard.press("Delete")
    until(lambda: not editor.session.edit.handles)
    window.close()


def test_the_original_is_shown_no_longer_than_it_is_asked_for(browser, editor):
    window = Window(browser, editor)
    window.still()
    page, keys = window.page, window.page.keyboard
    page.locator("#view").focus()
    keys.down("o")
    assert window.ask("player.original") and "without the edit" in page.locator("#hint").inner_text()
    page.evaluate("window.dispatchEvent(new Event('blur'))")  # the key is let go in another window
    assert not window.ask("player.original")
    keys.up("o")
    for shown in (True, False):
        keys.press("Control+k")
        page.locator("#sought").fill("original")
        keys.press("Enter")
        assert window.ask("player.original") == shown, "from the palette, it is no key that is held"
    assert "without the edit" not in page.locator("#hint").inner_text()
    window.close()


def test_controls_that_have_the_focus_keep_their_own_keys_alone(browser, editor):
    window = Window(browser, editor)
    window.still()
    page, keys = window.page, window.page.keyboard
    loop = page.get_by_label("Loop")
    loop.focus()
    keys.press(" ")
    assert not loop.is_checked() and not window.ask("clock.playing")
    page.get_by_role("button", name="Add view").focus()
    keys.press("ArrowRight")
    assert window.ask("Math.round(player.at * player.fps)") == 1, "buttons need no arrows"
    view = "[player.orbit.azimuth, player.orbit.elevation, player.orbit.distance]"
    azimuth, elevation, distance = window.ask(view)
    for key in ("ArrowRight", "ArrowRight", "ArrowDown", "PageDown"):
        keys.press(f"Shift+{key}")
    assert np.allclose(window.ask(view), [azimuth + 0.1, elevation - 0.05, distance / 0.9])
    window.close()


def test_what_is_pressed_while_the_film_plays_stays_where_it_is(browser, editor):
    window = Window(browser, editor)
    window.still()
    place = window.part_on_screen(0)
    window.page.mouse.move(*place)
    window.ask("clock.play(true)")
    window.page.mouse.down()
    assert window.ask("player.tools.drag?.kind") == "pull"
    pressed = window.ask("player.time")
    window.page.evaluate("new Promise((done) => setTimeout(done, 300))")
    assert window.ask("player.time") == pressed, "a click means what it was made on"
    window.page.mouse.up()
    until(lambda: window.ask("player.time") != pressed)
    window.ask("clock.play(false)")
    window.close()


def test_a_drag_that_is_cancelled_before_its_answer_ends_no_later_one(browser, editor):
    window = Window(browser, editor)
    window.still()
    place, mouse = window.part_on_screen(0), window.page.mouse
    window.ask(
        """(() => { const { link } = studio, ask = link.ask.bind(link); let first = true;
        link.ask = (what, ...rest) => { const answer = ask(what, ...rest); if (what !== "grab" || !first) return answer;
          first = false; return new Promise((done) => { window.answer = () => done(answer); }); }; })()"""
    )
    mouse.move(*place)
    mouse.down()
    mouse.move(place[0] + 20, place[1], steps=3)
    until(lambda: window.page.evaluate("Boolean(window.answer)"))
    window.page.keyboard.press("Escape")
    mouse.up()
    mouse.move(*place)
    mouse.down()
    mouse.move(place[0], place[1] - 20, steps=3)
    window.page.evaluate("window.answer()")
    mouse.up()
    window.still()
    assert not editor.model.dragging and not window.ask("studio.link.state.undo"), "the first is taken back whole"
    window.drag(window.part_on_screen(0), (0.0, -20.0))
    until(lambda: window.ask("studio.link.state.undo"))
    window.close()


def test_downloads_are_offered_until_they_are_closed(browser, editor):
    window = Window(browser, editor)
    window.still()
    window.ask("(window.setTimeout = (run) => run(), studio.offer('film.mp4', 'Film'))")  # no note is left in time
    link = window.page.get_by_role("link", name="film.mp4")
    assert link.count() == 1 and link.get_attribute("href") == "file/film.mp4"
    window.page.get_by_role("button", name="Close this note").click()
    assert link.count() == 0
    window.close()


def test_fields_show_the_edit_unless_something_is_being_typed(browser, editor):
    window = Window(browser, editor)
    window.still()
    window.ask("studio.link.ask('select', { what: 'nodes', nodes: [1, 2], how: 'replace' })")
    field = window.page.get_by_label("Move, x")
    field.fill("0.5")
    field.press("Enter")
    until(lambda: window.ask("studio.link.state.target.translation[0]") == 0.5)
    field.press("Control+z")
    until(lambda: window.ask("studio.link.state.target.translation[0]") == 0)
    assert field.input_value() == "0"
    field.fill("7")
    window.ask("studio.link.ask('tool', { rings: 3 })")
    assert field.input_value() == "7"
    field.fill("")
    field.press("Tab")
    assert field.input_value() == "0", "an empty field sets nothing"
    window.close()


def test_the_scene_is_drawn_again_when_the_graphics_driver_comes_back(browser, editor):
    window = Window(browser, editor)
    window.still()
    view, alert = window.page.locator("#view"), window.page.get_by_role("alert")
    before = view.screenshot()
    lose_context(window.page)
    assert "reload the page" in alert.inner_text()
    window.page.mouse.move(400, 300)
    window.ask("studio.picture()")
    assert "reload the page" in window.page.locator("#notes").inner_text()
    restore_context(window.page)
    window.page.mouse.move(5, 5)
    until(alert.is_hidden)
    until(lambda: window.page.locator("#notes li").count() == 0)
    window.still()
    assert view.screenshot() == before
    window.close()


@pytest.mark.parametrize("title", ["x" * 150, "run 1.", "a" * 99 + " b", "右腕", "..hidden", "Ångström."])
def test_copies_are_saved_under_a_name_that_follows_from_any_title(browser, editor, folder, title):
    window = Window(browser, editor)
    window.still()
    window.ask("(studio.title = argument, studio.save())", title)
    until(window.page.locator("#notes").inner_text)
    assert "is done" in window.page.locator("#notes").inner_text()
    names = {path.name for path in folder.glob("[!.]*.json")} - {"autosave.json"}
    assert len(names) == 1 and len(names.pop()) <= 105
    window.close()


def test_high_contrast_shows_the_tool_and_the_moment(browser, editor):
    window = Window(browser, editor, forced_colors="active")
    window.still()
    window.ask("studio.link.ask('select', { what: 'nodes', nodes: [1, 2], how: 'replace' })")
    window.ask("studio.link.ask('put', { translation: [0, 0, 0.1] })")
    window.page.keyboard.press("k")
    until(lambda: window.page.locator("#tracks .key").count() == 2)
    pressed, other, head, key, lane = window.page.evaluate(
        """['[aria-pressed="true"]', '[aria-pressed="false"]', "#head", "#tracks .key", "#tracks .ruler"].map(
        (place) => getComputedStyle(document.querySelector(place)).backgroundColor)"""
    )
    assert pressed != other and lane not in (head, key)
    window.close()
