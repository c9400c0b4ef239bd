"""Reader of the D-NeRF / Blender layout: ``transforms_{train,val,test}.json`` beside folders of images.

``camera_angle_x`` (horizontal field of view, radians) or ``fl_x, fl_y, cx, cy, w, h`` (pixels); per frame
``file_path``, ``transform_matrix`` (camera-to-world, OpenGL: x right, y up, z backward), ``time`` in [0, 1] and, if the
frame has one, ``mask_path`` (black: not valid).
Layout: Pumarola et al., D-NeRF, CVPR 2021, and NeRF's Blender scenes.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from ...errors import UserError
from ..assemble import FrameRecord, assemble
from ..choice import Choice, choose, choose_instants, of_cameras, present
from ..dataset import Dataset
from ..held_out import held_out
from ..images import ReadOptions
from .transforms import find_mask, read_distortion, read_lens, read_pose, read_times, read_transforms
from .transforms_images import find_images


def transforms_path(folder: Path, split: str) -> Path:
    return folder / f"transforms_{split}.json"


def recognises(folder: Path) -> bool:
    """Return whether the folder holds this layout. Beside a file of another layout, held-out frames alone do not
    make it."""
    there = [split for split in ("train", "test", "val") if transforms_path(folder, split).is_file()]
    return "train" in there or (bool(there) and not (folder / "transforms.json").is_file())


def read(folder: Path, split: str, options: ReadOptions) -> Dataset:
    """Read one split. If the files of ``test`` and ``val`` are both missing, every eighth frame of ``train`` is held
    out; if one of them is missing, the other one serves for both.

    Raises:
        UserError: the data is invalid; one line names the file, the field and the remedy.
    """
    path, shared = _path(folder, split)
    content = read_transforms(path)
    entries = content["frames"]
    poses = [read_pose(path, index, entry) for index, entry in enumerate(entries)]
    times = read_times(path, entries)
    if not shared and split != "train":
        _check_times(folder, path, entries)
    located = find_images(path, folder, entries)
    entries, files = located.entries, located.files
    if options.only_cameras:
        of_cameras([""] * len(files), options)
    if shared or split == "train":
        choice = choose(path, files, times, options)
    else:
        choice = _within_training(folder, path, files, times, options)
    chosen = held_out(path, choice.indices, split) if shared else choice.indices
    records = []
    for index in chosen:
        fields = {**content, **entries[index]}
        read_distortion(path, fields)
        lens = partial(read_lens, path, fields, index)
        states_size = "w" in fields or "h" in fields
        mask = find_mask(path, folder, index, entries[index])
        frame = (files[index], poses[index], choice.times[index], lens, files[index].stem, mask)
        records.append(FrameRecord(*frame, states_size=states_size))
    return assemble(records, options, folder=folder, split=split, one_size=True, notes=[*located.notes, *choice.notes])


def _path(folder: Path, split: str) -> tuple[Path, bool]:
    """Return the file of the split, and whether the file is shared by all splits. A missing file for ``test`` or
    ``val`` is replaced by the other one or, without either, by the file for ``train``, which is then shared."""
    there = [name for name in ("test", "val") if transforms_path(folder, name).is_file()]
    if not there and transforms_path(folder, "train").is_file():
        return transforms_path(folder, "train"), True
    return transforms_path(folder, split if split in ("train", *there) else (there or [split])[0]), False


def _check_times(folder: Path, path: Path, entries: list[dict[str, Any]]) -> None:
    """Refuse held-out frames without times beside training frames with times, and the reverse: the order in one file
    tells nothing of the times in the other."""
    training = transforms_path(folder, "train")
    if not training.is_file():
        return
    timed, trained = (
        any(entry.get("time") is not None for entry in each) for each in (entries, read_transforms(training)["frames"])
    )
    if timed != trained:
        lacks, has = (training, path) if timed else (path, training)
        raise UserError(
            f"{lacks}: its frames have no time, but those of {has.name} have; give each frame its time"
            + (f", or remove {lacks.name} (training frames are then held out)" if lacks == path else "")
        )


def _within_training(folder: Path, path: Path, files: list[Path], times: list[float], options: ReadOptions) -> Choice:
    """Choose the held-out frames from the first to the last of the instants that ``--frames`` chooses for training."""
    indices, scaled = list(range(len(files))), times
    if options.frames:
        training = transforms_path(folder, "train")
        instants = choose_instants(read_times(training, read_transforms(training)["frames"]), options)
        assert instants is not None
        indices = [index for index in indices if instants.first <= times[index] <= instants.last]
        scaled = instants.scaled(times)
        if not indices:
            raise UserError(f"{path}: no frame is of the instants that --frames {options.frames} chooses; choose more")
    kept, notes = present(path, files, indices, options)
    return Choice(kept, scaled, notes)
