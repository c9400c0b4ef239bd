"""Parts that a user renames, merges and splits in the page, whatever the names."""

from __future__ import annotations

import pytest

from helpers.editor_windows import Window, until
from helpers.node_packages import package

pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")
ODD = ["<img src=x onerror='window.harmed = 1'>", "\U0001f44b\U0001f3fd left", "יד שמאל", "x" * 100]


def name_it(window: Window, name: str) -> None:
    """Type a name into the open dialog."""
    window.page.locator("#newname").fill(name)
    window.page.keyboard.press("Enter")


def closed(window: Window) -> bool:
    return not window.page.locator("#changes").is_visible()


def test_a_part_is_renamed_by_key_double_click_and_palette(browser, editor):
    window = Window(browser, editor)
    window.still()
    page, session = window.page, editor.session
    assert page.locator("#chosen").is_hidden()
    first, place = window.choose_limb()
    page.keyboard.press("F2")
    assert page.locator("#newname").input_value() == first
    others = [part.name for part in session.parts() if part.name != first]
    for wrong, words in ((others[0], "is taken"), ("  ", "no name"), ("x" * 200, "no name")):
        name_it(window, wrong)
        until(lambda words=words: words in page.locator("#refused").inner_text())
        assert page.locator("#notes li").count() == 0, "it is said where one types, and there alone"
    source = (package("axe-core") / "axe.min.js").read_text(encoding="utf-8")
    page.evaluate(source)
    for theme in ("dark", "light"):
        window.ask("studio.theme(argument)", theme)
        assert page.evaluate("axe.run('#changes').then((r) => r.violations.map((v) => v.id))") == [], theme
    name_it(window, "left foot")
    until(lambda: closed(window) and page.locator("#chosen").inner_text() == "left foot")
    assert "left foot" in [part.name for part in session.parts()]

    window.drag(place, (20, -30))
    assert window.ask("studio.link.state.part") == "left foot"
    track = page.locator("#tracks .name", has_text="left foot")
    until(lambda: track.count() == 1)
    page.keyboard.press(" ")
    until(lambda: window.ask("clock.playing"))
    track.dblclick()
    name_it(window, "foot")
    until(lambda: page.locator("#tracks .name", has_text="foot").inner_text() == "foot")
    assert window.ask("clock.playing"), "renamed while it plays"
    page.locator("#view").focus()
    page.keyboard.press(" ")

    page.keyboard.press("Control+k")
    page.locator("#sought").fill("rename")
    page.keyboard.press("Enter")
    name_it(window, "sole")
    until(lambda: page.locator("#chosen").inner_text() == "sole")
    for name in ("foot", "left foot"):
        page.locator("#view").focus()
        page.keyboard.press("Control+z")
        until(lambda name=name: page.locator("#chosen").inner_text() == name)
    until(lambda: page.locator("#status").inner_text() == "saved")
    window.close()


def test_a_double_click_holds_though_tracks_are_drawn_anew(browser, editor):
    window = Window(browser, editor)
    window.still()
    page = window.page
    name, place = window.choose_limb()
    window.drag(place, (20, -30))
    track = page.locator(f"#tracks [data-handle={name}]")
    until(lambda: track.count() == 1)
    box = track.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.up()
    page.mouse.down(click_count=2)
    window.ask("studio.link.ask('key', { at: 0.5 })")
    until(lambda: page.locator("#tracks .key").count() > 1)
    page.mouse.up(click_count=2)
    assert page.locator("#newname").input_value() == name
    name_it(window, "foot")
    until(lambda: closed(window) and page.locator("#chosen").inner_text() == "foot")
    window.close()


def test_names_are_text_and_do_not_break_the_page(browser, editor):
    window = Window(browser, editor, size={"width": 390, "height": 844})
    window.still()
    page = window.page
    window.choose_limb()
    window.ask("studio.link.ask('put', { degrees: [0, 0, 5] })")
    window.ask("studio.link.ask('key', { at: 0 })")
    for name in ODD:
        page.locator("#chosen").click()
        name_it(window, name)
        until(lambda name=name: closed(window) and window.ask("studio.link.state.part") == name)
        for place in ("#chosen", "#tracks .name:nth-of-type(n + 2)"):
            assert page.locator(place).first.inner_text() == name, place
        assert name in page.get_by_label("Part", exact=True).locator("option").all_inner_texts() or window.ask(
            "document.body.classList.contains('folded')"
        )
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        box = page.locator("#chosen").bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= 390
    assert page.evaluate("window.harmed") is None
    window.close()


def test_parts_are_split_and_merged_in_the_page(browser, editor):
    window = Window(browser, editor)
    window.still()
    page, session = window.page, editor.session
    name, place = window.choose_limb()
    count = len(session.parts())
    page.keyboard.press("3")
    page.keyboard.press("Escape")
    until(lambda: not window.ask("studio.link.state.selection.length"))
    window.ask("studio.link.ask('tool', { rings: 0 })")
    window.still()  # the arrows of the part are no longer drawn, and cannot be hit
    page.mouse.click(*place)
    until(lambda: window.ask("studio.link.state.selection.length") == 1)
    assert page.locator("#chosen").inner_text() == "1 control point"
    page.get_by_role("button", name="Split", exact=True).first.click()
    name_it(window, "toe")
    until(lambda: closed(window) and window.ask("studio.tools.parts.length") == count + 1)
    assert window.ask("studio.link.state.part") == "toe" and session.skeleton.part("toe").parent == name
    page.keyboard.press("1")
    page.mouse.move(*place)
    until(lambda: window.ask("player.tools.lit") == count)
    page.get_by_role("button", name="Merge", exact=True).first.click()
    assert name in page.locator("#other option").all_inner_texts()
    page.locator("#other").select_option(name)
    page.locator("#doit").click()
    until(lambda: closed(window) and window.ask("studio.tools.parts.length") == count)
    page.locator("#view").focus()
    for _ in range(2):
        page.keyboard.press("Control+z")
    until(lambda: len(session.parts()) == count)
    until(lambda: window.ask("studio.tools.parts.map((part) => part.name)") == [part.name for part in session.parts()])
    window.close()


def test_two_tabs_drag_at_once(browser, editor):
    """The second is told, and neither loses anything."""
    first = Window(browser, editor)
    second = Window(browser, editor)
    first.still()
    second.still()
    part = first.lowest_limb()
    x, y = first.part_on_screen(part)
    first.page.mouse.move(x, y)
    first.page.mouse.down()
    first.page.mouse.move(x + 20, y - 20, steps=4)
    until(lambda: first.ask("studio.link.state.dragging && !studio.link.state.unedited"))
    second.page.mouse.move(x, y)
    second.page.mouse.down()
    second.page.mouse.move(x - 40, y, steps=4)
    until(lambda: "another page drags" in second.page.locator("#notes").inner_text())
    second.page.mouse.up()
    second.page.keyboard.press("F2")
    name_it(second, "mine")
    until(lambda: "another page drags" in second.page.locator("#refused").inner_text())
    second.page.keyboard.press("Escape")
    first.page.mouse.move(x + 30, y - 30, steps=2)
    first.page.mouse.up()
    first.still()
    assert first.ask("studio.link.state.handles.length") > 0 and not second.ask("Boolean(studio.tools.drag)")
    target = editor.session.edit.targets
    until(lambda: second.ask("studio.link.state.part") == first.ask("studio.link.state.part"))
    second.drag((x + 30, y - 30), (-20, 0))
    assert editor.session.edit.targets != target, "now it may"
    for window in (second, first):
        window.close()
