"""Faults to put into the files of a data set, and the one line that a reader answers with."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from helpers.layouts import HEIGHT, WIDTH, save_image
from scgs_warp.data import load
from scgs_warp.errors import UserError

NAN = float("nan")


def message(folder: Path, split: str = "train") -> str:
    with pytest.raises(UserError) as caught:
        load(folder, split)
    text = str(caught.value)
    assert "\n" not in text and str(folder) in text and "; " in text, text
    return text


def change(path: Path, edit) -> None:
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def put(path: str, *keys, value):
    """A fault: this value at that place of a JSON file; ``...`` removes it."""

    def edit(content) -> None:
        for key in keys[:-1]:
            content = content[key]
        if value is ...:
            del content[keys[-1]]
        else:
            content[keys[-1]] = value

    return lambda folder: change(folder / path, edit)


def text(path: str, content: str):
    return lambda folder: (folder / path).write_text(content)


def gone(path: str):
    """A fault: the file, or the files below the folder, do not exist."""

    def remove(folder: Path) -> None:
        target = folder / path
        for file in [target] if target.is_file() else list(target.rglob("*.*")):
            if file.is_file():
                file.unlink()

    return remove


def noise(path: str):
    return lambda folder: (folder / path).write_bytes(b"\x89PNG\r\n\x1a\n broken")


def small(path: str):
    return lambda folder: save_image(folder / path, np.zeros((HEIGHT - 20, WIDTH - 20, 3), np.uint8))
