"""Ablations: one training run for each value, scene and seed, alike in everything else.

A cell is plain data, and :func:`run_cell` needs nothing but one: it can run here, in a child process or on another
machine that sees the same files.
"""

from __future__ import annotations

import copy
import json
import re
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from ..config.presets import FREE_TO_CHANGE, TrainConfig, from_dict, read_config, to_dict, with_field
from ..config.validation import check
from ..errors import UserError, printable
from ..storage.checkpoint import FILE as CHECKPOINT
from ..storage.checkpoint import PREVIOUS
from ..storage.json_files import as_number, parse_json

AblationName = Literal["nodes", "motion", "arap"]
ABLATIONS: tuple[str, ...] = get_args(AblationName)
VALUES = {
    "nodes": ("64", "128", "256", "512", "1024", "2048", "4096"),
    "motion": ("static", "hexplane", "per-gaussian", "control-points"),
    "arap": ("on", "off", "per-gaussian"),
}
"""The rows of each table; nodes takes any other numbers, too."""
VARIED = {
    "nodes": ("motion.nodes", "motion.model"),
    "motion": ("motion.model",),
    "arap": ("motion.model", "loss.arap", "pretrain.arap_weight"),
}
"""Fields in which the cells of an ablation may differ."""
NUMBERS, LARGEST = ("control_points", "gaussians", "psnr", "ssim", "lpips", "epe", "jitter", "seconds"), 1e12
"""What of ``metrics.json`` stands in tables, and what no such number reaches."""
ERROR = "error.txt"
"""In a cell's folder: why it failed."""
LOG = "train.log"
"""In a cell's folder: what training printed, where it had a process of its own."""


@dataclass(frozen=True)
class Cell:
    """One training run; nothing in it that cannot be pickled or written as JSON."""

    ablation: str
    scene: str
    value: str
    seed: int
    folder: str
    """Run directory."""
    settings: dict[str, Any]
    """The complete configuration, as ``config.json`` holds it, with the folder of the data."""
    device: str = "cpu"
    lpips_weights: str | None = None

    @property
    def name(self) -> str:
        return f"{self.scene}/{cell_folder(self.value, self.seed)}"


def cell_to_json(cell: Cell) -> str:
    """For a process elsewhere."""
    return json.dumps(asdict(cell))


def cell_from_json(text: str) -> Cell:
    """What :func:`cell_to_json` made."""
    return Cell(**parse_json(text))


def cell_folder(value: str, seed: int) -> str:
    """``VALUE``, or ``VALUE-seedN`` for other seeds than 0."""
    return f"{value}-seed{seed}" if seed else value


def parse_values(ablation: str, texts: Sequence[str]) -> tuple[str, ...]:
    """The rows that were asked for, in the table's order, each once.

    Raises:
        UserError: a value that the ablation does not know.
    """
    found = []
    for text in texts:
        known = re.fullmatch(r"[1-9]\d{0,6}", text) if ablation == "nodes" else text in VALUES[ablation]
        if not known:
            choice = "numbers of control points" if ablation == "nodes" else f"some of {', '.join(VALUES[ablation])}"
            raise UserError(f"--values {text!r}: {ablation} takes {choice}, with commas between")
        found.append(text)
    return sort_values(ablation, found)


def sort_values(ablation: str, values: Sequence[str]) -> tuple[str, ...]:
    """In the order of the table's rows, each once."""
    key = int if ablation == "nodes" else VALUES[ablation].index
    return tuple(sorted(set(values), key=key))


def changes(ablation: str, value: str) -> dict[str, Any]:
    """The fields that make the row, by their dotted names."""
    if ablation == "nodes":
        return {"motion.model": "control-points", "motion.nodes": int(value)}
    if ablation == "motion" or value == "per-gaussian":
        return {"motion.model": value}
    off = {"loss.arap": 0.0, "pretrain.arap_weight": 0.0} if value == "off" else {}
    return {"motion.model": "control-points", **off}


def settings_of_cell(config: TrainConfig, ablation: str, value: str, seed: int) -> TrainConfig:
    """``config`` with the row's fields and the seed.

    Raises:
        UserError: the row cannot run with these settings.
    """
    for name, changed in {**changes(ablation, value), "seed": seed}.items():
        config = with_field(config, name, changed, f"{ablation} {value}")
    if ablation == "arap" and value == "on" and config.loss.arap <= 0.0 and config.pretrain.arap_weight <= 0.0:
        raise UserError(
            "loss.arap and pretrain.arap_weight are 0: arap 'on' would be 'off'; leave one of them positive"
        )
    return check(config)


