"""Pages of edits: what they hold, and their pictures beside the session's."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

from helpers.chromium import chromium
from helpers.edit_scenes import bar_scene
from helpers.page_visits import Visit, psnr
from scgs_warp.edit import Edit, EditSession, Exaggerate, Hold
from scgs_warp.edit.filming import film_camera
from scgs_warp.editor.model import Moment
from scgs_warp.editor.poses import pose_table
from scgs_warp.export.page import write_page
from scgs_warp.export.page_edit import edited_motion, film_times, own_motion
from scgs_warp.export.page_pose import posable


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


def bent_session(**options: Any) -> EditSession:
    """A session whose film lifts and turns one end of the bar, and whose motion swings."""
    session = EditSession(bar_scene(**options))
    end = session.within(session.node_positions(0.0)[session.node_positions(0.0)[:, 0].argmin()], 0.5, 0.0)
    session.add_handle(end, 0.0, "end")
    session.add_keyframe(0.0)
    session.move("end", (0.0, 0.1, 0.3), (0.924, 0.0, 0.383, 0.0))
    session.add_keyframe(1.0, "ease")
    film = dataclasses.replace(session.edit.film, seconds=2.0, fps=10.0, background=(0.2, 0.3, 0.1))
    playback = dataclasses.replace(session.edit.playback, repeat="swing", speed=2.0)
    session.apply(dataclasses.replace(session.edit, film=film, playback=playback))
    return session


@pytest.mark.parametrize("options", [{"shaded": True, "corrected": True}, {}], ids=["learnt shading", "harmonics"])
def test_frames_of_an_edit_are_those_of_the_session(browser, options, tmp_path):
    """Colours turn with the edit, shading and correctives do not."""
    session = bent_session(**options)
    write_page(session.scene, tmp_path / "page.html", motion=edited_motion(session))
    visit = Visit(browser, tmp_path / "page.html")
    assert visit.ask("player.seconds") == 2.0 and visit.ask("player.follows")
    for at in (0.0, 0.5, 0.95, 1.3, 1.9):  # of which the third lies between two frames
        camera = film_camera(session, at, 120)
        background = session.edit.film.background
        assert background is not None
        ours = session.render(camera, session.scene_time(at), at, background).rgb.clamp(0, 1).numpy()
        assert psnr(visit.render(camera, at / 2.0, background), ours) > 45, at
        plain = session.scene.render(camera, session.scene_time(at), background).rgb.clamp(0, 1).numpy()
        assert at == 0.0 or psnr(plain, ours) < 35, "the edit shows"
    visit.page.keyboard.press("h")
    assert visit.page.get_by_text("follows the film's camera").is_visible(), "the help names the key"
    visit.page.keyboard.press("Escape")
    visit.ask("player.seek(0.65)")
    visit.ask("player.frame()")
    seen = visit.ask("player.orbit.camera(512, 512).viewmat")
    assert np.allclose(seen, film_camera(session, 1.3, 512).viewmat, atol=1e-3), "the page looks as the film does"
    visit.page.mouse.move(300, 200)
    visit.page.mouse.down()
    visit.page.mouse.move(340, 200)
    visit.page.mouse.up()
    assert not visit.ask("player.follows"), "until the visitor turns it"
    assert visit.problems == []
    visit.context.close()


@pytest.mark.parametrize(("seconds", "fps", "count"), [(2.0, 10.0, 121), (0.1, 10.0, 121), (4.0, 31.0, 125)])
def test_a_page_has_moments_between_the_frames_of_a_short_film(seconds, fps, count):
    session = EditSession(bar_scene())
    film = dataclasses.replace(session.edit.film, seconds=seconds, fps=fps)
    session.apply(dataclasses.replace(session.edit, film=film))
    times = np.array(film_times(session))
    assert len(times) == count
    frames = np.arange(film.frames) / fps
    assert np.abs(times[:, None] - frames).min(axis=0).max() < 1e-6, "those of the frames are among them"


def test_what_jumps_is_not_interpolated(browser, tmp_path):
    session = bent_session()
    playback = dataclasses.replace(session.edit.playback, repeat="loop", speed=2.0)
    session.apply(dataclasses.replace(session.edit, playback=playback))
    motion = edited_motion(session)
    times = film_times(session)
    assert motion.facts["jumps"] == [60] and times[60] == pytest.approx(1.0) and times[-1] < 2.0
    write_page(session.scene, tmp_path / "page.html", motion=motion)
    visit = Visit(browser, tmp_path / "page.html")
    camera = film_camera(session, 1.008, 100)
    ours = session.render(camera, session.scene_time(times[60]), times[60], (0, 0, 0)).rgb.clamp(0, 1).numpy()
    assert psnr(visit.render(camera, 1.008 / 2.0), ours) > 40
    visit.context.close()


def test_captions_are_shown_in_their_time(browser, tmp_path):
    cues = [{"from": 0.5, "to": 1.0, "text": "<b>one</b>"}, {"from": 1.5, "to": 2.0, "text": "two"}]
    write_page(bar_scene(gaussians=200), tmp_path / "page.html", captions=cues)
    visit = Visit(browser, tmp_path / "page.html", "?paused&t=0.6")
    assert visit.page.locator("#caption").inner_text() == "<b>one</b>"
    slider = visit.page.get_by_role("slider", name="Time")
    slider.fill("1.2")
    assert visit.page.locator("#caption").is_hidden()
    slider.fill("1.7")
    assert visit.page.locator("#caption").inner_text() == "two"
    visit.context.close()


def masked_session() -> EditSession:
    """A session whose Gaussians take part in the motion by different shares, with a hold and handles at both ends."""
    session = bent_session(shaded=True, corrected=True, share=0.5)
    with torch.no_grad():
        session.scene.gaussians.hyper[:, -1] = torch.linspace(-3.0, 3.0, len(session.scene.gaussians))
    x = session.node_positions(0.0)[:, 0]
    hold = Hold(tuple(np.flatnonzero(x > np.quantile(x, 0.7)).tolist()), 0.2)
    session.apply(dataclasses.replace(session.edit, holds=(hold,), exaggerate=Exaggerate(1.3)))
    return session


def test_frames_of_an_edit_with_a_mask_are_those_of_the_session(browser, tmp_path):
    """The mask weakens hold and exaggeration, but not the handle."""
    session = masked_session()
    write_page(session.scene, tmp_path / "page.html", motion=edited_motion(session))
    visit = Visit(browser, tmp_path / "page.html")
    for at in (0.0, 0.55, 0.95, 1.9):
        camera = film_camera(session, at, 120)
        ours = session.render(camera, session.scene_time(at), at, (0, 0, 0)).rgb.clamp(0, 1).numpy()
        assert psnr(visit.render(camera, at / 2.0), ours) > 45, at
    at = 1.0
    table = pose_table(session, Moment(session.scene_time(at), at, False))
    read = visit.ask("Array.from(player.pose(0.5, new Float32Array(player.table.length), true))")
    assert np.abs(np.reshape(read, table.shape) - table).max() < 2e-3, "the editor's page draws the same"
    assert visit.problems == []
    visit.context.close()


def test_parts_of_a_scene_with_a_mask_are_pulled_whole(browser, tmp_path):
    session = masked_session()
    session.apply(Edit(skin="nodes"))
    write_page(session.scene, tmp_path / "page.html", motion=posable(session, own_motion(session)))
    visit, time = Visit(browser, tmp_path / "page.html"), 0.7
    part = next(part for part in session.parts() if part.parent is not None)
    session.turn(part.name, 50.0, (0.0, 1.0, 0.0))
    turn = session.edit.targets[session.edit.handles[0].name].rotation
    visit.ask("(player.figure.turns[argument[0]] = argument[1])", [session.parts().index(part), list(turn)])
    camera = film_camera(session, 0.0, 120)
    ours = session.render(camera, time, background=(0, 0, 0)).rgb.clamp(0, 1).numpy()
    plain = session.scene.render(camera, time, (0, 0, 0)).rgb.clamp(0, 1).numpy()
    assert psnr(visit.render(camera, time), ours) > 45 and psnr(plain, ours) < 35
    visit.context.close()
