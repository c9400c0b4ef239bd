"""What callers give a scene: numbers of any kind are taken, and what cannot be drawn is refused instead of black."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene
from helpers.tiny import tiny_camera
from scgs_warp.edit import EditSession
from scgs_warp.errors import UserError
from scgs_warp.scene.mean import MeanScene
from scgs_warp.types import Camera


@pytest.fixture(scope="module")
def session() -> EditSession:
    made = EditSession(bar_scene(nodes=12, gaussians=60))
    made.add_handle([0, 1], time=0.0, name="end")
    made.move("end", translation=(0.0, 0.1, 0.0))
    return made


@pytest.fixture(scope="module", params=["scene", "mean", "session"])
def drawer(session, request):
    return {"scene": session.scene, "mean": MeanScene([session.scene, session.scene]), "session": session}[
        request.param
    ]


def camera(**fields) -> Camera:
    return dataclasses.replace(tiny_camera(0, 4, 24), **fields)


def read_only(value: torch.Tensor) -> np.ndarray:
    array = value.numpy().copy()
    array.flags.writeable = False
    return array


KINDS = {
    "array": np.asarray,
    "array of float64": lambda value: np.asarray(value, np.float64),
    "float64": lambda value: value.double(),
    "flipped array": lambda value: np.flip(np.flip(value.numpy()).copy()),
    "array of another byte order": lambda value: value.numpy().astype(">f4"),
    "array of objects": lambda value: value.numpy().astype(object),
    "array that may not be written": lambda value: read_only(value),
    "list": lambda value: value.tolist(),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.filterwarnings("error")
def test_numbers_of_any_kind_give_the_same_picture(drawer, kind):
    plain, changed = camera(), KINDS[kind]
    truth = drawer.render(plain, 0.3, background=(0.5, 0.25, 1.0))
    same = camera(viewmat=changed(plain.viewmat), K=changed(plain.K), width=np.int64(24), height=24.0)
    found = drawer.render(same, 0.3, background=changed(torch.tensor([0.5, 0.25, 1.0])))
    assert float(truth.alpha.max()) > 0.5 and torch.equal(found.rgb, truth.rgb)


NAN = torch.full((3, 3), math.nan)
WRONG = [
    ({"K": NAN}, "K holds NaN or infinity"),
    ({"K": torch.diag(torch.tensor([0.0, 50.0, 1.0]))}, r"K\[0, 0\] and K\[1, 1\], the focal lengths"),
    ({"K": torch.eye(4)}, r"K must be \[3, 3\], got \(4, 4\)"),
    ({"K": None}, "K must be a tensor of numbers, got NoneType"),
    ({"viewmat": torch.full((4, 4), math.inf)}, "viewmat holds NaN or infinity"),
    ({"viewmat": torch.eye(4)[:3]}, r"viewmat must be \[4, 4\], got \(3, 4\)"),
    ({"viewmat": torch.eye(4) + torch.tensor([0.0] * 12 + [1.0] * 3 + [0.0]).reshape(4, 4)}, "transpose or divide"),
    ({"viewmat": "front"}, "viewmat must be a tensor of numbers, got str"),
    ({"width": "24"}, "width must be a whole number, got '24'"),
    ({"height": 24.5}, "height must be a whole number, got 24.5"),
    ({"height": 0}, "width and height must be positive, got 24 x 0"),
]


@pytest.mark.parametrize(("fields", "words"), WRONG)
def test_a_camera_that_shows_nothing_is_refused(drawer, fields, words):
    with pytest.raises(ValueError, match=words):
        drawer.render(camera(**fields), 0.3)


@pytest.mark.parametrize("time", [None, "0.3", [0.3], torch.linspace(0, 1, 99), np.ones(2), math.nan])
def test_a_time_that_is_no_number_is_refused(drawer, time):
    for call in (drawer.gaussians_at, lambda time: drawer.render(camera(), time)):
        with pytest.raises(UserError, match=r"^time is .*; give a number from 0 .*$"):
            call(time)


def test_what_is_no_camera_is_refused(drawer):
    with pytest.raises(ValueError, match=r"camera must be a scgs_warp\.Camera\(.*\), got tuple"):
        drawer.render((torch.eye(4), torch.eye(3), 24, 24), 0.3)


@pytest.mark.parametrize("color", ["white", (1.0, 1.0), 1.0, (math.nan, 0.0, 0.0)])
def test_a_background_that_is_no_colour_is_refused(drawer, color):
    with pytest.raises(ValueError, match="background must be"):
        drawer.render(camera(), 0.3, background=color)


def test_picking_takes_the_same_cameras(session):
    plain = camera()
    given = camera(viewmat=plain.viewmat.tolist(), K=plain.K.double().numpy())
    y, x = divmod(int(session.render(plain, 0.3).alpha.argmax()), plain.width)
    found, truth = (session.pick(one, x, y, 0.3) for one in (given, plain))
    assert truth is not None and np.array_equal(found, truth)
