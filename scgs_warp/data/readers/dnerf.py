"""Reader of the D-NeRF / Blender layout: ``transforms_{train,val,test}.json`` beside folders of images.

``camera_angle_x`` (horizontal field of view, radians) or ``fl_x, fl_y, cx, cy, w, h`` (pixels); per frame
``file_path``, ``transform_matrix`` (camera-to-world, OpenGL: x right, y up, z backward), ``time`` in [0, 1] or else
``timestep_index`` or ``timestamp``, and, if the frame has them, ``mask_path`` (black: not valid) and ``fg_mask_path``
(black: transparent). ``points3d.ply``: initial points, if the images are filled.
Layout: Pumarola et al., D-NeRF, CVPR 2021, and NeRF's Blender scenes.
"""

from __future__ import annotations

import re
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import UserError
from ...storage.json_files import read_json
from ..assemble import FrameRecord, assemble, with_points
from ..choice import Choice, choose, choose_instants, of_cameras, present
from ..dataset import Dataset
from ..held_out import held_out
from ..images import ReadOptions
from ..moved_images import parts_of
from ..points import read_points
from .transforms import (
    Times,
    find_mask,
    moments_of,
    note_reduced,
    read_distortion,
    read_lens,
    read_pose,
    read_times,
    read_transforms,
)
from .transforms_images import films_of, find_foregrounds, find_images

POINTS = "points3d.ply"
"""Points of films of rigs that are converted to this layout."""
NUMBER = re.compile(r"([0-9]{1,9})(?:\.[A-Za-z]+)?$")
"""The number at the end of the name of an image."""
LEAST_COLOR = 0.02
"""Largest difference of random points' colours."""


def transforms_path(folder: Path, split: str) -> Path:
    return folder / f"transforms_{split}.json"


def recognises(folder: Path) -> bool:
    """Return whether the folder holds this layout. Beside a file of another layout, held-out frames alone do not
    make it."""
    there = [split for split in ("train", "test", "val") if transforms_path(folder, split).is_file()]
    return "train" in there or (bool(there) and not (folder / "transforms.json").is_file())


def read(folder: Path, split: str, options: ReadOptions) -> Dataset:
    """Read one split. If the files of ``test`` and ``val`` are both missing, every eighth frame of ``train`` is held
    out; if one of them is missing, the other one serves for both. A file of which no image exists counts as missing.

    Raises:
        UserError: the data is invalid; one line names the file, the field and the remedy.
    """
    path, shared = _path(folder, split)
    content = _read_file(path)
    entries = content["frames"]
    poses = [read_pose(path, index, entry) for index, entry in enumerate(entries)]
    times, scaled = _times(folder, path, entries)
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
    smaller = note_reduced(path, {**content, **entries[chosen[0]]}, files[chosen[0]])
    notes = [*located.notes, *_of_films(path, len(entries)), *scaled, *choice.notes, *smaller, *_unused(folder)]
    if not shared and split != "train":
        notes += _of_trained(folder, path, [entries[index] for index in chosen])
        notes += _of_unseen(folder, path, split, [times[index] for index in chosen])
    records, cut_out = [], find_foregrounds(path, folder, entries, chosen)
    for index, foreground in zip(chosen, cut_out):
        fields = {**content, **entries[index]}
        read_distortion(path, fields)
        lens = partial(read_lens, path, fields, index)
        states_size = "w" in fields or "h" in fields
        mask = find_mask(path, folder, index, entries[index])
        frame = (files[index], poses[index], choice.times[index], lens, files[index].stem, mask)
        records.append(FrameRecord(*frame, states_size=states_size, cut_out_by=foreground))
    data = assemble(records, options, folder=folder, split=split, one_size=True, notes=notes)
    return data if data.with_alpha else with_points(data, *_points(folder / POINTS))


def _read_file(path: Path) -> dict[str, Any]:
    """Read a file, with all images of the films of which it lists one each."""
    content, training = read_transforms(path), transforms_path(path.parent, "train")
    others = read_transforms(training)["frames"] if path != training and training.is_file() else []
    return {**content, "frames": films_of(path.parent, content["frames"], others)}


