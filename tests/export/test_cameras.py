"""Cameras as nerfstudio's transforms.json."""

from __future__ import annotations

import dataclasses
import json

import torch

from scgs_warp.data import load
from scgs_warp.data.dataset import Dataset
from scgs_warp.export.cameras import write_cameras


def test_cameras_are_read_back(tmp_path):
    from helpers.tiny import write_dnerf

    folder = write_dnerf(tmp_path / "blobs")
    splits = {split: load(folder, split) for split in ("train", "test")}
    assert write_cameras(tmp_path / "transforms.json", splits) == 11
    content = json.loads((tmp_path / "transforms.json").read_text())
    for name in content["train_filenames"]:  # its images are where the file says
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    for name in content["test_filenames"]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    again = tmp_path / "again"
    again.mkdir()
    for name in ("transforms.json", "train", "test"):
        (tmp_path / name).rename(again / name)
    for split, truth in splits.items():
        found = load(again, split)
        assert len(found) == len(truth)
        for ours, theirs in zip(found.entries, truth.entries):
            assert ours.time == theirs.time and ours.name == theirs.name
            torch.testing.assert_close(ours.camera.viewmat, theirs.camera.viewmat, atol=1e-6, rtol=0)
            torch.testing.assert_close(ours.camera.K, theirs.camera.K)


def test_frames_of_one_name_in_the_folders_of_a_rig_are_told_apart(tmp_path):
    from helpers.tiny import tiny_dataset

    frames = [dataclasses.replace(frame, name=f"{index % 2:04d}") for index, frame in enumerate(tiny_dataset(4))]
    write_cameras(tmp_path / "transforms.json", {"train": Dataset(frames, folder=tmp_path, split="train")})
    content = json.loads((tmp_path / "transforms.json").read_text())
    names = ["train/0000.png", "train/0001.png", "train/0000_00002.png", "train/0001_00003.png"]
    assert content["train_filenames"] == names == [frame["file_path"] for frame in content["frames"]]
