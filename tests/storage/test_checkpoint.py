"""Checkpoints are read as they were written, and damage is found; ``tests/robustness`` fills disks and kills runs."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from scgs_warp.errors import UserError
from scgs_warp.storage import checkpoint

TENSORS = {"scene.means": torch.arange(6.0).view(2, 3), "adam.step": torch.tensor(3.0), "empty": torch.zeros(0, 4)}


def test_round_trip(tmp_path: Path):
    checkpoint.write(tmp_path, TENSORS, {"step": 3, "name": "x"})
    tensors, metadata = checkpoint.read(tmp_path)
    assert tensors.keys() == TENSORS.keys() and all(torch.equal(tensors[k], TENSORS[k]) for k in TENSORS)
    assert metadata["step"] == 3 and metadata["name"] == "x" and metadata["format"] == checkpoint.FORMAT


def test_what_was_read_does_not_follow_the_file(tmp_path: Path):
    """A view of the file would also keep Windows from replacing it, as a resumed training does."""
    checkpoint.write(tmp_path, {"a": torch.ones(100_000)}, {})
    tensors, _ = checkpoint.read(tmp_path)
    path = tmp_path / checkpoint.FILE
    with path.open("r+b") as file:
        file.write(bytes(path.stat().st_size))
    assert tensors["a"].eq(1.0).all()


def test_prefixes_choose_tensors(tmp_path: Path):
    checkpoint.write(tmp_path, TENSORS, {})
    tensors, _ = checkpoint.read(tmp_path, ("scene.", "adam."))
    assert sorted(tensors) == ["adam.step", "scene.means"]
    assert list(checkpoint.strip(tensors, "scene.")) == ["means"]


def test_same_content_gives_the_same_bytes(tmp_path: Path):
    for name, order in (("a", 1), ("b", -1)):
        (tmp_path / name).mkdir()
        checkpoint.write(tmp_path / name, dict(list(TENSORS.items())[::order]), {"step": 1, "z": 2})
    a, b = ((tmp_path / name / checkpoint.FILE).read_bytes() for name in "ab")
    assert a == b


def test_shared_memory_is_written_twice(tmp_path: Path):
    whole = torch.arange(4.0)
    checkpoint.write(tmp_path, {"a": whole, "b": whole[1:3]}, {})
    assert checkpoint.read(tmp_path)[0]["b"].tolist() == [1.0, 2.0]


def test_missing_checkpoint_names_the_folder(tmp_path: Path):
    with pytest.raises(UserError, match=r"no checkpoint\.safetensors here; give with --run a folder"):
        checkpoint.read(tmp_path)


def test_a_flipped_bit_is_damage_and_falls_back(tmp_path: Path):
    for step in (1, 2):
        checkpoint.write(tmp_path, TENSORS, {"step": step})
    path = tmp_path / checkpoint.FILE
    content = bytearray(path.read_bytes())
    content[-9] ^= 1
    path.write_bytes(content)
    with pytest.raises(checkpoint.DamagedCheckpoint, match="is not what was written") as caught:
        checkpoint.read(tmp_path)
    said = checkpoint.fall_back(tmp_path, caught.value)
    assert "step 1" in said and checkpoint.read(tmp_path)[1]["step"] == 1
    assert (tmp_path / checkpoint.DAMAGED).read_bytes() == content


def test_damage_without_a_sound_previous_one_stays(tmp_path: Path):
    checkpoint.write(tmp_path, TENSORS, {"step": 1})
    (tmp_path / checkpoint.FILE).write_bytes(b"nonsense")
    with pytest.raises(checkpoint.DamagedCheckpoint) as caught:
        checkpoint.read(tmp_path)
    with pytest.raises(checkpoint.DamagedCheckpoint):
        checkpoint.fall_back(tmp_path, caught.value)


def test_other_format_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "FORMAT", 7)
        checkpoint.write(tmp_path, TENSORS, {})
    with pytest.raises(UserError, match="format 7 is not 1; use the version that wrote it"):
        checkpoint.read(tmp_path)
