"""Edits applied to scenes: the same bits from the same edit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.edit_scenes import OVERVIEW, bar_scene, dress
from helpers.edit_sessions import TURN, ends, motion, part, same
from scgs_warp.config.presets import from_dict
from scgs_warp.edit import Edit, EditSession, Exaggerate, Film, Hold, Playback, film_camera
from scgs_warp.edit.filming import film_frame
from scgs_warp.errors import UserError
from scgs_warp.formats.gaussian_ply import read_gaussian_ply
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.motion import Static
from scgs_warp.motion.per_gaussian import PerGaussian
from scgs_warp.runtime import environment
from scgs_warp.scene.from_gaussians import with_control_points
from scgs_warp.scene.scene import Scene
from scgs_warp.visualization.figures import to_bytes


@pytest.mark.parametrize("share", [None, 0.5])
def test_same_bits_on_any_number_of_threads_where_torch_cuts_its_work(share, all_threads):
    """It does so above 32,768 elements, here at an odd place."""
    scene = bar_scene(gaussians=40_030, share=share, shaded=True)
    if share is not None:
        with torch.no_grad():
            scene.gaussians.hyper[:, -1] = torch.randn(40_030, generator=torch.Generator().manual_seed(5))
    results = []
    for threads in (1, 2):
        environment.configure(threads=threads)
        session = EditSession(scene)
        session.apply(Edit(holds=(Hold((0, 1, 2), 0.0, "world"),), exaggerate=Exaggerate(1.3)))
        session.add_handle(part(session, 0.8, 1.0), 0.0, "right")
        session.move("right", [0.0, 0.1, 0.0], TURN)
        results.append(session.gaussians_at(0.4))
    assert same(*results)


def test_results_are_no_parameters():
    session = EditSession(bar_scene())
    session.add_handle([3, 4, 5], 0.0, "a")
    session.move("a", [0.1, 0.0, 0.0])
    assert not any(tensor.requires_grad for tensor in session.gaussians_at(0.3).tensors().values())


def test_an_edit_of_one_frame_is_one_frame_of_the_film_everywhere(tmp_path):
    """Ten frames in one second, a tenth of the motion each: the frame nearest to .54 shows what was made at .5."""
    scene = bar_scene()
    session = EditSession(scene)
    session.apply(Edit(film=Film(seconds=1.0, fps=10.0, size=32), playback=Playback(seconds=1.0)))
    session.add_handle(part(session, 0.8, 1.0), 0.5, "right", lasts="frame")
    session.move("right", [0.0, 0.3, 0.0])
    camera = film_camera(session, 0.5)
    for time, shown in ((0.54, True), (0.56, False)):
        assert same(session.render(camera, time), scene.render(camera, time)) != shown
        assert same(session.gaussians_at(time), scene.gaussians_at(time)) != shown
        moved = session.node_positions(time)
        assert np.array_equal(moved, motion(session, time)) != shown
        session.export_ply(tmp_path / "edited.ply", time)
        found = read_gaussian_ply(tmp_path / "edited.ply").means
        assert torch.equal(found, scene.gaussians_at(time).means) != shown
        end = moved[part(session, 0.95, 1.0)[0]]
        assert session.nearest(end, time) == part(session, 0.95, 1.0)[0]
        assert part(session, 0.95, 1.0)[0] in session.within(end, 1e-6, time)
    found = film_frame(session, 0.5)
    np.testing.assert_array_equal(found, to_bytes(session.render(camera, 0.5, 0.5).rgb))
    assert same(session.gaussians_at(0.54, frame=1e-3), scene.gaussians_at(0.54)), "but for those who say otherwise"


@pytest.fixture
def session() -> EditSession:
    return EditSession(bar_scene())


def test_a_static_scene_is_given_control_points():
    moving = bar_scene()
    still = Scene(moving.gaussians, Static(), Normalisation.identity(), moving.config, OVERVIEW)
    session = EditSession(still)
    assert 1 < len(session) <= 400
    assert same(session.gaussians_at(0.5), still.gaussians_at(0.5))
    left, right = ends(session)
    session.add_handle(right, 0.0, "right")
    session.pin(left)
    session.move("right", [0, 0.5, 0])
    assert same(session.gaussians_at(0.1), session.gaussians_at(0.9))
    kept = (session.gaussians_at(0.0).means == still.gaussians_at(0.0).means).all(1)
    assert 20 < int(kept.sum()) < 380
    assert len(with_control_points(still, 7).motion.positions) == 7


def test_other_motion_models_say_so():
    config = from_dict({"preset": "best"})
    scene = bar_scene()
    motion = PerGaussian.__new__(PerGaussian)
    torch.nn.Module.__init__(motion)
    with pytest.raises(UserError, match="control points"):
        EditSession(Scene(dress(torch.rand(5, 3)), motion, scene.normalisation, config, OVERVIEW))
