"""The benchmark of parts (benchmarks/parts.py): what it says of a motion whose bones are known."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from helpers.edit_scenes import figure_scene
from helpers.paths import ROOT
from scgs_warp.data.synthetic.figure_motion import bone_transforms
from scgs_warp.edit import EditSession

sys.path.insert(0, str(ROOT / "benchmarks"))

import parts
from posing_tables import bones_shown

TIMES = np.linspace(0.0, 1.0, 12)


@pytest.fixture(scope="module")
def surface() -> parts.Surface:
    """The figure's true motion: all points of a bone move with it."""
    scene, world, names = figure_scene(512)
    bones = parts.figure_bones()
    own = np.array([bones.names.index(name) for name in names])
    start = np.linalg.inv(np.stack([bone_transforms(0.0)[name] for name in bones.names]))
    moves = [np.stack([bone_transforms(t)[name] for name in bones.names]) @ start for t in TIMES]
    tracks = np.stack([np.einsum("pij,pj->pi", m[own, :3, :3], world) + m[own, :3, 3] for m in moves])
    whole = np.arange(len(bones.names))
    whole[bones.names.index("neck")] = bones.names.index("torso")  # they never turn against each other
    return parts._surface(EditSession(scene), bones, whole, tracks, TIMES)


def test_a_motion_that_follows_the_bones_is_tracked(surface):
    assert 0.85 < (surface.tracked == surface.bone).mean() <= 1.0
    assert len(np.unique(surface.part)) >= 12


def test_views_count_at_the_instant_nearest_to_them():
    visible = np.array([[True, False], [True, True], [False, True], [True, False]])
    counts = parts.counts_of(visible, np.array([0.0, 0.1, 0.6, 1.0]), np.array([0.0, 0.5, 1.0]))
    assert counts.tolist() == [[2, 1], [0, 1], [1, 0]]


def test_points_count_as_often_as_they_are_seen():
    """Points are those of the Gaussians themselves at three instants, so that each one's part is its own."""
    session, times = EditSession(figure_scene(64)[0]), np.array([0.0, 0.4, 1.0])
    chosen = np.arange(0, len(session.gaussian_parts()), 97)
    places = np.stack([session.scene.gaussians_at(t).means[chosen].double().numpy() for t in times.tolist()])
    own = session.gaussian_parts()[chosen]
    bone_of = np.arange(int(session.gaussian_parts().max()) + 1) + 3
    counts = np.random.default_rng(0).integers(0, 5, (3, len(chosen)))
    wrong = np.arange(len(chosen)) % 4 == 0
    bone = np.where(wrong, -7, own + 3)
    found = parts.seen_agreement(session, bone_of, bone, places, times, counts)
    assert found == pytest.approx(counts[:, ~wrong].sum() / counts.sum(), abs=0.02)


def test_trained_turns_are_those_of_the_gaussians(surface):
    bones = parts.figure_bones()
    knee, hip = bones.names.index("knee_left"), bones.names.index("hip_left")
    true = parts.largest_turn(parts.relative_turns(bones, knee))
    assert parts._trained_turn(surface, knee, hip) == pytest.approx(true, abs=0.3 * true)
    still = surface._replace(tracks=np.tile(surface.tracks[:1], (len(TIMES), 1, 1)))
    assert parts._trained_turn(still, knee, hip) < 1e-3


def test_a_slipping_surface_is_not_tracked(surface):
    still = np.tile(surface.tracks[:1], (len(TIMES), 1, 1))
    bones = parts.figure_bones()
    assert (parts.true_labels(bones, still, TIMES) == surface.bone).mean() < 0.5


def test_the_table_of_bones_has_one_value_for_each_run():
    bone = {"bone": "knee", "points": 0.1, "turn": 36.0, "trained_turn": 20.0, "tracked": 1.0, "agreement": 0.9}
    root = {"bone": "hips", "points": 0.3, "tracked": 0.5, "agreement": 0.0}
    rows = [{**row, "run": run} for run in ("a", "b") for row in ({"bone": "all"}, root, bone)]
    lines = [line.replace(" ", "") for line in bones_shown({"parts-figure": {"rows": rows}}).splitlines()]
    assert "|knee|10|36|2020|100100|9090|" in lines and "|hips|30|||5050|00|" in lines
