"""Text files of strangers: pipes and devices are refused, and text is no number."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from fuzz.files_runs import write_model
from helpers.nerfstudio_files import write as write_nerfstudio
from scgs_warp.ablation.cells import read_metrics
from scgs_warp.ablation.zoo import read_table
from scgs_warp.apps import train
from scgs_warp.data import load
from scgs_warp.data.readers.transforms import read_transforms
from scgs_warp.edit.field_reader import read_object
from scgs_warp.errors import UserError
from scgs_warp.scene.scene import Scene
from scgs_warp.visualization.figures import read_log

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")


def refusal(action: Callable[[], object], *words: str) -> None:
    with pytest.raises(UserError) as caught:
        action()
    text = str(caught.value)
    assert text.isprintable() and all(word in text for word in words), text


JSON_READERS: dict[str, Any] = {
    "config.json": (lambda path: train.cli(["--config", str(path), "--output", str(path.parent / "out")]), "--config"),
    "edit.json": (read_object, "--script"),
    "transforms.json": (read_transforms, "a data set"),
    "zoo.json": (lambda path: read_table(path.parent), "--compare"),
    "metrics.json": (lambda path: read_metrics(path.parent), "a cell"),
    "log.jsonl": (read_log, "curves"),
}


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize("name", JSON_READERS)
def test_text_that_is_no_file_is_refused(tmp_path, capsys, name, kind):
    """A pipe without a writer would be waited for, and reading ``/dev/zero`` would exhaust the memory."""
    folder = tmp_path / "folder"
    folder.mkdir()
    path = folder / name
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    answers: list[Any] = []

    def read() -> None:
        try:
            answers.append(JSON_READERS[name][0](path))
        except UserError as error:
            answers.append(error)

    worker = threading.Thread(target=read, daemon=True)
    worker.start()
    worker.join(30)
    assert len(answers) == 1 and (isinstance(answers[0], UserError) or answers == [2]), answers
    said = str(answers[0]) if answers != [2] else capsys.readouterr().err.strip()
    assert name in said and "\n" not in said, said


def test_a_scene_with_settings_that_are_no_file_is_refused(tmp_path):
    write_model("static", tmp_path / "run")
    (tmp_path / "run/config.json").unlink(missing_ok=True)
    (tmp_path / "run/config.json").symlink_to("/dev/zero")
    refusal(lambda: Scene.load(tmp_path / "run"), "config.json", "not a regular file")


def test_settings_that_an_editor_of_windows_saved_are_read(tmp_path):
    write_model("static", tmp_path / "run")
    plain = Scene.load(tmp_path / "run").settings
    settings = tmp_path / "run/config.json"
    settings.write_text("\ufeff" + json.dumps({"seed": 7}), encoding="utf-8")
    assert Scene.load(tmp_path / "run").settings == {"seed": 7} != plain


NUMBERS_OF_TEXT = {
    "transform_matrix": ("frames", 0, "transform_matrix", 0, 0),
    "applied_transform": ("applied_transform",),
    "applied_scale": ("applied_scale",),
    "time": ("frames", 0, "time"),
    "fl_x": ("fl_x",),
}


@pytest.mark.parametrize("value", ["1", True])
@pytest.mark.parametrize("field", NUMBERS_OF_TEXT)
def test_text_and_booleans_are_no_numbers(tmp_path, field, value):
    """NumPy and Python would convert them: a data set that others wrote would train with poses nobody meant."""
    content = write_nerfstudio(tmp_path / "scene")
    if field.startswith("applied"):
        content |= {"applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 1.0}
    (tmp_path / "scene/transforms.json").write_text(json.dumps(content))
    load(tmp_path / "scene")
    inner: Any = content
    *outer, last = NUMBERS_OF_TEXT[field]
    for key in outer:
        inner = inner[key]
    inner[last] = [[value] * 4] * 3 if field == "applied_transform" else value
    (tmp_path / "scene/transforms.json").write_text(json.dumps(content))
    refusal(lambda: load(tmp_path / "scene"), "transforms.json", field)
