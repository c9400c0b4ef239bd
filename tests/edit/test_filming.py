"""Films of edits: frames and cameras."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene
from helpers.edit_scripts import SCRIPT, changed
from scgs_warp.edit import EditSession, film_camera, render_film
from scgs_warp.edit.edit_file import parse
from scgs_warp.visualization.figures import to_bytes


@pytest.fixture(scope="module")
def session() -> EditSession:
    return EditSession(bar_scene())


def test_a_film_shows_what_the_session_shows(tmp_path):
    session = EditSession(bar_scene())
    session.apply(parse(SCRIPT, "edit.json", session.engine))
    session.save(tmp_path / "edit.json")
    assert render_film(session, tmp_path / "film") == 4
    other = EditSession(bar_scene())
    other.load(tmp_path / "edit.json")
    frames = [cv2.imread(str(path))[..., ::-1] for path in sorted((tmp_path / "film").iterdir())]
    for index in (2, 0, 3):
        at = index / 8
        image = other.render(film_camera(other, at), other.scene_time(at), at, (1.0, 1.0, 1.0), frame=1e-3)
        np.testing.assert_array_equal(frames[index], to_bytes(image.rgb))
    assert not np.array_equal(frames[0], frames[3])


def test_cameras(session):
    own = EditSession(session.scene)
    for shot, azimuths in [
        ({"kind": "turntable", "turns": 0.5}, (0.0, 90.0, 157.5)),
        ({"kind": "fixed", "views": [{"azimuth": 33}]}, (33.0, 33.0, 33.0)),
        ({"kind": "orbit", "views": [{"at": 0, "azimuth": 0}, {"at": 4, "azimuth": 60}]}, (0.0, 30.0, 57.4)),
    ]:
        own.apply(parse({**changed("film.shot", shot), "film": {"seconds": 4, "shot": shot}}, "x", own.engine))
        for at, azimuth in zip((0.0, 2.0, 3.5), azimuths):
            x, y, _ = film_camera(own, at).position.tolist()
            assert np.degrees(np.arctan2(y, x)) == pytest.approx(azimuth, abs=0.5)
    shot = {"kind": "fixed", "fov": 20, "up": [0, 2, 0], "views": [{"distance": 7, "target": [1, 2, 3]}]}
    own.apply(parse(changed("film.shot", shot), "x", own.engine))
    camera = film_camera(own, 0.0)
    assert float((camera.position - torch.tensor([1.0, 2.0, 3.0])).norm()) == pytest.approx(7, rel=1e-5)


LATE = [{"at": 0, "azimuth": 10}, {"at": 2, "azimuth": 70}]


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("keyframes.1.at", 0.5, ""),
        ("keyframes.1.at", 1.5, "the film ends at 0.5 s, before keyframes up to 1.5 s; "),
        ("film.shot.views.1.at", 2, "the film ends at 0.5 s, before views of the camera up to 2 s; "),
        ("film.shot", {"kind": "fixed", "views": LATE}, ""),
        ("film.shot.views", LATE[1:], ""),
        ("film.seconds", 0.25, "before keyframes up to 0.5 s and views of the camera up to 0.5 s; "),
    ],
)
def test_what_lies_after_the_end_is_named(session, tmp_path, capsys, path, value, said):
    own = EditSession(session.scene, parse(changed(path, value), "edit.json", session.engine))
    render_film(own, tmp_path / "film")
    found = capsys.readouterr().err
    assert (said in found and found.startswith("note: ") and found.count("\n") == 1) if said else not found
