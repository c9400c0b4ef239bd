"""Requests for exports: the format by its suffix, and options that cannot work."""

from __future__ import annotations

from pathlib import Path

import pytest

from scgs_warp.errors import UserError
from scgs_warp.export.request import ExportRequest, check_request


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("a.ply", "ply"),
        ("a.SPZ", "spz"),
        ("a.glb", "glb"),
        ("a.npz", "npz"),
        ("a.json", "cameras"),
        ("a.htm", "html"),
        ("frames", "ply-sequence"),
        ("a.compressed.ply", "compressed.ply"),
        ("compressed.ply", "ply"),
        ("a.sog", "sog"),
        ("new/meta.json", "sog"),
    ],
)
def test_the_suffix_decides_the_format(name, kind):
    assert ExportRequest(Path(name)).kind == kind
    assert ExportRequest(Path(name), format="graph").kind == "graph"


def test_a_glb_is_still_where_an_instant_is_given():
    run = Path("run")
    assert not ExportRequest(Path("a.glb"), run=run).still
    assert (
        ExportRequest(Path("a.glb"), run=run, time=0.5).still and ExportRequest(Path("a.glb"), ply=Path("a.ply")).still
    )
    assert ExportRequest(Path("a.ply"), run=run).still and not ExportRequest(Path("a.npz"), run=run).still


@pytest.mark.parametrize(
    ("name", "fields", "words"),
    [
        ("a.txt", {}, "no format ends in .txt"),
        ("a", {"run": None, "ply": Path("b.ply")}, "has no suffix; end the name in one of .ply, .compressed.ply"),
        ("a.ply", {"ply": Path("b.ply")}, "one of --run and --ply"),
        ("a.ply", {"time": 1.5}, "--time 1.5"),
        ("a.npz", {"time": 0.5}, "the format holds all times"),
        ("a.ply", {"at": 1.0}, "--at 1"),
        ("a.ply", {"frames": 3}, "--frames"),
        ("a.npz", {"frames": 0}, "--frames 0"),
        ("a.4dgs", {"frames": 1}, "--frames 1: --format 4dgs needs at least two moments"),
        ("a.npz", {"fps": float("nan")}, "--fps nan"),
        ("a.npz", {"title": "x"}, "--title"),
        ("a.html", {"max_mib": 0.0}, "--max-mib 0"),
        ("a.json", {"edit": Path("e.json")}, "--format cameras"),
        ("a.glb", {"pose": True}, "--pose: belongs to a page"),
        ("a.glb", {"captions": Path("a.vtt")}, "--captions: belongs to a page"),
        ("a.html", {"url": "scene.html"}, "--url scene.html: give the page's whole address"),
        ("a.ply", {"format": "glb"}, "end the name in .glb"),
        ("a.ply", {"format": "compressed.ply"}, "end the name in .compressed.ply"),
        ("meta.json", {"format": "cameras"}, r"end the name in .json \(not meta.json\) for"),
        ("a.ply", {"spz_version": 3}, "--spz-version: --format ply has no such versions"),
        ("a.compressed.ply", {"format": "ply"}, "end the name in .ply, not in .compressed.ply"),
        ("a.mp4", {"format": "ply-sequence"}, "a.mp4: is named like a file; name a folder for the frames"),
        ("a.SOG", {"format": "sog-sequence"}, "a.SOG: is named like a file; name a folder for the frames"),
        (".glb", {}, r"\.glb: is a suffix without a name; put one before it"),
    ],
)
def test_options_that_cannot_work_are_refused_in_one_line(tmp_path, name, fields, words):
    with pytest.raises(UserError, match=words) as caught:
        check_request(ExportRequest(tmp_path / "new" / name, **{"run": tmp_path, **fields}))
    assert "\n" not in str(caught.value) and list(tmp_path.iterdir()) == []


def test_what_an_export_reads_is_not_written_over(tmp_path):
    for name in ("points.csv", "config.json", "a.ply"):
        (tmp_path / name).write_text("kept")
    for name, fields in (
        ("points.csv", {"format": "tracks", "points": str(tmp_path / "points.csv")}),
        ("config.json", {"format": "cameras"}),
        ("a.ply", {"run": None, "ply": tmp_path / "a.ply"}),
    ):
        with pytest.raises(UserError, match="would be overwritten"):
            check_request(ExportRequest(tmp_path / name, **{"run": tmp_path, **fields}))


def test_a_good_request_makes_the_folders_above(tmp_path):
    check_request(ExportRequest(tmp_path / "new" / "a.npz", run=tmp_path, frames=3, fps=5.0))
    assert (tmp_path / "new").is_dir()