def _of_films(path: Path, count: int) -> list[str]:
    """Return a note if a file lists one image of each film, and ``count`` are read."""
    listed = len(read_transforms(path)["frames"])
    if listed == count:
        return []
    return [f"{path}: lists one image of each of {listed} cameras; all {count} images in their folders are read"]


def _points(path: Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Read points [P, 3] and their colours [P, 3]; None for both without a file, and if all are of one grey: programs
    leave random points of this kind there."""
    if not path.is_file():
        return None, None
    points, colors = read_points(path)
    return (None, None) if colors is None or not len(colors) or np.ptp(colors) < LEAST_COLOR else (points, colors)


def _path(folder: Path, split: str) -> tuple[Path, bool]:
    """Return the file of the split, and whether the file is shared by all splits. A missing file for ``test`` or
    ``val`` is replaced by the other one or, without either, by the file for ``train``, which is then shared."""
    there = [name for name in ("test", "val") if _is_used(folder, name)]
    if not there and transforms_path(folder, "train").is_file():
        return transforms_path(folder, "train"), True
    return transforms_path(folder, split if split in ("train", *there) else (there or [split])[0]), False


def _is_used(folder: Path, split: str) -> bool:
    """Return whether the file of a split is there and, beside one for ``train``, lists a frame whose image exists.
    Files of camera paths list none, or some that were never rendered. What is no list of frames counts: it is refused
    later."""
    path = transforms_path(folder, split)
    if not path.is_file() or split == "train" or not transforms_path(folder, "train").is_file():
        return path.is_file()
    try:
        content = read_json(path)
        if isinstance(content, dict) and content.get("frames") == []:
            return False
        files = find_images(path, folder, _read_file(path)["frames"]).files
    except UserError:
        return True
    return any(file.is_file() for file in files)


def _unused(folder: Path) -> list[str]:
    """Return notes on files of which no image exists."""
    paths = {split: transforms_path(folder, split) for split in ("test", "val")}
    unused = [path for split, path in paths.items() if path.is_file() and not _is_used(folder, split)]
    return [f"{path}: is not used, because none of its frames has an image" for path in unused]


def _times(folder: Path, path: Path, entries: list[dict[str, Any]]) -> Times:
    """Return the times of a file's frames, on the scale of those of all splits."""
    paths = [transforms_path(folder, split) for split in ("train", "test", "val") if _is_used(folder, split)]
    others = {other: _read_file(other)["frames"] for other in paths if other != path}
    elsewhere = [entry for frames in others.values() for entry in frames]
    if any(entry.get("time") is not None for entry in [*entries, *elsewhere]):
        return read_times(path, entries, elsewhere)
    if _is_animation(others.get(transforms_path(folder, "train"), entries), [entries, *others.values()]):
        return Times(_numbers_as_times(entries, [*entries, *elsewhere]), ())
    if others and _is_numbered([*entries, *elsewhere]):
        return Times(_numbers_as_times(entries, [*entries, *elsewhere]), ())
    if _is_numbered(entries) or _of_several_cameras(entries):
        moments = moments_of([Path(entry["file_path"]) for entry in entries])
        return Times([moment / max(*moments, 1) for moment in moments], ())
    return read_times(path, entries, elsewhere)


def _of_several_cameras(entries: list[dict[str, Any]]) -> bool:
    """Return whether most of the images have names that are used in several folders: cameras that record at once."""
    names = [entry.get("file_path") for entry in entries]
    paths = [Path(name) for name in names if isinstance(name, str)]
    return len(paths) == len(names) and 2 * len({path.stem for path in paths}) <= len({*paths})


def _is_numbered(entries: list[dict[str, Any]]) -> bool:
    """Return whether the images have names that differ in their numbers alone, and no number twice, as those of one
    film have, in whatever order and in however many files they are listed."""
    names = [NUMBER.sub("", str(entry.get("file_path"))) for entry in entries]
    numbers = {_number(entry) for entry in entries}
    return len(set(names)) == 1 and None not in numbers and 1 < len(numbers) == len(entries)


def _is_animation(training: list[dict[str, Any]], files: list[list[dict[str, Any]]]) -> bool:
    """Return whether frames without times are of one animation, whose numbers their names tell: each file lists the
    frames of ``training``, and further ones between them or beyond by less than their largest step. Of other scenes,
    each file numbers its own views from the first on."""
    frames = [entry for entries in files for entry in entries]
    numbers, trained = [_number(entry) for entry in frames], sorted({_number(entry) or 0 for entry in training})
    if len(files) < 2 or len(trained) < 2 or None in numbers:
        return False
    step = max(later - earlier for earlier, later in pairwise(trained))
    within = all(trained[0] - step < (number or 0) < trained[-1] + step for number in numbers)
    return within and all(set(trained) <= {_number(entry) for entry in entries} for entries in files)


def _number(entry: dict[str, Any]) -> int | None:
    """Return the number at the end of the name of a frame's image; None without one."""
    name = entry.get("file_path")
    match = NUMBER.search(name) if isinstance(name, str) else None
    return None if match is None else int(match[1])


def _numbers_as_times(entries: list[dict[str, Any]], every: list[dict[str, Any]]) -> list[float]:
    """Return the numbers of frames, scaled so that those of ``every`` frame go from 0 to 1."""
    numbers = [_number(entry) or 0 for entry in every]
    first, last = min(numbers), max(numbers)
    return [((_number(entry) or 0) - first) / (last - first) for entry in entries]


def _of_trained(folder: Path, path: Path, held: list[dict[str, Any]]) -> list[str]:
    """Return a note if held-out frames are among those that are trained on."""
    training = transforms_path(folder, "train")
    if not training.is_file():
        return []
    trained = {_identity(entry) for entry in _read_file(training)["frames"]}
    count = sum(_identity(entry) in trained for entry in held)
    if count == 0:
        return []
    return [
        f"{path}: {count} of {len(held)} frames are trained on as well, so that their scores are not of held-out "
        f"views; remove {path.name} to hold out every eighth training frame"
    ]


def _of_unseen(folder: Path, path: Path, split: str, held: list[float]) -> list[str]:
    """Return a note if held-out frames are before or after all times that are trained on, by more than the distance of
    training frames: their motion can only be guessed."""
    training = transforms_path(folder, "train")
    if not training.is_file():
        return []
    trained = sorted(set(_times(folder, training, _read_file(training)["frames"]).times))
    apart = 1.5 * max((later - earlier for earlier, later in pairwise(trained)), default=0.0)
    count = sum(not trained[0] - apart <= time <= trained[-1] + apart for time in held)
    if count == 0:
        return []
    other = {"test": "val", "val": "test"}[split]
    more = transforms_path(folder, other) != path and _is_used(folder, other)
    way = f"; evaluate --split {other} scores others" if more else ""
    return [
        f"{path}: {count} of {len(held)} frames are of times beyond those of {training.name}, so that their scores "
        f"tell how motion goes on where nothing shows it{way}"
    ]


def _identity(entry: dict[str, Any]) -> tuple[str, str]:
    """Return what two entries of one image have in common."""
    return "/".join(parts_of(str(entry.get("file_path")))), str(entry.get("time"))


def _check_times(folder: Path, path: Path, entries: list[dict[str, Any]]) -> None:
    """Refuse held-out frames without times beside training frames with times, and the reverse: the order in one file
    tells nothing of the times in the other."""
    training = transforms_path(folder, "train")
    if not training.is_file():
        return
    timed, trained = (
        any(entry.get("time") is not None for entry in each) for each in (entries, _read_file(training)["frames"])
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
        instants = choose_instants(_times(folder, training, _read_file(training)["frames"]).times, options)
        assert instants is not None
        indices = [index for index in indices if instants.first <= times[index] <= instants.last]
        scaled = instants.scaled(times)
        if not indices:
            raise UserError(f"{path}: no frame is of the instants that --frames {options.frames} chooses; choose more")
    kept, notes = present(path, files, indices, options)
    return Choice(kept, scaled, notes)
