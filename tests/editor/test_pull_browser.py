"""A hand raised by the mouse alone, beside the same pull by a script."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from helpers.edit_scenes import figure_scene
from helpers.editor_windows import Window, until
from helpers.touch import Touch
from scgs_warp.edit import EditSession
from scgs_warp.geometry.cameras import orbit_camera
from scgs_warp.rendering.render import render
from scgs_warp.scene.scene import Scene

pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")
HAND = (-0.43, -0.2, -0.5)
GESTURES = 3
RISE = 0.5
"""Share of the figure's height by which the tip of the hand rises; the arm stretched upwards raises it by 0.55."""
UP, ASIDE = 0.8, 0.15
"""Shares of the height by which a drag moves the pointer: beyond the arm's reach, and past the head."""


@pytest.fixture(scope="module")
def figure() -> Scene:
    """The built-in figure as the page of a trained run first shows it."""
    scene = figure_scene(nodes=200, points=4000)[0]
    scene.overview = dataclasses.replace(scene.overview, azimuth=233.9, elevation=26.3)
    return scene


def arm_mask(session: EditSession, nodes: list[int]) -> np.ndarray:
    """[H, W] bool: where the view with which the page begins shows the Gaussians of some control points."""
    gaussians = session.gaussians_at(0.0)
    mine = torch.isin(session.engine.binding[0][:, 0].long(), torch.tensor(nodes))
    camera = orbit_camera(session.scene.overview, session.scene.overview.azimuth, 300)
    shown = dataclasses.replace(gaussians, opacities=torch.where(mine, gaussians.opacities, 0.0))
    return render(shown, camera, torch.zeros(3)).alpha.detach().numpy() > 0.5


def test_the_right_hand_is_raised_by_half_the_height_of_the_figure(browser, editor):
    window, session = Window(browser, editor), editor.session
    window.still()

    def places() -> np.ndarray:
        return editor.worker.call(lambda: session.node_positions(0.0))

    begin = places()
    height = np.ptp(begin[:, 2])
    hand = session.part_at(HAND, 0.0)
    tip = min(session.skeleton.part(hand).nodes, key=lambda node: begin[node, 2])
    arm = {*session.chain(hand)}
    for _ in session.parts():  # with what hangs on it
        arm |= {part.name for part in session.parts() if part.parent in arm}
    nodes = sorted(node for name in arm for node in session.skeleton.part(name).nodes)
    right, down, _ = orbit_camera(session.scene.overview, session.scene.overview.azimuth, 300).viewmat[:3, :3].numpy()
    goal = begin[tip] - height * (UP * down + ASIDE * right)
    window.ask(
        """(() => { const { link } = studio, tell = link.tell.bind(link); window.drags = [];
        link.tell = (what, fields) => { if (what === "drag") window.drags.push(fields); tell(what, fields); }; })()"""
    )
    rise = gestures = 0.0
    while rise < RISE * height and gestures < GESTURES:
        x, y = window.on_screen(places()[tip])
        there = window.on_screen(goal)
        window.drag((x, y), (there[0] - x, there[1] - y))
        assert window.ask("studio.link.state.part") == hand
        until(lambda: not window.ask("studio.link.state.unedited"))
        rise, gestures = float((places() - begin)[tip, 2]), gestures + 1
    assert rise >= RISE * height, f"{rise / height:.2f} of the height in {gestures} drags"

    script, drags = EditSession(session.scene), window.page.evaluate("window.drags")
    script.parts()
    for pull in {tuple(drag["grip"]): drag for drag in drags}.values():  # the last message of each drag
        script.pull(hand, pull["to"], 0.0, pull["grip"])
    by_mouse = editor.worker.call(lambda: arm_mask(session, nodes))
    by_script, before = arm_mask(script, nodes), arm_mask(EditSession(session.scene), nodes)
    overlap = (by_mouse & by_script).sum() / (by_mouse | by_script).sum()
    print(f"{rise / height:.2f} of the height in {gestures:.0f} drags, IoU {overlap:.3f}")
    assert overlap >= 0.9 and (by_mouse & before).sum() / (by_mouse | before).sum() < 0.5, "and it has moved"
    rest = np.setdiff1d(np.arange(len(begin)), nodes)
    assert np.abs(places() - begin)[rest].max() < 0.05 * height, "the chest stays"
    window.close()


def test_a_pinch_that_begins_on_a_part_changes_the_view(browser, editor):
    window = Window(browser, editor, has_touch=True)
    window.still()
    x, y = window.part_on_screen(window.lowest_limb())
    fingers, distance = Touch(window.context, window.page), window.ask("player.orbit.distance")
    fingers.at("touchStart", (x, y))
    fingers.at("touchMove", (x + 1, y - 1))
    fingers.at("touchStart", (x + 1, y - 1), (x + 60, y - 60))
    fingers.at("touchMove", (x - 20, y + 20), (x + 90, y - 90))
    fingers.at("touchEnd")
    window.still()
    assert window.ask("player.orbit.distance") < 0.9 * distance
    until(lambda: window.ask("studio.link.state.unedited && !studio.link.state.undo"))
    window.close()


def test_points_are_chosen_without_a_keyboard(browser, editor):
    """Phones have no Shift."""
    window = Window(browser, editor, has_touch=True)
    window.still()
    window.page.keyboard.press("3")
    window.page.locator("summary", has_text="Control points").click()
    window.page.get_by_label("A drag").select_option("chooses")
    x, y = window.part_on_screen(window.lowest_limb())
    fingers = Touch(window.context, window.page)

    fingers.at("touchStart", (x - 40, y - 40))
    for corner in ((x + 40, y - 40), (x + 40, y + 40), (x - 40, y + 40)):
        fingers.at("touchMove", corner)
    fingers.at("touchEnd")
    until(lambda: window.ask("studio.link.state.selection.length") > 2)
    window.close()


def test_tracks_scroll_under_a_finger(browser, editor):
    for node in range(8):
        editor.session.add_handle([node], 0.0, f"handle {node}")
    window = Window(browser, editor, size={"width": 360, "height": 640}, has_touch=True)
    window.still()
    fingers = Touch(window.context, window.page)

    def draw(right: float, down: float) -> None:
        box = window.page.locator("#tracks").bounding_box()
        x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.75 * box["height"]
        fingers.at("touchStart", (x, y))
        for step in range(1, 6) if right or down else ():
            fingers.at("touchMove", (x + 0.2 * step * right, y + 0.2 * step * down))
        fingers.at("touchEnd")

    draw(0, -50)
    until(lambda: window.page.evaluate("document.getElementById('tracks').scrollTop") > 20)
    assert window.ask("player.time") == 0, "a finger that scrolls leaves the time"
    draw(0, 0)
    until(lambda: window.ask("player.time") > 0.2)
    tapped = window.ask("player.time")
    draw(60, 0)
    until(lambda: window.ask("player.time") > tapped + 0.1)
    window.close()
