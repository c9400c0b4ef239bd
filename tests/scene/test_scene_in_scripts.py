"""Scenes as scripts use them: from another folder, copied, and under settings of torch's that are the script's own."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import subprocess
import sys

import pytest
import torch

from helpers.export_runs import moving_run
from helpers.tiny import tiny_camera
from helpers.torch_settings import SETTINGS
from scgs_warp.edit import EditSession, render_film
from scgs_warp.edit.document import Film
from scgs_warp.scene.scene import Scene


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return moving_run(tmp_path_factory.mktemp("scripts") / "run")


def test_names_are_offered_and_used_before_anything_is_loaded():
    program = (
        "import sys, scgs_warp as s; print({*s.__all__, 'data', 'edit'} - {*dir(s)}, 'torch' in sys.modules); "
        "print(s.data.load.__name__, s.edit.EditSession.__name__, hasattr(s, 'metal'))"
    )
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert told.splitlines() == ["set() False", "load EditSession False"]


@pytest.mark.parametrize("name", ["run", "."])
def test_the_program_changes_its_directory(run, name, tmp_path, monkeypatch):
    """The parts of the run stay those that its folder keeps, and the page in a notebook has a title."""
    session = EditSession(Scene.load(run))
    session.rename_part(session.parts()[0].name, "of this run")
    session.save_skeleton()
    monkeypatch.chdir(run.parent if name == "run" else run)
    scene = Scene.load(name)
    assert 'title="run"' in (scene._repr_html_() or "")
    monkeypatch.chdir(tmp_path)
    assert EditSession(scene).parts()[0].name == "of this run"
    assert scene.folder == run


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda scene: pickle.loads(pickle.dumps(scene))])
def test_copies_draw_the_same(run, copied):
    scene, camera = Scene.load(run), tiny_camera(0, 4, 24)
    scene.frame_graph()  # as if a GPU had drawn a frame
    other = copied(scene)
    assert torch.equal(other.render(camera, 0.3).rgb, scene.render(camera, 0.3).rgb)


@pytest.mark.parametrize("setting", SETTINGS)
def test_what_a_script_has_set_for_torch_changes_nothing(run, setting):
    camera = tiny_camera(0, 4, 24)
    truth = Scene.load(run)
    with SETTINGS[setting]():
        scene = Scene.load(run)
        image, means = scene.render(camera, 0.3), scene.gaussians_at(0.3).means
        points = scene.control_points_at(0.3)
    assert torch.equal(image.rgb, truth.render(camera, 0.3).rgb)
    assert torch.equal(means, truth.gaussians_at(0.3).means)
    assert torch.equal(points, truth.control_points_at(0.3))


@pytest.mark.parametrize("setting", SETTINGS)
def test_an_edited_scene_is_the_same(setting, tmp_path):
    def edited(folder) -> list:
        session = EditSession(Scene.load(whole))
        part = next(part.name for part in session.parts() if part.parent)
        session.pull(part, session.joint_of(part, 0.0) + 0.1)
        session.add_handle([0, 1], time=0.0, name="end")
        session.move("end", translation=(0.0, 0.1, 0.0))
        session.apply(dataclasses.replace(session.edit, film=Film(seconds=0.1, fps=20.0, size=32)))
        render_film(session, folder / "film")
        session.scene.turntable(folder / "turntable", frames=2, size=32)
        session.save(folder / "edit.json")
        image = session.render(camera, 0.3)
        frames = [path.read_bytes() for path in sorted(folder.glob("*/*.png"))]
        return [image.rgb.tolist(), session.node_positions(0.3).tolist(), session.edit, frames]

    camera, whole = tiny_camera(0, 4, 24), moving_run(tmp_path / "run", swing=0.02)
    truth = edited(tmp_path / "plain")
    with SETTINGS[setting]():
        assert edited(tmp_path / "changed") == truth
    assert len(truth[-1]) == 4


def test_scenes_of_fit_can_film_themselves():
    """Also where nothing has asked for the code that films; importing the package stays cheap."""
    program = (
        "import sys, scgs_warp; from scgs_warp.scene import film_maker\n"
        "assert film_maker._makers and 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=100)
