"""The benchmark of a film's limits (benchmarks/film_limits.py): surfaces are followed to where the frames show them."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from helpers.paths import ROOT
from scgs_warp.data.synthetic.films import FilmRequest, make_film, plan_film
from scgs_warp.data.synthetic.films.shooting import Shooting
from scgs_warp.data.synthetic.films.stage import Stage, stage_of

sys.path.insert(0, str(ROOT / "benchmarks"))

import film_limits
from film_limits import HeldOut, Picture

SMALL = FilmRequest("rig", width=112, height=64, seconds=1.0, fps=8.0, samples=2, crf=1, views=3, arc=20.0, sound=False)


@pytest.fixture(scope="module")
def stage() -> Stage:
    return stage_of("robot", "cpu")


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("limits") / "rig"
    make_film(plan_film(folder, SMALL))
    return folder


@pytest.fixture(scope="module")
def held_out(filmed, stage) -> Picture:
    return next(film_limits.held_out_views(filmed, Shooting.plan(SMALL, stage.floor), "cam02"))


def test_a_picture_is_what_its_own_frame_gives(stage, held_out):
    view = HeldOut(stage, held_out)
    view.add(stage, held_out, stage.pose_unlit(held_out.time), 1.0)
    scores = view.scores(0)
    assert min(scores["psnr"], scores["mover"], scores["room"]) > 60.0
    assert scores["unseen"] == pytest.approx(1.0 - view.hit.mean(), abs=0.02)


def test_the_mover_is_followed_to_the_moments_of_other_frames(filmed, stage, held_out):
    """Where it was at the held-out moment, a later frame of the same camera shows something else."""
    shooting = Shooting.plan(SMALL, stage.floor)
    later = [frame for frame in film_limits.frames_of(filmed, shooting, "") if np.allclose(
        frame.camera.viewmat, held_out.camera.viewmat)][-1]  # fmt: skip
    followed, left = HeldOut(stage, held_out), HeldOut(stage, held_out)
    followed.add(stage, later, stage.pose_unlit(later.time), 1.0)
    left.add(stage, later, stage.pose_unlit(held_out.time), 1.0)
    assert followed.scores(0)["mover"] > left.scores(0)["mover"] + 3.0
    assert followed.scores(0)["room"] > 30.0


def test_the_result_names_the_film_and_all_views(filmed, monkeypatch, tmp_path, capsys):
    file = tmp_path / "limits.json"
    monkeypatch.setattr(sys, "argv", ["film_limits.py", str(filmed), "--held-out", "cam02", "--json", str(file)])
    assert film_limits.main() == 0
    result = json.loads(file.read_text())
    assert result["film"]["views"] == 3 and len(result["views"]) == 3 and result["halved_after"] in film_limits.SECONDS
    assert 15.0 < result["mover"] < 40.0 and 0.0 < result["unseen"] < 0.5
    assert json.loads(capsys.readouterr().out)["psnr"] == result["psnr"]
