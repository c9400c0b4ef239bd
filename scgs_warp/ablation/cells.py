"""The cells of an ablation: one training run for each value, scene and seed, alike in everything else.

A cell is plain data, and :func:`run_cell` needs nothing else, so that it can run in this process, in a child process or
on another machine that sees the same files.
"""

from __future__ import annotations

import copy
import json
import re
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from ..config.presets import FREE_TO_CHANGE, TrainConfig, from_dict, read_config, to_dict, with_field
from ..config.recorded import with_newer_fields
from ..config.validation import check
from ..errors import UserError, printable
from ..evaluation.coverage import coverage_line
from ..storage.checkpoint import FILE as CHECKPOINT
from ..storage.checkpoint import PREVIOUS
from ..storage.files import read_text
from ..storage.json_files import as_number, parse_json

if TYPE_CHECKING:
    from ..data.dataset import Dataset

AblationName = Literal["nodes", "motion", "arap", "zoo"]
ABLATIONS: tuple[str, ...] = get_args(AblationName)
VALUES = {
    "nodes": ("64", "128", "256", "512", "1024", "2048", "4096"),
    "motion": ("static", "hexplane", "per-gaussian", "control-points"),
    "arap": ("on", "off", "per-gaussian"),
    "zoo": ("zoo",),
}
"""Rows of each table; ``nodes`` also takes other numbers, and the rows of ``zoo`` are its scenes."""
VARIED = {
    "nodes": ("motion.nodes", "motion.model"),
    "motion": ("motion.model",),
    "arap": ("motion.model", "loss.arap", "pretrain.arap_weight"),
    "zoo": ("data.downscale",),
}
"""Fields in which the cells of an ablation may differ."""
NUMBERS = ("control_points", "gaussians", "psnr", "psnr_median", "psnr_worst", "psnr_worst_time", "ssim", "lpips",
           "epe", "jitter", "missing", "rods_within", "seconds")  # fmt: skip
"""Metrics of ``metrics.json`` that tables show."""
NUMBER_LIMIT = 1e12
"""Magnitude at and above which a metric counts as damaged."""
ERROR = "error.txt"
"""File in a cell's folder with the reason why the cell failed."""
LOG = "train.log"
"""File in a cell's folder with the output of training, if training ran in a process of its own."""


@dataclass(frozen=True)
class Cell:
    """One training run, as values that can be pickled and written as JSON."""

    ablation: str
    scene: str
    value: str
    seed: int
    folder: str
    """Run folder."""
    settings: dict[str, Any]
    """Complete configuration, as in ``config.json``, with the data folder."""
    device: str = "cpu"
    lpips_weights: str | None = None

    @property
    def name(self) -> str:
        return f"{self.scene}/{cell_folder(self.value, self.seed)}"


def cell_to_json(cell: Cell) -> str:
    """Write a cell as JSON, for another process."""
    return json.dumps(asdict(cell))


def cell_from_json(text: str) -> Cell:
    """Read the JSON of :func:`cell_to_json`."""
    return Cell(**parse_json(text))


def cell_folder(value: str, seed: int) -> str:
    """Name a cell's folder: ``VALUE`` for seed 0, otherwise ``VALUE-seedN``."""
    return f"{value}-seed{seed}" if seed else value


def parse_values(ablation: str, texts: Sequence[str]) -> tuple[str, ...]:
    """Parse the requested rows; sort them as the table does, without duplicates.

    Raises:
        UserError: the ablation does not know a value.
    """
    values = []
    for text in texts:
        known = re.fullmatch(r"[1-9]\d{0,6}", text) if ablation == "nodes" else text in VALUES[ablation]
        if not known:
            choice = "numbers of control points" if ablation == "nodes" else f"some of {', '.join(VALUES[ablation])}"
            raise UserError(f"--values {text!r}: {ablation} takes {choice}, with commas between")
        values.append(text)
    return sort_values(ablation, values)


def sort_values(ablation: str, values: Sequence[str]) -> tuple[str, ...]:
    """Sort values as the rows of the table, without duplicates."""
    key = int if ablation == "nodes" else VALUES[ablation].index
    return tuple(sorted(set(values), key=key))


def fields_of_row(ablation: str, value: str) -> dict[str, Any]:
    """Return the fields that define a row, by their dotted names."""
    if ablation == "zoo":
        return {}
    if ablation == "nodes":
        return {"motion.model": "control-points", "motion.nodes": int(value)}
    if ablation == "motion" or value == "per-gaussian":
        return {"motion.model": value}
    off = {"loss.arap": 0.0, "pretrain.arap_weight": 0.0} if value == "off" else {}
    return {"motion.model": "control-points", **off}


