"""Zip archives of phone apps are unpacked for the import, and nothing of them remains."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from helpers.foreign_scenes import COUNT, write_record3d, write_scanner
from helpers.importing import entries, refused, silent
from scgs_warp.capture import import_scene
from scgs_warp.capture.imports import archives
from scgs_warp.errors import UserError


def zipped(folder: Path, path: Path, top: str = "", **more: str) -> Path:
    """Pack a folder, below ``top`` if given, and texts under their names."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, f"{top}{file.relative_to(folder).as_posix()}")
        for name, text in more.items():
            archive.writestr(name, text)
    return path


def r3d_folder(folder: Path) -> Path:
    record = write_record3d(folder)
    (record / "metadata.json").rename(record / "metadata")
    (record / "rgb").rename(record / "rgbd")
    return record


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize("top", ["", "capture/", "a/b/"])
def test_an_archive_is_imported_as_its_folder_is(top, tmp_path):
    record = r3d_folder(tmp_path / "record3d")
    archive = zipped(record, tmp_path / "walk.r3d", top, **{"__MACOSX/._walk": "x", ".DS_Store": "x"})
    made = import_scene(archive, tmp_path / "of-archive", silent)
    import_scene(record, tmp_path / "of-folder", silent)
    assert made.program == "Record3D" and made.frames == COUNT
    assert files_of(tmp_path / "of-archive") == files_of(tmp_path / "of-folder")
    assert not list(tmp_path.glob(".*")), "something unpacked remains"


def test_a_zip_of_another_app(tmp_path):
    scanner = write_scanner(tmp_path / "scanner")
    made = import_scene(zipped(scanner, tmp_path / "scan.ZIP", "2026_scan/"), tmp_path / "new" / "data", silent)
    assert made.program == "3D Scanner App" and len(entries(tmp_path / "new" / "data")) == made.frames


def test_errors_name_the_place_in_the_archive(tmp_path):
    record = r3d_folder(tmp_path / "record3d")
    (record / "metadata").write_text("{}")
    archive = zipped(record, tmp_path / "walk.r3d")
    with pytest.raises(UserError) as caught:
        import_scene(archive, tmp_path / "out", silent)
    assert str(caught.value).startswith(f"{archive}/metadata: ") and "unpacked" not in str(caught.value)
    refused(archive, tmp_path, "poses")


def test_archives_that_cannot_be_unpacked(tmp_path, monkeypatch):
    (tmp_path / "walk.r3d").write_bytes(b"PK")
    refused(tmp_path / "walk.r3d", tmp_path, "no zip archive, or a damaged one")
    record = r3d_folder(tmp_path / "record3d")
    whole = zipped(record, tmp_path / "whole.zip").read_bytes()
    (tmp_path / "cut.zip").write_bytes(whole[: len(whole) // 2])
    refused(tmp_path / "cut.zip", tmp_path, "no zip archive, or a damaged one")
    broken = bytearray(whole)
    broken[200:400] = bytes(200)
    (tmp_path / "broken.zip").write_bytes(broken)
    refused(tmp_path / "broken.zip", tmp_path, "no zip archive, or a damaged one")
    (tmp_path / "walk.tar.gz").write_bytes(b"x")
    refused(tmp_path / "walk.tar.gz", tmp_path, "is an archive; unpack it")
    (tmp_path / "empty.zip").write_bytes(zipped(tmp_path / "nothing", tmp_path / "e.zip").read_bytes())
    refused(tmp_path / "empty.zip", tmp_path, "is no scene of MegaSaM")
    monkeypatch.setattr(archives, "LEAST_FREE", 1 << 62)
    refused(tmp_path / "whole.zip", tmp_path, "has room for 0.0 GB; free some")


def test_an_encrypted_archive(tmp_path):
    data = bytearray(zipped(r3d_folder(tmp_path / "record3d"), tmp_path / "walk.zip").read_bytes())
    at = data.index(b"PK\x01\x02")
    data[at + 8] |= 1  # general purpose flag of the first entry of the directory
    (tmp_path / "walk.zip").write_bytes(data)
    refused(tmp_path / "walk.zip", tmp_path, "is encrypted; export it without a password")


@pytest.mark.parametrize("name", ["../outside", "a/../../outside", "/outside", "..\\outside"])
def test_no_file_is_written_outside_the_folder(name, tmp_path):
    archive = zipped(r3d_folder(tmp_path / "inner" / "record3d"), tmp_path / "inner" / "walk.zip", "", **{name: "x"})
    try:
        import_scene(archive, tmp_path / "inner" / "data", silent)
    except UserError as error:
        assert "damaged" in str(error)
    assert not list(tmp_path.rglob("outside")) and not Path("/outside").exists()


def test_two_members_of_one_name(tmp_path):
    """The second does not overwrite the first."""
    with pytest.warns(UserWarning, match="Duplicate"):
        archive = zipped(tmp_path / "nothing", tmp_path / "twice.zip", **{"a": "x"})
        with zipfile.ZipFile(archive, "a") as more:
            more.writestr("a", "y")
    refused(archive, tmp_path, "cannot be unpacked")


def test_a_member_that_says_it_is_smaller_is_cut(tmp_path):
    """The room on the disk is compared with the sizes in the directory."""
    archive = zipped(tmp_path / "nothing", tmp_path / "bomb.zip", **{"big": "x" * 5000})
    with zipfile.ZipFile(archive) as opened:
        member = opened.getinfo("big")
        member.file_size = 10
        try:
            archives._write(opened, member, tmp_path)
        except zipfile.BadZipFile:
            pass
    assert (tmp_path / "big").stat().st_size <= 10
