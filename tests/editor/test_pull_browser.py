"""A hand raised by the mouse alone, beside the same pull by a script."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from helpers.editor_windows import Window, until
from scgs_warp.edit import EditSession
from scgs_warp.geometry.cameras import orbit_camera
from scgs_warp.rendering.render import render

pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")
HAND = (0.6, 0.0, -0.3)
GESTURES = 3
RISE = 0.22
"""Share of the figure's height. Its arm is short: stretched upwards, it raises the hand by a third of the height."""


def arm_mask(session: EditSession, nodes: list[int]) -> np.ndarray:
    """[H, W] bool: where the view with which the page begins shows the Gaussians of some control points."""
    gaussians = session.gaussians_at(0.0)
    mine = torch.isin(session.engine.binding[0][:, 0].long(), torch.tensor(nodes))
    camera = orbit_camera(session.scene.overview, session.scene.overview.azimuth, 300)
    shown = dataclasses.replace(gaussians, opacities=torch.where(mine, gaussians.opacities, 0.0))
    return render(shown, camera, torch.zeros(3)).alpha.detach().numpy() > 0.5


def test_a_hand_is_raised_above_the_shoulder(browser, editor):
    window, session = Window(browser, editor), editor.session
    window.still()

    def places() -> np.ndarray:
        return editor.worker.call(lambda: session.node_positions(0.0))

    begin = places()
    height = np.ptp(begin[:, 2])
    tip = int(np.linalg.norm(begin - HAND, axis=1).argmin())
    names = [part.name for part in session.parts()]
    (row,) = (row for row, part in enumerate(session.parts()) if tip in part.nodes)
    arm = session.chain(names[row])
    nodes = sorted(node for name in {*arm, names[row]} for node in session.skeleton.part(name).nodes)
    pixels = window.ask(
        "player.view().lens[1] / player.orbit.distance * player.canvas.clientHeight / player.canvas.height"
    )
    window.ask(
        """(() => { const { link } = studio, tell = link.tell.bind(link); window.drags = [];
        link.tell = (what, fields) => { if (what === "drag") window.drags.push(fields); tell(what, fields); }; })()"""
    )
    rise = gestures = 0.0
    while rise < RISE * height and gestures < GESTURES:
        window.drag(window.part_on_screen(row), (0, -pixels * ((RISE + 0.02) * height - rise)))
        until(lambda: not window.ask("studio.link.state.unedited"))
        rise, gestures = float((places() - begin)[tip, 2]), gestures + 1
    assert rise >= RISE * height, f"{rise / height:.2f} of the height in {gestures} drags"

    script, drags = EditSession(session.scene), window.page.evaluate("window.drags")
    script.parts()
    for pull in {tuple(drag["grip"]): drag for drag in drags}.values():  # the last message of each drag
        script.pull(names[row], pull["to"], 0.0, pull["grip"])
    by_mouse = editor.worker.call(lambda: arm_mask(session, nodes))
    by_script, before = arm_mask(script, nodes), arm_mask(EditSession(session.scene), nodes)
    overlap = (by_mouse & by_script).sum() / (by_mouse | by_script).sum()
    print(f"{rise / height:.2f} of the height in {gestures:.0f} drags, IoU {overlap:.3f}")
    assert overlap >= 0.9 and (by_mouse & before).sum() / (by_mouse | before).sum() < 0.5, "and it has moved"
    rest = np.setdiff1d(np.arange(len(begin)), nodes)
    assert np.abs(places() - begin)[rest].max() < 0.05 * height, "the chest stays"
    window.close()
