"""Checkpoints: one safetensors file, written atomically, beside the previous one.

A checkpoint holds no pickle, path, date or host name.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ..errors import UserError
from . import files
from .json_files import parse_json

FILE = "checkpoint.safetensors"
PREVIOUS = "checkpoint.previous.safetensors"
DAMAGED = "checkpoint.damaged.safetensors"
"""Name given to a damaged checkpoint when training falls back on the previous one."""
METADATA_KEY = "scgs_warp"
"""The only metadata key, which holds sorted JSON, because safetensors writes multiple keys in random order."""
FORMAT = 1
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
TEMPORARY_ERRORS = (errno.EIO, errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE, errno.ESTALE)
"""Errors on reading that do not indicate damage: the file may be sound."""
METADATA_SUM = ""
"""Key of the metadata's check sum, beside those of the tensors."""


class DamagedCheckpoint(UserError):
    """Error that the newest checkpoint cannot be used; the previous one may be sound (:func:`fall_back`)."""


def _sum_of_words(metadata: Mapping[str, Any]) -> int:
    """Return the check sum of the metadata, leaving out the check sums in it."""
    rest = {name: value for name, value in metadata.items() if name != "crc32"}
    return zlib.crc32(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode())


def _sum(tensor: Tensor) -> int:
    return zlib.crc32(np.ascontiguousarray(tensor.numpy()).data)


def write(folder: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
    """Write ``checkpoint.safetensors`` and keep its predecessor as ``checkpoint.previous.safetensors``.

    Whenever the process may end, the folder holds a sound checkpoint under one of the two names. The metadata holds a
    check sum of each tensor and of itself.

    Raises:
        UserError: the checkpoint cannot be written; its predecessor is intact.
    """
    # Cloned, since safetensors refuses tensors that share memory.
    saved = {name: tensors[name].detach().cpu().contiguous().clone() for name in sorted(tensors)}
    sums = {name: _sum(tensor) for name, tensor in saved.items()}
    words = parse_json(json.dumps({**metadata, "format": FORMAT}))
    sums[METADATA_SUM] = _sum_of_words(words)
    text = json.dumps({**words, "crc32": sums}, sort_keys=True, separators=(",", ":"))
    content = save(saved, {METADATA_KEY: text})
    path = folder / FILE
    temporary = files.temporary_of(path)
    try:
        try:
            files.write_and_flush(temporary, content)
        except OSError as error:
            if error.errno not in DISK_FULL or not os.path.exists(path):
                raise
            (folder / PREVIOUS).unlink(missing_ok=True)  # frees room: the disk may hold only two checkpoints
            files.write_and_flush(temporary, content)
        if os.path.exists(path):
            _name_also(path, folder / PREVIOUS)
        os.replace(temporary, path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        remedy = (
            "the one before it is intact: when there is room and leave to write, --resume continues from there"
            if os.path.exists(path)  # Path.exists raises where the folder may not be searched
            else "nothing is saved yet: make room or choose another --output"
        )
        raise UserError(f"{path}: cannot be written ({error.strerror}); {remedy}") from error
    files.sync_folder(folder)


def _name_also(path: Path, name: Path) -> None:
    """Make ``name`` a hard link to ``path``, or a copy where the file system has no hard links."""
    temporary = files.temporary_of(name)
    with suppress(OSError):  # without a previous checkpoint the newest is written all the same
        temporary.unlink(missing_ok=True)
        try:
            os.link(path, temporary)
        except OSError:
            shutil.copyfile(path, temporary)
        os.replace(temporary, name)
    with suppress(OSError):  # renaming one name of a file to another does nothing
        temporary.unlink(missing_ok=True)


def read(
    folder: Path, prefixes: tuple[str, ...] = ("",), *, name: str = FILE
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors whose names start with one of ``prefixes``, and the metadata, from the file ``name``.

    Raises:
        DamagedCheckpoint: the file is damaged, or it is missing while a previous one exists; the message has the
            remedy.
        UserError: there is no checkpoint, or its format is unknown.
    """
    path = folder / name
    check_name(folder)
    spare = name == FILE and (folder / PREVIOUS).is_file()
    remedy = f"{PREVIOUS} is there: apps/train.py --resume falls back on it" if spare else "train again"
    if not path.is_file():
        if spare:
            raise DamagedCheckpoint(f"{path}: is missing; {remedy}")
        if os.path.lexists(path):
            raise UserError(f"{path}: is no file, or a link to one that is gone; restore it")
        raise UserError(f"{folder}: no {name} here; give with --run a folder that apps/train.py wrote")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = parse_json((file.metadata() or {})[METADATA_KEY])
            # Copied, since these are views of the file: Windows would not let the next checkpoint replace it.
            tensors = {key: file.get_tensor(key).clone() for key in file.keys() if key.startswith(prefixes)}
        if not isinstance(metadata, dict):
            raise ValueError("no metadata")
        sums = metadata.get("crc32", {})  # early runs have no check sums
        if METADATA_SUM in sums and sums[METADATA_SUM] != _sum_of_words(metadata):
            raise ValueError("its metadata is not what was written")
        for key, tensor in tensors.items():
            if key in sums and sums[key] != _sum(tensor):
                raise ValueError(f"{key} is not what was written")
    except (SafetensorError, KeyError, ValueError, TypeError, AttributeError, OSError) as error:
        if isinstance(error, OSError) and error.errno in TEMPORARY_ERRORS:
            raise UserError(f"{path}: cannot be read ({error.strerror}); try again, or make it readable") from error
        raise DamagedCheckpoint(f"{path}: damaged or not ours ({error}); {remedy}") from error
    if metadata.get("format") != FORMAT:
        raise UserError(
            f"{path}: format {str(metadata.get('format'))[:20]} is not {FORMAT}; use the version that wrote it"
        )
    return tensors, metadata


def check_name(folder: Path) -> None:
    """Check that checkpoints in a folder can be read: safetensors takes names in UTF-8 alone, which those of other
    systems' files may not be.

    Raises:
        UserError: naming the folder.
    """
    try:
        str(folder).encode()
    except UnicodeEncodeError:
        raise UserError(f"{folder}: is no name in UTF-8, so that checkpoints there cannot be read; rename it") from None


def fall_back(folder: Path, error: DamagedCheckpoint) -> str:
    """Replace a damaged or missing checkpoint by the previous one. The caller holds the run folder's lock.

    Returns:
        A message for the user.

    Raises:
        DamagedCheckpoint: ``error``, if the previous checkpoint is no better.
        UserError: the folder cannot be written.
    """
    path = folder / FILE
    try:
        _, metadata = read(folder, name=PREVIOUS)
    except UserError:
        raise error from None
    step = metadata.get("step")
    if not isinstance(step, int):
        raise error
    try:
        if path.exists():
            os.replace(path, folder / DAMAGED)
        _name_also(folder / PREVIOUS, path)
        path.stat()
    except OSError as failure:
        raise UserError(f"{path}: cannot be replaced ({failure.strerror}); make the folder writable") from error
    files.sync_folder(folder)
    return f"{path}: damaged (kept as {DAMAGED}); training goes on from {PREVIOUS}, step {step}"


def strip(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the tensors under ``prefix``, with the prefix removed from their names."""
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}


def to_device(tensors: Mapping[str, Tensor], device: torch.device | str) -> dict[str, Tensor]:
    """Return the tensors on ``device``."""
    return {name: value.to(device) for name, value in tensors.items()}