def settings_of_cell(config: TrainConfig, ablation: str, value: str, seed: int) -> TrainConfig:
    """Set a row's fields and the seed in ``config``.

    Raises:
        UserError: the row cannot be trained with these settings.
    """
    for name, changed in {**fields_of_row(ablation, value), "seed": seed}.items():
        config = with_field(config, name, changed, f"{ablation} {value}")
    if ablation == "arap" and value == "on" and config.loss.arap <= 0.0 and config.pretrain.arap_weight <= 0.0:
        raise UserError(
            "loss.arap and pretrain.arap_weight are 0: arap 'on' would be 'off'; leave one of them positive"
        )
    return check(config)


def flatten(settings: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted names and values."""
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def recorded_settings(folder: Path) -> dict[str, Any] | None:
    """Read the complete settings from ``config.json`` in ``folder``; None without that file.

    Raises:
        UserError: the file is not a configuration, or another version wrote it without a field of this one: the field's
            default may differ from what that version did.
    """
    path = folder / "config.json"
    if not path.is_file():
        return None
    values = read_config(path)
    data = values.get("data")
    data_folder = data.pop("folder", None) if isinstance(data, dict) else None
    settings = to_dict(from_dict(values, str(path)))
    recorded = dict(flatten(with_newer_fields(values)))
    for name, _ in flatten(settings):
        if name not in recorded and name not in FREE_TO_CHANGE:
            raise UserError(
                f"{folder}: made by another version, which had no {name}; remove the folder, and the cell is trained "
                "again, or give another --output"
            )
    settings["data"]["folder"] = data_folder
    return settings


def first_difference(
    actual: dict[str, Any], wanted: dict[str, Any], ignored: Sequence[str] = FREE_TO_CHANGE
) -> tuple[str, Any, Any] | None:
    """Return the first field in which two complete settings differ, as its name and both values; None if they agree."""
    fields = dict(flatten(actual))
    for name, value in flatten(wanted):
        if name not in ignored and fields.get(name) != value:
            return name, fields.get(name), value
    return None


def check_cell(cell: Cell) -> None:
    """Check that the results in the cell's folder were made with the cell's settings.

    Raises:
        UserError: the results were made with other settings, or without a recorded configuration; names the folder and
            the field.
    """
    folder = Path(cell.folder)
    if not any((folder / name).is_file() for name in ("metrics.json", CHECKPOINT, PREVIOUS)):
        return  # There is nothing that could be lost.
    settings = recorded_settings(folder)
    if settings is None:
        raise UserError(f"{folder}: config.json is missing beside the results; restore it or remove the folder")
    differs = first_difference(settings, cell.settings)
    if differs is not None:
        name, actual, wanted = differs
        raise UserError(
            f"{folder}: made with {name} = {actual!r}, now {wanted!r}; give the same options, or another --output"
        )


def read_metrics(folder: Path) -> dict[str, Any] | None:
    """Read a cell's ``metrics.json``; return None if the file is missing.

    Raises:
        UserError: the file is damaged.
    """
    path = folder / "metrics.json"
    try:
        values = parse_json(read_text(path))
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        values = None
    if (
        not isinstance(values, dict)
        or not all(_is_sound(values.get(name)) for name in NUMBERS)
        or not isinstance(values.get("device", ""), (str, type(None)))
        or not _is_presentable(values)
    ):
        raise UserError(f"{path}: damaged; remove it, and the cell is measured again")
    return values


def _is_sound(value: Any) -> bool:
    """Tell whether a table can show ``value``: a finite number, or None."""
    number = as_number(value)
    return value is None or (number is not None and abs(number) < NUMBER_LIMIT)


def _is_presentable(values: dict[str, Any]) -> bool:
    """Tell whether a table can say where the subject is not covered, and whether all numbers are finite."""
    try:
        coverage_line(values)
        json.dumps(values, allow_nan=False)
    except (KeyError, TypeError, ValueError, OverflowError):
        return False
    return True


def is_done(cell: Cell) -> bool:
    """Tell whether a cell is trained and measured."""
    metrics = read_metrics(Path(cell.folder))
    return metrics is not None and (cell.lpips_weights is None or metrics.get("lpips") is not None)


def run_cell(cell: Cell) -> Path:
    """Train and measure a cell, or complete what is left to do.

    Returns:
        Path of its ``metrics.json``.

    Raises:
        UserError: the cell cannot be trained.
        KeyboardInterrupt: training was stopped; its checkpoint is saved.
    """
    from ..training.run import train_and_evaluate

    folder = Path(cell.folder)
    check_cell(cell)
    if not is_done(cell):
        lpips = None
        if cell.lpips_weights is not None:
            from ..evaluation.image_metrics import LPIPS

            lpips = LPIPS(Path(cell.lpips_weights), cell.device)
        if read_metrics(folder) is not None:
            _measure_again(cell, lpips)
        else:
            settings = copy.deepcopy(cell.settings)
            data = Path(settings["data"].pop("folder"))
            config = from_dict(settings, cell.name)
            resume = any((folder / name).is_file() for name in (CHECKPOINT, PREVIOUS))
            options = {"device": cell.device, "resume": resume, "frames": 0, "lpips": lpips}
            train_and_evaluate(config, data, folder, before_training=partial(_remark, cell, config), **options)
    return folder / "metrics.json"


def _remark(cell: Cell, config: TrainConfig, data: Dataset) -> None:
    """Print a line if a setting has no effect on the cell's data."""
    from ..runtime.progress import say
    from ..training.dataset_advice import progressive_without_effect

    line = progressive_without_effect(config, len(data), 0 if data.points is None else len(data.points))
    if line is not None:
        say(f"{cell.name}: {line}")


def _measure_again(cell: Cell, lpips: Any) -> None:
    """Evaluate a trained cell again, with LPIPS, and keep the time of training."""
    from ..data import load
    from ..evaluation.evaluate import metrics_of, write_metrics
    from ..runtime.progress import progress
    from ..scene.scene import Scene

    folder = Path(cell.folder)
    seconds = (read_metrics(folder) or {}).get("seconds")
    scene = Scene.load(folder, device=cell.device)
    test = load(split="test", **cell.settings["data"])
    with progress(len(test), "evaluating") as bar:
        metrics = metrics_of(scene, test, seconds=seconds, lpips=lpips, progress=lambda done, total: bar.advance())
    write_metrics(metrics, folder / "metrics.json")


def attempt(cell: Cell, run: Callable[[Cell], Path] = run_cell) -> str | None:
    """Run a cell; write the reason of a failure to its folder.

    Returns:
        The reason in one line, or None after success.
    """
    folder = Path(cell.folder)
    file = folder / ERROR
    file.unlink(missing_ok=True)
    try:
        run(cell)
    except UserError as error:
        message, detail = " ".join(str(error).split()), ""
    except Exception as error:  # One cell must not end a queue of hours.
        reason = (str(error) or "no reason given").splitlines()[0]
        message, detail = printable(f"{type(error).__name__}: {reason}"), traceback.format_exc()
    else:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{message}\n{detail}", encoding="utf-8")
    except OSError:
        pass  # The caller shows the line anyway.
    return message


def discover(output: Path, ablation: str) -> list[tuple[str, str, int]]:
    """List (scene, value, seed) of all cells of the ablation that have a configuration in ``output``."""
    begun = []
    for config in sorted(output.glob("*/*/config.json")):
        match = re.fullmatch(r"(.+?)(?:-seed([1-9]\d*))?", config.parent.name)
        assert match is not None
        value, seed = match[1], int(match[2] or 0)
        if value in VALUES[ablation] or (ablation == "nodes" and re.fullmatch(r"[1-9]\d{0,6}", value)):
            begun.append((config.parent.parent.name, value, seed))
    return begun


def plan(
    ablation: AblationName,
    config: TrainConfig,
    scenes: dict[str, Path],
    output: Path,
    *,
    values: Sequence[str] = (),
    seeds: Sequence[int] = (),
    device: str = "cpu",
    lpips_weights: Path | None = None,
) -> list[Cell]:
    """Plan all cells, seed by seed and scene by scene.

    Args:
        config: Settings that the cells share.
        scenes: Data folders by the scenes' names in the table.
        values: Rows; by default all, except the per-Gaussian baseline of ``arap`` for scenes without known motion.
        seeds: Seeds; by default the configuration's seed alone.

    Raises:
        UserError: a cell cannot be trained, or its folder holds results with other settings.
    """
    from ..evaluation.motion_metrics import FILE as GROUND_TRUTH
    from ..training.run import settings_of

    cells = []
    for seed in seeds or (config.seed,):
        for scene, data in scenes.items():
            known = (data / GROUND_TRUTH).is_file()
            usual = [value for value in VALUES[ablation] if known or ablation != "arap" or value != "per-gaussian"]
            for value in values or usual:
                settings = settings_of(settings_of_cell(config, ablation, value, seed), data)
                folder = output.absolute() / scene / cell_folder(value, seed)
                weights = None if lpips_weights is None else str(lpips_weights.absolute())
                cell = Cell(ablation, scene, value, seed, str(folder), settings, device, weights)
                check_cell(cell)
                cells.append(cell)
    return cells


def parse_seeds(texts: Sequence[str]) -> tuple[int, ...]:
    """Parse seeds, without duplicates.

    Raises:
        UserError: one is not a whole number of at least 0.
    """
    for text in texts:
        if not re.fullmatch(r"\d{1,9}", text):
            raise UserError(f"--seeds {text!r}: give whole numbers from 0, with commas between")
    return tuple(dict.fromkeys(int(text) for text in texts))
