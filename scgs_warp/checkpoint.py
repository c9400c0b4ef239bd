"""Checkpoints: one safetensors file, written atomically, the previous one kept. No pickle; no path, date or host."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from .errors import UserError
from .json_text import parse_json

FILE = "checkpoint.safetensors"
PREVIOUS = "checkpoint.previous.safetensors"
METADATA_KEY = "scgs_warp"
"""All metadata is one key of sorted JSON: safetensors writes several keys in random order."""
FORMAT = 1


def write_atomically(path: Path, content: bytes) -> None:
    """Write beside, flush to disk, rename: a reader sees the old file or the new one, never half of it.

    Raises:
        UserError: the disk is full or the folder cannot be written; the old file is intact.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.unlink(missing_ok=True)  # in a stranger's folder it may be a link to somewhere else
        with open(temporary, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UserError(f"{path}: cannot be written ({error.strerror}); the previous file is intact") from error


def write(folder: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
    """Write ``checkpoint.safetensors``; the one before becomes ``checkpoint.previous.safetensors``."""
    text = json.dumps({"format": FORMAT, **metadata}, sort_keys=True, separators=(",", ":"))
    # A clone, since safetensors refuses tensors that share memory.
    content = save(
        {name: tensors[name].detach().cpu().contiguous().clone() for name in sorted(tensors)}, {METADATA_KEY: text}
    )
    path = folder / FILE
    if path.exists():
        previous = folder / PREVIOUS
        temporary = folder / f".{PREVIOUS}.tmp"
        temporary.unlink(missing_ok=True)
        try:
            os.link(path, temporary)
            os.replace(temporary, previous)
        except OSError:
            pass  # a file system without hard links: the replacement below is atomic all the same
    write_atomically(path, content)


def read(folder: Path, prefixes: tuple[str, ...] = ("",)) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors whose names start with one of ``prefixes``, and the metadata.

    Raises:
        UserError: there is no checkpoint, or it is damaged (with the remedy).
    """
    path = folder / FILE
    if not path.is_file():
        raise UserError(f"{folder}: no {FILE} here; give a run directory that apps/train.py wrote")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = parse_json((file.metadata() or {})[METADATA_KEY])
            tensors = {name: file.get_tensor(name) for name in file.keys() if name.startswith(prefixes)}
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise UserError(
            f"{path}: damaged or not ours ({error}); {PREVIOUS} beside it may be intact: rename it"
        ) from error
    if not isinstance(metadata, dict):
        raise UserError(f"{path}: damaged or not ours (no metadata); {PREVIOUS} beside it may be intact: rename it")
    if metadata.get("format") != FORMAT:
        raise UserError(
            f"{path}: format {str(metadata.get('format'))[:20]} is not {FORMAT}; use the version that wrote it"
        )
    return tensors, metadata


def strip(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors under ``prefix``, without it."""
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}


def to_device(tensors: Mapping[str, Tensor], device: torch.device | str) -> dict[str, Tensor]:
    return {name: value.to(device) for name, value in tensors.items()}