def flat(settings: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values."""
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def recorded(folder: Path) -> dict[str, Any] | None:
    """The complete settings that ``config.json`` in ``folder`` holds; None without one.

    Raises:
        UserError: the file is not a configuration, or was written by a version that did not have all fields: what that
            version did instead is not known here, and today's default may be another.
    """
    path = folder / "config.json"
    if not path.is_file():
        return None
    values = read_config(path)
    data = values.get("data")
    place = data.pop("folder", None) if isinstance(data, dict) else None
    settings = to_dict(from_dict(values, str(path)))
    there = dict(flat(values))
    for name, _ in flat(settings):
        if name not in there and name not in FREE_TO_CHANGE:
            raise UserError(
                f"{folder}: made by another version, which had no {name}; remove the folder, and the cell is trained "
                "again, or give another --output"
            )
    settings["data"]["folder"] = place
    return settings


def difference(
    found: dict[str, Any], wanted: dict[str, Any], ignored: Sequence[str] = FREE_TO_CHANGE
) -> tuple[str, Any, Any] | None:
    """The first field in which two complete settings differ: its name, and both values."""
    there = dict(flat(found))
    for name, value in flat(wanted):
        if name not in ignored and there.get(name) != value:
            return name, there.get(name), value
    return None


def check_cell(cell: Cell) -> None:
    """What is in the cell's folder was made with the cell's settings.

    Raises:
        UserError: it was not; names cell and field.
    """
    folder = Path(cell.folder)
    if not any((folder / name).is_file() for name in ("metrics.json", CHECKPOINT, PREVIOUS)):
        return  # nothing that could be lost
    settings = recorded(folder)
    if settings is None:
        raise UserError(f"{folder}: config.json is missing beside the results; restore it or remove the folder")
    differs = difference(settings, cell.settings)
    if differs is not None:
        name, found, wanted = differs
        raise UserError(
            f"{folder}: made with {name} = {found!r}, now {wanted!r}; give the same options, or another --output"
        )


def read_metrics(folder: Path) -> dict[str, Any] | None:
    """``metrics.json`` of a cell; None while it is not there.

    Raises:
        UserError: it is damaged.
    """
    path = folder / "metrics.json"
    try:
        values = parse_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        values = None
    if (
        not isinstance(values, dict)
        or not all(_sound(values.get(name)) for name in NUMBERS)
        or not isinstance(values.get("device", ""), (str, type(None)))
    ):
        raise UserError(f"{path}: damaged; remove it, and the cell is measured again")
    return values


def _sound(value: Any) -> bool:
    """A number of a table, or nothing."""
    number = as_number(value)
    return value is None or (number is not None and abs(number) < LARGEST)


def is_done(cell: Cell) -> bool:
    """Whether nothing is left to do."""
    metrics = read_metrics(Path(cell.folder))
    return metrics is not None and (cell.lpips_weights is None or metrics.get("lpips") is not None)


def run_cell(cell: Cell) -> Path:
    """Train and measure a cell, or as much of that as is left to do.

    Returns:
        its ``metrics.json``.

    Raises:
        UserError: the cell cannot be trained; KeyboardInterrupt: stopped, with the checkpoint saved.
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
            train_and_evaluate(config, data, folder, device=cell.device, resume=resume, frames=0, lpips=lpips)
    return folder / "metrics.json"


def _measure_again(cell: Cell, lpips: Any) -> None:
    """With LPIPS this time; the time of training is kept."""
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
    """Run a cell; what goes wrong is kept in its folder, and comes back as one line.

    Returns:
        None if all is well.
    """
    folder = Path(cell.folder)
    file = folder / ERROR
    file.unlink(missing_ok=True)
    try:
        run(cell)
    except UserError as error:
        message, detail = " ".join(str(error).split()), ""
    except Exception as error:  # a queue of hours does not end because of one cell
        reason = (str(error) or "no reason given").splitlines()[0]
        message, detail = printable(f"{type(error).__name__}: {reason}"), traceback.format_exc()
    else:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{message}\n{detail}", encoding="utf-8")
    except OSError:
        pass  # the line is shown all the same
    return message


def discover(output: Path, ablation: str) -> list[tuple[str, str, int]]:
    """(scene, value, seed) of all the ablation's cells in ``output`` that were begun."""
    found = []
    for config in sorted(output.glob("*/*/config.json")):
        match = re.fullmatch(r"(.+?)(?:-seed([1-9]\d*))?", config.parent.name)
        assert match is not None
        value, seed = match[1], int(match[2] or 0)
        if value in VALUES[ablation] or (ablation == "nodes" and re.fullmatch(r"[1-9]\d{0,6}", value)):
            found.append((config.parent.parent.name, value, seed))
    return found


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
    """All cells, seed by seed and scene by scene.

    Args:
        config: what all of them share.
        scenes: data folders by the names that the table gives them.
        values: rows; default: all. The per-Gaussian baseline of ``arap`` is then trained where motion is known.
        seeds: default: the configuration's.

    Raises:
        UserError: a cell cannot run, or its folder holds one with other settings.
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
    """Seeds, each once.

    Raises:
        UserError: not a whole number of at least 0.
    """
    for text in texts:
        if not re.fullmatch(r"\d{1,9}", text):
            raise UserError(f"--seeds {text!r}: give whole numbers from 0, with commas between")
    return tuple(dict.fromkeys(int(text) for text in texts))
