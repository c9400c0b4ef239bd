"""Edits as files: what is read, what is refused, what is saved."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene, dress
from helpers.edit_scripts import SCRIPT, changed
from scgs_warp.edit import Edit, EditSession, Target
from scgs_warp.edit.edit_file import parse, read
from scgs_warp.edit.rotations import angle, from_axis
from scgs_warp.errors import UserError
from scgs_warp.formats.gaussian_ply import write_gaussian_ply
from scgs_warp.scene.from_gaussians import open_gaussians


@pytest.fixture(scope="module")
def session() -> EditSession:
    return EditSession(bar_scene())


def test_a_script_is_read(session):
    edit = parse(SCRIPT, "edit.json", session.engine)
    right, tip = edit.handles
    assert right.name == "right" and len(right.nodes) > 2 and right.pivot == (0.8, -1.0, 0.25)
    assert tip.stiffness == 0.5 and tip.lasts == "fade"
    assert edit.pins and not set(edit.pins) & set(session.ring(right.nodes, 2))
    assert edit.keyframes[1].targets["right"].rotation == tuple(from_axis([0, 0, 1], 60).tolist())
    assert edit.holds[0].nodes and edit.exaggerate is not None and edit.film.shot.views[1].distance == 3.0


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("format", "gif", "format"),
        ("version", 3, "version"),
        ("handles", {}, "handles"),
        ("handles.0", 3, r"handles\[0\]"),
        ("handles.0.name", "", r"handles\[0\].name"),
        ("handles.0.name", "tip", "taken"),
        ("handles.0.nodes", [1, 2.5], "2.5"),
        ("handles.0.nodes", [1, 99999], "99999"),
        ("handles.0.nodes", [True], "true"),
        ("handles.0.nodes", [], "empty"),
        ("handles.0.nodes", ..., "nodes"),
        ("handles.0.nodes", {"point": [0, 0]}, "point"),
        ("handles.0.nodes", {"sphere": [99, 99, 99], "radius": 1}, "no control point"),
        ("handles.0.nodes", {"somewhere": 1}, "somewhere"),
        ("handles.0.nodes", {}, "no place"),
        ("handles.0.time", 1.5, "time"),
        ("handles.0.pivot", [0, 0, "x"], "pivot"),
        ("handles.0.lasts", "forever", "motion, frame, fade"),
        ("handles.0.colour", "red", "colour"),
        ("handles.1.stiffness", 0, "stiffness"),
        ("pins", [-1], "-1"),
        ("targets", {"nobody": {}}, "nobody"),
        ("targets.tip", None, "tip"),
        ("targets.tip.rotation", [0, 0, 0, 0], "tip"),
        ("targets.tip.axis", [0, 0, 1], "degrees"),
        ("targets.tip", {"axis": [1e-200, 0, 0], "degrees": 9}, "axis"),
        ("targets.tip.translation", [1e300, 0, 0], "translation"),
        ("keyframes.1.at", 0.0, "two at 0"),
        ("keyframes.1.at", ..., "at is missing"),
        ("keyframes.0.easing", "bouncy", "smooth, linear"),
        ("keyframes.0.targets", [], "targets"),
        ("playback.speed", "fast", "speed"),
        ("playback.map", [[0, 0], [0, 1]], r"map\[1\]"),
        ("playback.map", [[0, 2]], r"map\[0\]"),
        ("hold.0.frame", "moon", "body, world"),
        ("exaggerate.factor", 1e6, "factor"),
        ("film.fps", 0, "fps"),
        ("film.size", 4.5, "size"),
        ("film.background", [0, 0, 2], "background"),
        ("film.shot.kind", "drone", "turntable"),
        ("film.shot.views.1.at", 0, "two at one moment"),
        ("film.shot.up", [0, 0, 0], "up"),
        ("film.shot.up", [1e-200, 0, 0], "up"),
        ("scene", {"control_points": 5}, "control_points"),
        ("scene", {"fingerprint": "00000000"}, "fingerprint"),
        ("nonsense", 1, "nonsense"),
    ],
)
def test_every_mistake_names_its_field(session, path, value, words):
    with pytest.raises(UserError, match=words) as caught:
        parse(changed(path, value), "edit.json", session.engine)
    message = str(caught.value)
    assert message.startswith("edit.json: ") and "\n" not in message and "; " in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "line 1"),
        ("[]", "object"),
        ('{"format": NaN}', "NaN"),
        ('{"a": 1, "a": 2}', "twice"),
        ("[" * 100_000, "nested|JSON"),
        ('{"format": "scgs-warp edit", "version": 1, "film": {"seconds": 1e999}}', "seconds"),
        ("\ufffe", "JSON"),
    ],
)
def test_files_that_are_no_edit(session, tmp_path, text, words):
    path = tmp_path / "edit.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match=words) as caught:
        read(path, session.engine)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(UserError, match="no such file"):
        read(tmp_path / "missing.json", session.engine)


def nested(levels: int) -> list:
    found: list = []
    for _ in range(levels):
        found = [found]
    return found


@pytest.mark.parametrize("value", ["a\nb" * 100_000, nested(3000), {"a\nb" * 100_000: {"x": 1}}, ["a\nb" * 100_000]])
@pytest.mark.parametrize(
    "path",
    "format version scene handles handles.0.name handles.0.nodes pins targets targets.tip keyframes.0.targets "
    "playback.map film hold.0.nodes".split(),
)
def test_whatever_stands_there_the_message_is_one_line(session, path, value):
    with pytest.raises(UserError) as caught:
        parse(changed(path, value), "edit.json", session.engine)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 500


def test_names_that_nobody_knows_are_cut_and_on_one_line(session):
    for inner in ({"a\n" * 1000: 1}, {"targets": {"b\n" * 1000: {"axis": 1}}}, {"film": {"\ud800" * 999: 1}}):
        with pytest.raises(UserError) as caught:
            parse({**SCRIPT, **inner}, "edit.json", session.engine)
        assert str(caught.value).isprintable() and len(str(caught.value)) < 500
    many = [{"name": f"a handle that is called number {i}", "nodes": [1]} for i in range(900)]
    with pytest.raises(UserError, match="names no handle") as caught:
        parse({**SCRIPT, "handles": many}, "edit.json", session.engine)
    assert len(str(caught.value)) < 500


def test_another_count_of_control_points_says_how_to_ask_for_it(session, ply):
    script = {"format": "scgs-warp edit", "version": 1, "scene": {"control_points": 33}}
    with pytest.raises(UserError, match="--nodes 33"):
        parse(script, "edit.json", EditSession(open_gaussians(ply, nodes=20)).engine)
    with pytest.raises(UserError) as caught:
        parse(script, "edit.json", session.engine)
    assert "--nodes" not in str(caught.value)


def test_what_is_saved_can_be_loaded(tmp_path):
    """What no file may say is refused at once, and at the latest when it is saved."""
    own = EditSession(bar_scene())
    own.add_handle([1], 0.0, "a")
    before = own.edit
    for make, words in [
        (lambda: own.move("a", [2e9, 0, 0]), "translation"),
        (lambda: own.move("a", [0, 0, 1e150]), "translation"),
        (lambda: own.add_keyframe(4000.0), "at"),
        (lambda: own.add_keyframe(-1.0), "at"),
        (lambda: own.add_keyframe(1.0, "bouncy"), "easing"),
        (lambda: own.resize_film(10_000), "size"),
        (lambda: own.add_handle([2], 0.0, "b", pivot=(2e9, 0.0, 0.0)), "pivot"),
    ]:
        with pytest.raises(UserError, match=words):
            make()
        assert own.edit == before
    own.apply(Edit(targets={"nobody": Target()}))
    with pytest.raises(UserError, match="nobody"):
        own.save(tmp_path / "edit.json")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def ply(tmp_path) -> Path:
    path = tmp_path / "scene.ply"
    generator = torch.Generator().manual_seed(0)
    write_gaussian_ply(path, dress(torch.randn(300, 3, generator=generator), degree=1).activate())
    return path


OLD = Path(__file__).parents[1] / "fixtures" / "edits-3132a41"
"""Edits of version 1 of the bar, and the poses that 3132a41 computed for them."""


@pytest.mark.parametrize("name", ["several-nodes-shifted", "one-node", "soft-and-fading"])
def test_version_1_keeps_its_meaning(session, name, tmp_path):
    edit, poses = read(OLD / f"{name}.json", session.engine), np.load(OLD / f"{name}.npz")
    assert all(handle.turns is not None for handle in edit.handles)
    assert len(edit.handles) + len(edit.targets) >= 2
    again = EditSession(session.scene, edit)
    again.save(tmp_path / "saved.json")
    assert json.loads((tmp_path / "saved.json").read_text())["version"] == 2
    again.load(tmp_path / "saved.json")
    assert again.edit == edit
    for time, positions, turns in zip(poses["times"], poses["positions"], poses["turns"]):
        bent = again.engine.bend(again.edit, float(time))
        np.testing.assert_allclose(bent.positions, positions, rtol=0, atol=1e-12)
        np.testing.assert_allclose(bent.turns, turns, rtol=0, atol=1e-12)


def test_version_2_leaves_the_rotation_to_the_solver(session):
    content = json.loads((OLD / "several-nodes-shifted.json").read_text())
    old, new = (parse({**content, "version": version}, "edit", session.engine) for version in (1, 2))
    assert old.handles[0].turns is True and new.handles[0].turns is None
    nodes = list(new.handles[0].nodes)
    held, free = (session.engine.bend(edit, 0.0).turns[nodes] for edit in (old, new))
    assert angle(held).max() == 0.0 and angle(free).min() > 0.05
    explicit = parse({**content, "version": 2, "handles": [{**content["handles"][0], "turns": True}]}, "edit",
                     session.engine)  # fmt: skip
    assert explicit == old


@pytest.mark.parametrize(
    ("region", "words"),
    [
        ({"point": [0, 0, 0], "radius": 1}, "radius belongs to sphere"),
        ({"point": [0, 0, 0], "box": [[0, 0, 0], [1, 1, 1]]}, "box stands beside point"),
        ({"sphere": [0, 0, 0], "box": [[-9, -9, -9], [9, 9, 9]]}, "box stands beside sphere"),
        ({"point": [0, 0, 0], "sphere": [0, 0, 0], "radius": 1}, "sphere stands beside point"),
    ],
)
def test_a_region_of_several_kinds_is_refused(session, region, words):
    with pytest.raises(UserError, match=words.replace(" ", ".*")):
        parse(changed("handles.0.nodes", region), "x.json", session.engine)


def test_a_box_may_be_given_by_any_two_opposite_corners(session):
    boxes = [[-1, -2, -1], [0, 2, 1]], [[0, 2, 1], [-1, -2, -1]], [[0, -2, 1], [-1, 2, -1]]
    found = [
        parse(changed("handles.0.nodes", {"box": box}), "x.json", session.engine).handles[0].nodes for box in boxes
    ]
    assert found[0] == found[1] == found[2] and found[0]


@pytest.mark.parametrize("nodes", [0, "", False, {}])
def test_exaggeration_of_no_list_of_control_points_is_refused(session, nodes):
    with pytest.raises(UserError, match=r"exaggerate\.nodes"):
        parse(changed("exaggerate.nodes", nodes), "x.json", session.engine)


def test_the_skin_is_kept_before_any_part_is_posed(session, tmp_path):
    EditSession(session.scene, Edit(skin="dual")).save(tmp_path / "edit.json")
    assert read(tmp_path / "edit.json", session.engine).skin == "dual"
