"""The rings that turn parts, and what is up, in a real browser."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.editor_windows import Window, until

pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")


def test_rings_turn_a_part_about_its_joint(browser, editor):
    window = Window(browser, editor)
    window.still()
    name, _ = window.choose_limb()
    window.page.keyboard.press("2")
    window.still()
    _, start, end = window.rings(8, 14)
    window.drag(start, (end[0] - start[0], end[1] - start[1]))
    until(lambda: not window.ask("studio.link.state.unedited"))
    target = editor.session.edit.targets[editor.session.edit.handles[-1].name]
    angle = np.degrees(2 * np.arccos(min(1.0, abs(target.rotation[0]))))
    assert abs(angle - 6 * 360 / 64) < 5, "six of the ring's 64 steps, seen from the side as well"
    assert editor.session.edit.handles[-1].part == name
    window.page.keyboard.press("Escape")
    until(lambda: window.ask("studio.link.state.part") is None)
    window.close()


def test_the_pivot_of_the_rings_is_dragged_to_another_point(browser, editor):
    """The rings turn the part about the point of the surface on which the dot was dropped; "." puts it back."""
    window = Window(browser, editor)
    window.still()
    name, middle = window.choose_limb()
    window.page.keyboard.press("2")
    window.still()
    joint, *_ = window.rings()
    window.drag(joint, (middle[0] - joint[0], middle[1] - joint[1]))
    pivot, start, end = window.rings(8, 14)
    assert window.ask("studio.link.state.unedited"), "only the pivot has moved"
    assert np.hypot(pivot[0] - middle[0], pivot[1] - middle[1]) < 1.5
    about = np.array(window.ask("player.tools.world(player.tools.pivot.place())"))
    session = editor.session
    before = session.node_positions(0.0)[list(session.skeleton.part(name).nodes)]
    window.drag(start, (end[0] - start[0], end[1] - start[1]))
    until(lambda: not window.ask("studio.link.state.unedited"))
    turned = session._motion_of(session.edit, name, 0.0, None)[0]
    centre, scale = session.engine.units
    fixed = session.engine.to_world(turned.apply((about - centre) * scale))
    assert np.linalg.norm(fixed - about) < 1e-6 * np.ptp(before)
    after = session.engine.to_world(turned.apply((before - centre) * scale))
    assert np.linalg.norm(after - before, axis=1).max() > 0.02
    pivot, *_ = window.rings()
    assert np.hypot(pivot[0] - middle[0], pivot[1] - middle[1]) < 8, "it stays on the surface"
    window.page.keyboard.press(".")
    assert window.ask("player.tools.pivot.place()") is None
    window.page.keyboard.press("Escape")
    until(lambda: window.ask("studio.link.state.part") is None)
    window.close()


def test_the_upright_axis_turns_the_view(browser, editor):
    window = Window(browser, editor)
    window.still()
    window.page.locator("summary", has_text="View").click()
    window.page.get_by_label("Upright axis").select_option("x")
    until(lambda: editor.session.edit.film.shot.up == (1.0, 0.0, 0.0))
    until(lambda: window.ask("player.view().rows[1]")[0] < -0.8)  # the image's down is against x
    window.close()
