"""Parts that pages rename, merge and split, and what is chosen, through the editor's server."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from helpers.edit_scenes import bar_scene
from helpers.studios import Page
from scgs_warp.edit import EditSession, edit_file
from scgs_warp.editor import Editor
from scgs_warp.editor.autosave import Autosave

pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")


def serve(folder: Path, restore: bool = True) -> Editor:
    session = EditSession(bar_scene(nodes=40, gaussians=600))
    keeper = Autosave(session, folder)
    keeper.start(restore=restore)
    return Editor(session, folder, title="bar", port=0, autosave=keeper)


@pytest.fixture
def editor(tmp_path) -> Iterator[Editor]:
    made = serve(tmp_path)
    yield made
    made.stop()


def parts_of(page: Page) -> dict:
    """The newest message about the parts."""
    return [message["parts"] for message in page.heard if "parts" in message][-1]


def names_of(page: Page) -> list[str]:
    return [part["name"] for part in parts_of(page)["list"]]


def test_a_part_is_renamed_undone_and_kept(editor, page, tmp_path):
    first, *others = names_of(page)
    page.ask("choose_part", name=first)
    page.ask("put", degrees=[0, 0, 20], at=0.0)
    nodes = page.state["selection"]
    assert "problem" not in page.ask("rename_part", name=first, to="  left half ")
    assert names_of(page) == ["left half", *others] and page.state["part"] == "left half"
    assert page.state["selection"] == nodes and page.state["handles"][0]["part"] == "left half"
    assert page.state["handles"][0]["name"] == page.state["active"] == "left half"
    assert editor.autosave is not None and editor.autosave.flush()
    kept = edit_file.read(tmp_path / "autosave.json", editor.session.engine)
    assert kept == editor.session.edit and kept.skeleton is not None and "left half" in kept.skeleton.names
    page.ask("undo")
    assert names_of(page) == [first, *others] and page.state["part"] == first, "the same part stays chosen"
    page.ask("redo")
    assert page.state["part"] == "left half"


@pytest.mark.parametrize("new", ["", "   ", "x" * 101, "a\nb", "\u202egnp", 7], ids=repr)
def test_what_is_no_name_is_refused_in_one_line(editor, page, new):
    first, second = names_of(page)[:2]
    for what, fields in (("rename_part", {"name": first}), ("split_part", {})):
        page.ask("select", what="nodes", nodes=[editor.session.skeleton.part(first).nodes[0]], how="replace")
        answer = page.ask(what, to=new, **fields)["problem"]
        assert "no name" in answer and "\n" not in answer and len(answer) < 120, what
    assert "is taken" in page.ask("rename_part", name=first, to=second)["problem"]
    assert page.state["unedited"] and not page.state["undo"]


@pytest.mark.parametrize(
    "name", ["\U0001f44d", "\U0001f468\u200d\U0001f469\u200d\U0001f467", "ידיים", "می\u200cرود", "<b>x</b>"]
)
def test_names_of_other_scripts_are_kept(editor, page, name, tmp_path):
    page.ask("rename_part", name=names_of(page)[0], to=name)
    assert names_of(page)[0] == name
    page.ask("save", name="mine")
    page.ask("reset")
    assert "problem" not in page.ask("load", name="mine.json") and names_of(page)[0] == name


def test_parts_are_split_and_merged(editor, page):
    before = parts_of(page)
    name = names_of(page)[0]
    nodes = list(editor.session.skeleton.part(name).nodes)
    assert "nothing is chosen" in page.ask("split_part")["problem"]
    page.ask("select", what="all")
    assert "choose points of one part" in page.ask("split_part")["problem"]
    page.ask("choose_part", name=name)
    assert "some but not all" in page.ask("split_part")["problem"]
    page.ask("select", what="nodes", nodes=nodes[:3], how="replace")
    assert "is taken" in page.ask("split_part", to=name)["problem"]
    page.ask("split_part", to="tip")
    now = parts_of(page)
    assert names_of(page)[-1] == "tip" == page.state["part"] and page.state["selection"] == nodes[:3]
    assert now["list"][-1]["parent"] == 0 and [now["owner"][m] for m in nodes[:3]] == [len(now["list"]) - 1] * 3
    assert len(now["chains"]) == len(now["list"]) and now["chains"][-1][0] == len(now["list"]) - 1
    page.ask("merge_parts", name=name, other="tip")
    assert parts_of(page)["owner"] == before["owner"] and page.state["part"] == name
    assert "no part is called" in page.ask("merge_parts", name=name, other="tip")["problem"]
    page.ask("undo")
    assert page.state["part"] == name and len(page.state["selection"]) == len(nodes) - 3, "it has its points again"


def test_parts_are_attached_to_others(editor, page):
    page.ask("select", what="nodes", nodes=list(editor.session.skeleton.parts[0].nodes[:3]), how="replace")
    page.ask("split_part", to="tip")
    first = names_of(page)[0]
    assert "hang on itself" in page.ask("attach_part", name="tip", other="tip")["problem"]
    page.ask("attach_part", name="tip")
    assert parts_of(page)["list"][-1]["parent"] == -1 and page.state["part"] == "tip"
    page.ask("attach_part", name="tip", other=first)
    assert parts_of(page)["list"][-1]["parent"] == 0
    page.ask("undo")
    assert parts_of(page)["list"][-1]["parent"] == -1


def test_a_handle_is_renamed_with_its_keys(editor, page):
    page.ask("select", what="nodes", nodes=[0, 1], how="replace")
    page.ask("put", degrees=[0, 0, 20], at=0.0)
    page.ask("key", at=1.0)
    (name,) = (handle["name"] for handle in page.state["handles"])
    curve = page.state["curve"]
    page.ask("rename_handle", name=name, to="tip")
    assert page.state["active"] == "tip" and page.state["keyframes"][0]["names"] == ["tip"]
    assert page.state["curve"] == curve
    page.ask("select", what="nodes", nodes=[5, 6], how="replace")
    page.ask("put", degrees=[0, 0, 20], at=0.0)
    assert "is taken" in page.ask("rename_handle", name=page.state["active"], to="tip")["problem"]
    assert "no handle is called" in page.ask("rename_handle", name="nobody", to="x")["problem"]


def test_another_page_cannot_change_anything_during_a_drag(editor, page):
    """Nothing but what leaves the edit alone: its own selection would take the place of the dragged part."""
    first, second = names_of(page)[:2]
    other = Page(editor)
    try:
        page.ask("choose_part", name=first)
        page.ask("grab", at=0.0)
        edit = editor.session.edit
        for what, fields in (
            ("rename_part", {"name": first, "to": "x"}), ("choose_part", {"name": second}), ("undo", {}), ("reset", {}),
            ("pick", {"how": "replace"}), ("key", {}), ("film", {"seconds": 2}),
        ):  # fmt: skip
            assert "another page drags" in other.ask(what, **fields)["problem"], what
        assert "problem" not in other.ask("tool", rings=3)
        assert editor.session.edit == edit and editor.model.dragging and page.state["part"] == first
        page.ask("release", at=0.0)
        assert "problem" not in other.ask("rename_part", name=first, to="x")
    finally:
        other.close()


def test_a_key_during_a_drag_ends_the_drag_first(editor, page):
    """The same page: what was dragged and the key are two steps, and neither is lost."""
    grip = editor.worker.call(lambda: editor.session.node_positions(0.0))[0].tolist()
    page.ask("select", what="nodes", nodes=[0, 1], how="replace")
    page.ask("grab", at=0.0)
    page.send({"do": "drag", "grip": grip, "to": [g + 0.1 for g in grip]})
    page.until(lambda: not page.state["unedited"])
    page.ask("key", at=0.0)
    page.send({"do": "drag", "grip": grip, "to": [9.0, 9.0, 9.0]})
    page.ask("release", at=0.0)
    assert len(page.state["keyframes"]) == 1 and not page.state["dragging"]
    moved = editor.session.edit.keyframes[0].targets[page.state["active"]].translation
    assert moved == pytest.approx((0.1, 0.1, 0.1), abs=1e-6)
    page.ask("undo")
    assert not page.state["keyframes"] and not page.state["unedited"]


def test_each_page_has_its_own_tool(editor, page):
    other = Page(editor)
    try:
        other.ask("tool", parts_first=True)
        place = editor.worker.call(lambda: editor.session.node_positions(0.0))[0].tolist()
        page.ask("pick", point=place, how="replace", parts_first=False)
        assert page.state["part"] is None and page.state["selection"]
        other.ask("pick", point=place, how="replace", parts_first=True)
        page.until(lambda: page.state["part"])
    finally:
        other.close()


def test_what_is_chosen_outlives_the_server(tmp_path):
    editor = serve(tmp_path)
    page = Page(editor)
    part = names_of(page)[0]
    page.ask("choose_part", name=part)
    page.ask("put", degrees=[0, 0, 20], at=0.0)
    page.ask("tool", rings=5, region="brush", radius=0.3, combine="add", pin_rings=None, parts_first=False)
    page.ask("handle", lasts="fade", window=0.4)
    before = {name: page.state[name] for name in ("part", "selection", "active", "tool")}
    page.close()
    assert editor.autosave is not None and editor.autosave.flush()
    kept = (tmp_path / ".autosave.choice.json").read_bytes()
    editor.stop()

    def opened(restore: bool = True) -> dict:
        served = serve(tmp_path, restore)
        visitor = Page(served)
        answer = {name: visitor.state[name] for name in before}
        assert visitor.hello["files"] == ["autosave.json"] or not restore, "the choice is no edit to load"
        visitor.close()
        served.stop()
        return answer

    assert opened() == before
    for damaged in (b"", b"{", b'{"format": 3}', kept.replace(b'"radius": 0.3', b'"radius": "x"'), b"\xff"):
        (tmp_path / ".autosave.choice.json").write_bytes(damaged)
        assert opened()["selection"] == [], damaged
    (tmp_path / ".autosave.choice.json").write_bytes(kept.replace(b'"fingerprint": "', b'"fingerprint": "0'))
    assert opened()["selection"] == [], "of other control points"
    (tmp_path / ".autosave.choice.json").write_bytes(kept)
    assert opened(restore=False)["selection"] == [], "--new begins afresh"
