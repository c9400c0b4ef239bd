"""What the editor shows: clicks meet the surface, pictures side by side, the film seen from where the user looks."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.editor_models import chosen, client, new_model
from scgs_warp.edit import Film, Target, film_camera
from scgs_warp.edit.handles import STAY
from scgs_warp.editor.film_camera import view_of
from scgs_warp.editor.frame_image import take_picture
from scgs_warp.editor.gizmo_pose import region_at, surface_point
from scgs_warp.editor.model import EditorModel, Moment, Region
from scgs_warp.editor.overlays import CHOSEN, HELD, PINNED, PLAIN, node_colors
from scgs_warp.editor.views import ClientCamera
from scgs_warp.errors import UserError


@pytest.fixture
def model() -> EditorModel:
    return new_model()


def test_clicks_meet_the_surface(model):
    session, moment = model.session, model.moment()
    camera = client(session)
    picture = take_picture(session, moment, camera, 96)
    assert picture.rgb.shape == (camera.height, camera.width, 3) == (*picture.depth.shape, 3)
    rows, columns = np.nonzero(np.isfinite(picture.depth))
    middle = len(rows) // 2
    screen = (columns[middle] + 0.5) / camera.width, (rows[middle] + 0.5) / camera.height
    point = surface_point(session, camera, screen, moment)
    assert point is not None and np.linalg.norm(point - session.node_positions(0.0), axis=1).min() < 0.2
    assert surface_point(session, camera, (0.0, 0.0), moment) is None
    assert surface_point(session, camera, (-3.0, 7.0), moment) is None, "beside the canvas"
    rings = region_at(session, point, Region("rings", 1), moment)
    assert rings == session.ring([session.nearest(point.tolist(), 0.0)], 1)
    assert len(region_at(session, point, Region("brush", radius=1e-6), moment)) == 1, "never none"
    assert len(region_at(session, point, Region("brush", radius=10.0), moment)) == len(session)


def test_side_by_side_and_split(model):
    model.select(chosen(model))
    model.grab(STAY)
    model.drag(Target((0.0, 0.3, 0.4)))
    model.release()
    session, camera = model.session, client(model.session)
    pictures = {}
    for show in ("edited", "original", "side by side", "split"):
        model.set(show=show)
        pictures[show] = take_picture(session, model.moment(), camera, 96).rgb.astype(int)
        assert pictures[show].shape == pictures["edited"].shape
    middle = camera.width // 2
    assert (pictures["edited"] != pictures["original"]).any()
    assert (pictures["split"][:, :middle] == pictures["original"][:, :middle]).all()
    assert (pictures["split"][:, middle + 1 :] == pictures["edited"][:, middle + 1 :]).all()
    assert (pictures["side by side"][:, middle] == 128).all()


def test_the_film_can_begin_where_the_user_looks(model):
    session = model.session
    for azimuth in (0.0, 77.0, 200.0):
        camera = client(session, azimuth)
        view = view_of(session, camera)
        assert view.azimuth == pytest.approx(azimuth, abs=1e-3)
        shot = session.edit.film.shot.__class__(kind="fixed", views=(view,))
        model.replace(film=Film(shot=shot))
        film = film_camera(session, 0.0, 96)
        assert torch.allclose(film.viewmat, camera.at_size(96).viewmat, atol=1e-4)
    down = ClientCamera((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 5.0), 0.7, 64, 64)
    with pytest.raises(UserError, match="from the side"):
        view_of(session, down)


def test_colours_of_control_points():
    colors = node_colors(5, chosen=(2,), held=(1, 2), pins=(0, 1))
    assert [tuple(row) for row in colors] == [PINNED, HELD, CHOSEN, PLAIN, PLAIN]


def test_a_moment_shows_the_film_or_the_handles(model):
    assert model.moment() == Moment(0.0, None, False, "edited")
