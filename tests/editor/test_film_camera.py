"""A client's view as a view of the film's camera."""

from __future__ import annotations

import pytest
import torch

from helpers.editor_models import client, new_model
from scgs_warp.edit import Film, film_camera
from scgs_warp.editor.film_camera import view_of
from scgs_warp.editor.model import EditorModel
from scgs_warp.editor.views import ClientCamera
from scgs_warp.errors import UserError


@pytest.fixture
def model() -> EditorModel:
    return new_model()


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
