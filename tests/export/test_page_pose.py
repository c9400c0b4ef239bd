"""Pages whose parts are pulled: pictures beside the session's, and what mouse, touch and keys do."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.chromium import chromium
from helpers.edit_scenes import figure_scene
from helpers.page_visits import Visit, psnr, until
from helpers.touch import Touch
from scgs_warp.edit import EditSession
from scgs_warp.export.page import write_page
from scgs_warp.export.page_edit import own_motion
from scgs_warp.export.page_pose import posable
from scgs_warp.geometry.cameras import orbit_camera


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def figure(tmp_path_factory) -> tuple[EditSession, Path]:
    session = EditSession(figure_scene(nodes=200, points=5000)[0])
    path = tmp_path_factory.mktemp("pose") / "figure.html"
    write_page(session.scene, path, motion=posable(session, own_motion(session)))
    return session, path


def limbs(session: EditSession) -> list[str]:
    """Parts at the ends of chains of two."""
    return [part.name for part in session.parts() if len(session.chain(part.name)) > 1]


def row(session: EditSession, name: str) -> int:
    return [part.name for part in session.parts()].index(name)


def test_turned_parts_look_as_the_session_turns_them(browser, figure):
    session, path = figure
    visit = Visit(browser, path)
    for time, degrees in ((0.0, 70.0), (0.5, -50.0), (0.8, 40.0)):
        session.reset()
        names = limbs(session)[:2] if time else limbs(session)[2:3]
        for name in names:
            session.turn(name, degrees, session.skeleton.part(name).axis or (0.0, 0.0, 1.0), time=0.0)
        turns = {h.part: session.edit.targets[h.name].rotation for h in session.edit.handles if h.part in names}
        visit.ask(
            "(player.figure.reset(), argument.forEach(([row, turn]) => { player.figure.turns[row] = turn; }))",
            [[row(session, name), list(turn)] for name, turn in turns.items() if name],
        )
        camera = orbit_camera(session.scene.overview, 30.0 + 100 * time, 160)
        ours = session.render(camera, time, background=(0, 0, 0)).rgb.clamp(0, 1).numpy()
        plain = session.scene.render(camera, time, (0, 0, 0)).rgb.clamp(0, 1).numpy()
        assert psnr(visit.render(camera, time), ours) > 45 and psnr(plain, ours) < 30
    assert visit.problems == [] and [url for url in visit.requests if not url.startswith(("file:", "blob:"))] == []
    visit.context.close()


@pytest.mark.parametrize("degrees", [70.0, 130.0])
def test_control_points_bend_as_those_of_the_session(degrees, browser, figure):
    session, path = figure
    visit, unit = Visit(browser, path), session.scene.normalisation
    for name in limbs(session)[:3]:
        session.reset()
        session.turn(name, degrees, session.skeleton.part(name).axis or (0.0, 0.0, 1.0))
        turn = session.edit.targets[session.edit.handles[0].name].rotation
        found = visit.ask(
            """(() => { const { figure } = player;
            figure.reset();
            figure.turns[argument[0]] = argument[1];
            player.pose(0, new Float32Array(player.table.length), true);
            return Array.from(figure.shape.points); })()""",
            [row(session, name), list(turn)],
        )
        points = (session.node_positions(0.0) - unit.centre.tolist()) * unit.scale
        apart = np.linalg.norm(np.reshape(found, (-1, 3)) - points, axis=1) / session.graph.edge_length
        assert apart.max() < 6e-3
    visit.context.close()


def test_a_part_keeps_its_turn_when_what_hangs_on_it_turns_too(browser, figure):
    session, path = figure
    visit, unit = Visit(browser, path), session.scene.normalisation
    for name in limbs(session)[:3]:
        session.reset()
        session.turn(session.chain(name)[1], 60.0, (0.0, 1.0, 0.0))
        session.turn(name, 5.0, (1.0, 0.0, 0.0))
        turns = [[row(session, h.part), list(session.edit.targets[h.name].rotation)] for h in session.edit.handles]
        found = visit.ask(
            """(() => { const { figure } = player;
            figure.reset();
            for (const [row, turn] of argument) figure.turns[row] = turn;
            player.pose(0, new Float32Array(player.table.length), true);
            return Array.from(figure.shape.points); })()""",
            turns,
        )
        points = (session.node_positions(0.0) - unit.centre.tolist()) * unit.scale
        apart = np.linalg.norm(np.reshape(found, (-1, 3)) - points, axis=1) / session.graph.edge_length
        assert apart.max() < 6e-3
    visit.context.close()


def test_a_pull_is_that_of_the_session(browser, figure):
    session, path = figure
    session.reset()
    name = limbs(session)[0]
    grip = session.node_positions(0.3)[list(session.skeleton.part(name).nodes)].mean(0)
    unit = session.scene.normalisation
    to = grip + np.array([0.15, -0.2, 0.25])
    session.pull(name, to, 0.3, grip)
    visit = Visit(browser, path)
    camera = orbit_camera(session.scene.overview, 20.0, 160)
    visit.ask("player.seek(0.3)")
    until(visit.idle)
    points = [((np.asarray(p) - unit.centre.tolist()) * unit.scale).tolist() for p in (grip, to)]
    visit.ask("player.figure.pull(argument[0], argument[1])(argument[2])", [row(session, name), *points])
    ours = session.render(camera, 0.3, background=(0, 0, 0)).rgb.clamp(0, 1).numpy()
    assert psnr(visit.render(camera, 0.3), ours) > 40
    visit.context.close()


def place(visit: Visit, part: int) -> tuple[float, float]:
    """Where the middle of a part is on the screen."""
    x, y = visit.ask(
        """(() => { const { figure: f } = player, v = player.view(), sum = [0, 0, 0]; let n = 0;
        const points = f.posed && f.shape ? f.shape.points : f.now;
        for (let m = 0; m < f.count; m++) if (f.owner[m] === argument) { n++;
          for (let a = 0; a < 3; a++) sum[a] += points[3 * m + a]; }
        const [x, y, z] = v.rows.map((r, k) => (r[0] * sum[0] + r[1] * sum[1] + r[2] * sum[2]) / n + v.shift[k]);
        return [v.lens[0] * x / z + v.lens[2], v.lens[1] * y / z + v.lens[3]]; })()""",
        part,
    )
    return x, y


def lowest_limb(session: EditSession, visit: Visit) -> int:
    """The foot that nothing hides: it reaches places above it."""
    rows = [row(session, name) for name in limbs(session)]
    seen = [part for part in rows if visit.ask("player.hand.find(...argument)?.row ?? -1", place(visit, part)) == part]
    return max(seen, key=lambda part: place(visit, part)[1])


@pytest.mark.parametrize("kind", ["mouse", "touch"])
def test_a_foot_is_pulled_by(kind, browser, figure):
    session, path = figure
    visit = Visit(browser, path, "?paused&t=0", has_touch=kind == "touch")
    until(visit.idle)
    part = lowest_limb(session, visit)
    x, y = place(visit, part)
    azimuth = visit.ask("player.orbit.azimuth")
    if kind == "mouse":
        visit.page.mouse.move(x, y)
        until(lambda: visit.ask("player.hand.lit") == part)
        visit.page.mouse.down()
        visit.page.mouse.move(x + 20, y - 50, steps=4)
        visit.page.mouse.up()
    else:
        touch = visit.context.new_cdp_session(visit.page)
        for event, points in (
            ("touchStart", [{"x": x, "y": y}]),
            ("touchMove", [{"x": x + 10, "y": y - 25}]),
            ("touchMove", [{"x": x + 20, "y": y - 50}]),
            ("touchEnd", []),
        ):
            touch.send("Input.dispatchTouchEvent", {"type": event, "touchPoints": points})
    until(lambda: visit.ask("player.figure.posed && !player.hand.drag"))
    until(visit.idle)
    moved = np.array(place(visit, part)) - (x, y)
    assert np.linalg.norm(moved - (20, -50)) < 25, "the part follows the pointer"
    assert visit.ask("player.orbit.azimuth") == azimuth, "and the view stays"
    assert visit.ask("player.hand.past.length") == 1
    visit.page.locator("#view").focus()
    visit.page.keyboard.press("Control+z")
    assert not visit.ask("player.figure.posed")
    visit.page.mouse.move(20, 300)
    visit.page.mouse.down()
    visit.page.mouse.move(60, 300)
    visit.page.mouse.up()
    assert visit.ask("player.orbit.azimuth") != azimuth, "the background turns the view"
    assert visit.problems == []
    visit.context.close()


def test_escape_and_the_button_take_back(browser, figure):
    session, path = figure
    visit = Visit(browser, path)
    until(visit.idle)
    part = lowest_limb(session, visit)
    x, y = place(visit, part)
    mouse = visit.page.mouse
    mouse.move(x, y)
    mouse.down()
    mouse.move(x, y - 40, steps=3)
    until(lambda: visit.ask("player.figure.posed"))
    visit.page.keyboard.press("Escape")
    assert not visit.ask("player.figure.posed") and not visit.ask("Boolean(player.hand.drag)")
    mouse.up()
    until(visit.idle)
    mouse.move(x, y)
    mouse.down()
    mouse.move(x, y - 40, steps=3)
    mouse.up()
    visit.page.get_by_role("button", name="Settings").click()
    visit.page.get_by_role("button", name="Reset pose").click()
    assert not visit.ask("player.figure.posed") and visit.page.get_by_role("button", name="Reset pose").is_disabled()
    assert float(visit.page.locator("#restore").evaluate("(one) => getComputedStyle(one).opacity")) < 1, "and looks so"
    visit.context.close()


def test_a_pinch_that_begins_on_a_part_changes_the_view(browser, figure):
    """Fingers of a hand never land at once; a finger that comes later leaves the pull alone."""
    session, path = figure
    visit = Visit(browser, path, "?paused&t=0", has_touch=True)
    until(visit.idle)
    x, y = place(visit, lowest_limb(session, visit))
    fingers = Touch(visit.context, visit.page)
    distance = visit.ask("player.orbit.distance")
    fingers.at("touchStart", (x, y))
    fingers.at("touchMove", (x + 1, y - 1))
    assert visit.ask("player.hand.drag !== null")
    fingers.at("touchStart", (x + 1, y - 1), (x + 60, y - 60))
    fingers.at("touchMove", (x - 20, y + 20), (x + 90, y - 90))
    fingers.at("touchEnd")
    until(visit.idle)
    assert visit.ask("player.orbit.distance") < 0.9 * distance
    assert not visit.ask("player.figure.posed") and visit.ask("player.hand.past.length") == 0

    visit.ask("player.orbit.reset(), player.changed()")
    until(visit.idle)
    fingers.at("touchStart", (x, y))
    fingers.at("touchMove", (x + 10, y - 25))
    visit.page.wait_for_timeout(600)
    fingers.at("touchStart", (x + 10, y - 25), (30, 30))
    fingers.at("touchMove", (x + 20, y - 50), (60, 60))
    fingers.at("touchEnd")
    until(visit.idle)
    assert visit.ask("player.figure.posed") and visit.ask("player.orbit.distance") == distance
    assert visit.problems == []
    visit.context.close()
