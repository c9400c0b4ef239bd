"""Parts in files: edits that name parts, and the skeleton that a run folder keeps."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import EditSession, Hold, edit_file, skeleton_file
from scgs_warp.errors import UserError
from scgs_warp.scene.from_gaussians import with_control_points


def test_an_edit_of_parts_is_read_as_it_was_written(session, tmp_path):
    session.turn("shoulder_left", 45, (0, 1, 0))
    session.add_keyframe(1.0)
    session.save(tmp_path / "edit.json")
    content = json.loads((tmp_path / "edit.json").read_text())
    assert "nodes" not in content["handles"][0] and content["handles"][0]["part"] == "shoulder_left"
    other = session.fork()
    other.reset()
    other.load(tmp_path / "edit.json")
    assert other.edit == session.edit
    assert np.array_equal(other.node_positions(0.3, at=1.0), session.node_positions(0.3, at=1.0))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"handles": [{"part": "tail"}]}, 'handles[0].part is "tail"; there is part-1'),
        ({"handles": [{"part": "part-1", "nodes": [1]}]}, "give one of them"),
        ({"handles": [{}]}, "name is missing"),
        ({"skeleton": {"parts": []}}, "skeleton.parts do not hold each of the 60"),
        ({"skeleton": {"parts": [{"name": "a", "nodes": [99], "joint": [0, 0, 0]}]}}, "names control point 99"),
        ({"skeleton": {"parts": [{"name": "a", "nodes": [0]}]}}, "joint is missing"),
    ],
)
def test_a_script_that_names_parts_is_checked(change, message, tmp_path):
    path = tmp_path / "edit.json"
    path.write_text(json.dumps({"format": "scgs-warp edit", "version": 2, **change}))
    session = EditSession(bar_scene())
    with pytest.raises(UserError) as raised:
        session.load(path)
    assert message in str(raised.value) and str(path) in str(raised.value)


def test_a_script_may_name_a_part_alone(tmp_path):
    path = tmp_path / "edit.json"
    entry = {"part": "part-2", "time": 0.5}
    turn = {"axis": [0, 1, 0], "degrees": 30}
    content = {"format": "scgs-warp edit", "version": 2, "handles": [entry], "targets": {"part-2": turn}}
    path.write_text(json.dumps(content))
    session = EditSession(bar_scene())
    session.load(path)
    assert session.edit.skeleton == session.skeleton
    assert session.edit.handles[0].nodes == session.skeleton.part("part-2").nodes
    assert not np.array_equal(session.node_positions(0.5), EditSession(bar_scene()).node_positions(0.5))


def test_an_edited_skeleton_of_other_control_points_is_kept_beside_the_new_one(tmp_path):
    def opened(count: int) -> EditSession:
        scene = bar_scene()
        scene.folder = tmp_path
        file.write_text(json.dumps({**content, "scene": {"control_points": count, "fingerprint": "00000000"}}))
        return EditSession(scene)

    session = EditSession(bar_scene())
    file, former = tmp_path / "skeleton.json", tmp_path / "skeleton.former.json"
    content = {"format": "scgs-warp skeleton", "version": 1, **skeleton_file.to_plain(session.skeleton)}
    assert opened(7).skeleton and not former.exists(), "what was found can be found again"
    content["source"], content["parts"][0]["name"] = "edited", "left half"
    for count in (7, 8):
        assert "left half" not in opened(count).skeleton.names
        kept = json.loads(former.read_text())
        assert kept["parts"][0]["name"] == "left half" and kept["scene"]["control_points"] == count
        assert json.loads(file.read_text())["scene"]["fingerprint"] != "00000000"
    renamed = opened(9)
    renamed.edit = dataclasses.replace(renamed.edit, skeleton=session.skeleton.renamed(session.skeleton.names[0], "x"))
    renamed.save_skeleton()
    renamed.save_skeleton()
    assert json.loads(former.read_text())["scene"]["control_points"] == 9, "a skeleton of this scene is no former one"


def test_a_run_keeps_its_skeleton(tmp_path):
    def opened() -> EditSession:
        scene = bar_scene()
        scene.folder = tmp_path
        return EditSession(scene)

    session = opened()
    names = session.skeleton.names
    file = tmp_path / "skeleton.json"
    assert file.is_file()
    session.rename_part(names[0], "left half")
    assert opened().skeleton.names == names, "the edit's skeleton is its own until it is saved"
    session.save_skeleton()
    assert opened().skeleton == session.skeleton
    content = json.loads(file.read_text())
    file.write_text(json.dumps({**content, "scene": {**content["scene"], "fingerprint": "00000000"}}))
    assert opened().skeleton.names == names, "a skeleton of other control points is found anew"
    file.write_text("{")
    with pytest.raises(UserError, match=r"skeleton\.json: not valid JSON"):
        _ = opened().skeleton


def test_a_folder_that_cannot_be_written_is_read_only(tmp_path):
    scene = bar_scene()
    scene.folder = tmp_path / "missing"
    assert len(EditSession(scene).skeleton.parts) >= 2


def test_a_still_run_keeps_its_skeleton(tmp_path):
    still = bar_scene()
    still.folder = tmp_path
    session = EditSession(with_control_points(still, 40))
    session.rename_part(session.skeleton.names[0], "left half")
    assert session.save_skeleton() == tmp_path / "skeleton.json"
    assert EditSession(with_control_points(still, 40)).skeleton == session.skeleton


def test_a_part_is_turned_in_files_of_every_version(session):
    """In version 1, ``turns`` of handles that pose a part had no effect, whatever its number of control points."""
    content = {"format": "scgs-warp edit", "handles": [{"part": name} for name in session.skeleton.names]}
    for version in (1, 2):
        edit = edit_file.parse({**content, "version": version}, "the file", session.engine, lambda: session.skeleton)
        assert {handle.turns for handle in edit.handles} == {None}


def test_whole_numbers_may_be_written_as_other_languages_do(session, tmp_path):
    session.add_handle([3, 4], time=0.0, name="hand")
    session.pin([7])
    session.turn("shoulder_left", 45, (0, 1, 0))
    session.add_keyframe(1.0)
    session.apply(dataclasses.replace(session.edit, holds=(Hold((5,), 0.5),)))
    session.save(tmp_path / "edit.json")

    def spelt(value):
        if isinstance(value, dict):
            return {name: spelt(item) for name, item in value.items()}
        if isinstance(value, list):
            return [spelt(item) for item in value]
        return float(value) if isinstance(value, int) and not isinstance(value, bool) else value

    content = spelt(json.loads((tmp_path / "edit.json").read_text()))
    assert content["version"] == 2.0 and isinstance(content["skeleton"]["parts"][0]["nodes"][0], float)
    (tmp_path / "other.json").write_text(json.dumps(content))
    other = session.fork()
    other.load(tmp_path / "other.json")
    assert other.edit == session.edit
    content["film"]["size"] = 400.5
    (tmp_path / "other.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"film.size is 400.5; give a whole number"):
        other.load(tmp_path / "other.json")
