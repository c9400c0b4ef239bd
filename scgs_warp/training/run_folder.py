"""A run folder: config.json, log.jsonl, previews/, and a lock that admits only one trainer."""

from __future__ import annotations

import json
import math
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import torch

from ..config.presets import TrainConfig, to_dict
from ..data.dataset import Dataset
from ..errors import UserError, one_line
from ..evaluation.image_metrics import psnr
from ..evaluation.run_time import log_entries
from ..runtime.progress import Progress, say
from ..scene.scene import Scene
from ..storage import checkpoint
from ..storage.checkpoint import FILE, PREVIOUS
from ..storage.files import read_text, write_atomically
from ..storage.json_files import parse_json
from ..storage.locks import AlreadyLocked, lock_file
from .state import StepResult, TrainState
from .tensorboard import TensorBoard, check_installed
from .time_estimate import TimeEstimate

LOG_EVERY = 50
"""Number of steps between two log lines."""
PREVIEW_SECONDS = 15.0
LOCK = ".lock"
PREVIEWS = "previews"
SETTINGS, LOG = "config.json", "log.jsonl"
RESULTS = ("metrics.json", "contact_sheet.png", "curves.png", "turntable.mp4", "evaluation")
"""What training writes after its last step."""
PARTIAL = re.compile(
    r"\.(config\.json|log\.jsonl|contact_sheet\.png|curves\.png|turntable\.mp4|checkpoint.*)(\..*)?\.tmp"
)
"""Names of files that a killed trainer leaves behind half written."""
BEFORE_SETTINGS = {PREVIEWS, LOCK}
"""What a run folder holds before ``config.json``."""
TEST_IMAGES = 4
"""Approximate number of held-out images on which the curve is measured."""
BOARD_IMAGES = 20
"""Number of training pictures per run in TensorBoard."""


def refuse_existing(path: Path, resume: bool) -> None:
    """Refuse to overwrite a run, its results, or files of the same names that are no run's. What a run that was killed
    before its first checkpoint left may be overwritten.

    Raises:
        UserError: ``path`` holds such files, and ``resume`` is False.
    """
    if resume:
        return
    if any(os.path.lexists(path / name) for name in (FILE, PREVIOUS)):
        raise UserError(f"{path}: holds a run already; continue it with --resume or choose another --output")
    begun = RESULTS if _has_settings(path / SETTINGS) else (SETTINGS, LOG, *RESULTS)
    for name in begun:
        if (path / name).exists():
            raise UserError(f"{path}: holds {name}, which training would overwrite; choose another --output")


def _has_settings(path: Path) -> bool:
    """Return whether a file holds the settings of a run."""
    try:
        values = parse_json(read_text(path))
    except (OSError, ValueError, UserError):
        return False
    return isinstance(values, dict) and {"preset", "steps", "pretrain", "motion"} <= values.keys()


class RunFolder:
    """Run folder of a trainer: a context manager that holds a lock, so that two trainers cannot share it.

    With ``tensorboard``, the log's entries and occasional pictures are also written to event files. Log, previews,
    event files and the scores of held-out frames are optional: if writing one of them fails, training warns once and
    continues.

    Raises:
        UserError: the directory is not writable, in use, or holds a run while ``resume`` is False; ``tensorboard`` is
            requested but its package is not installed.
    """

    def __init__(
        self,
        path: str | Path,
        config: TrainConfig,
        settings: dict[str, Any] | None,
        *,
        resume: bool,
        tensorboard: bool = False,
    ) -> None:
        if tensorboard:
            check_installed()
        self.tensorboard = tensorboard
        self._board: TensorBoard | None = None
        self.path, self._steps = Path(path), config.steps
        self._between = max(1, config.steps // BOARD_IMAGES)
        self.settings = settings if settings is not None else to_dict(config)
        self.resume = resume
        self.seconds = 0.0
        self._began = time.perf_counter()
        self._shown_at = 0.0
        self._psnr: float | None = None
        self._regulariser = 0.0
        """Last weighted regulariser since the previous log line; steps without the term do not count, because only one
        step in a few includes ARAP."""
        self._told: set[str] = set()
        self._estimate = TimeEstimate(config)
        self._torn = False
        """True if the log may end in the middle of a line."""
        self.tell: Callable[[str], None] = say
        """Callback that prints a line that is not an error."""

    def __enter__(self) -> RunFolder:
        if self.resume and not self.path.is_dir():
            raise UserError(f"{self.path}: no such run folder; give one that apps/train.py wrote, or no --resume")
        try:
            (self.path / PREVIEWS).mkdir(parents=True, exist_ok=True)
            self._lock()
        except OSError as error:
            where = error.filename or self.path
            raise UserError(f"{where}: cannot be written ({error.strerror}); choose another --output") from error
        try:
            refuse_existing(self.path, self.resume)
            if not self.resume:
                self._write_settings()
        except UserError:
            self.__exit__(None, None, None)
            raise
        self.path = self.path.absolute()  # the program may change its directory
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._optional("the event files for TensorBoard"):
            board, self._board = self._board, None
            if board is not None:
                board.close()
        os.close(self._lock_file)

    @contextmanager
    def _optional(self, what: str) -> Iterator[None]:
        """Turn the failure of an optional output into a single warning."""
        try:
            yield
        except (OSError, UserError) as error:
            if what not in self._told:
                self._told.add(what)
                self.tell(f"warning: {what}: {one_line(error)}; training goes on without")

    def _lock(self) -> None:
        try:
            self._lock_file = lock_file(self.path / LOCK)
        except AlreadyLocked:
            raise UserError(
                f"{self.path}: another trainer is running here; wait for it or choose another --output"
            ) from None

    @property
    def has_no_checkpoint(self) -> bool:
        """True if a run has begun but has not written a checkpoint.

        A trainer that ends before its configuration is written, as on a full disk, leaves only what it makes first.
        """
        if any(os.path.lexists(self.path / name) for name in (FILE, PREVIOUS)):
            return False
        if _has_settings(self.path / SETTINGS):
            return True
        return all(entry.name in BEFORE_SETTINGS or entry.match(".*.tmp") for entry in self.path.iterdir())

    def start(self, step: int) -> None:
        """Write the configuration; drop the log lines after ``step``, which a resumed run writes again; remove partial
        files left by a killed process."""
        for left in self.path.glob(".*.tmp"):
            if PARTIAL.fullmatch(left.name):
                with suppress(OSError):
                    left.unlink()
        self._write_settings()
        entries: list[dict[str, Any]] = []
        for entry in log_entries(self.path) if self.resume else []:
            with suppress(ValueError, TypeError):  # skip a damaged line
                if int(entry.get("step", 0)) <= step:
                    self.seconds = max(self.seconds, float(entry.get("seconds", 0.0)))
                    entries.append(entry)
        write_atomically(self.path / LOG, "".join(json.dumps(entry) + "\n" for entry in entries).encode())
        if self.tensorboard:
            with self._optional("the event files for TensorBoard"):
                self._board = TensorBoard(self.path, entries, step, self.seconds)
        self._began = time.perf_counter()

    def _write_settings(self) -> None:
        text = json.dumps(self.settings, indent=2, sort_keys=True)
        write_atomically(self.path / SETTINGS, text.encode())

    @property
    def elapsed(self) -> float:
        """Total seconds of training, including those before a resume."""
        return self.seconds + time.perf_counter() - self._began

    def log(self, entry: dict[str, Any]) -> None:
        """Append an entry to ``log.jsonl`` and to the event files."""
        line = json.dumps({**entry, "seconds": round(self.elapsed, 2)}) + "\n"
        with self._optional("log lines"):
            torn, self._torn = self._torn, True
            with open(self.path / LOG, "a", encoding="utf-8") as file:
                file.write("\n" + line if torn else line)
            self._torn = False
        self._on_board(lambda board: board.record(entry))

    def _on_board(self, action: Callable[[TensorBoard], None]) -> None:
        """Write to the event files, if TensorBoard is in use."""
        board, self._board = self._board, None  # a board that failed once would fail again or block forever
        if board is not None:
            with self._optional("the event files for TensorBoard"):
                action(board)
                self._board = board

    def _show(self, name: str, truth: torch.Tensor, render: torch.Tensor, step: int) -> None:
        self._on_board(lambda board: board.show(name, truth, render, step))

    def shows(self, done: int) -> bool:
        """Return True if :meth:`record` writes the losses or the picture of the step that completes ``done`` steps."""
        pictured = self._board is not None and done % self._between == 0
        return done % LOG_EVERY == 0 or done == self._steps or pictured

    def record(self, state: TrainState, result: StepResult, bar: Progress) -> None:
        """Advance the progress bar, add a log line every 50 steps, and write a preview every 15 seconds.

        Args:
            result: of any step. Its picture is read only if :meth:`shows` or if no step has followed.
        """
        done = result.step + 1
        due = done % LOG_EVERY == 0 or done == self._steps
        # A run that resumes after the last such step before a row logs 0.0 in that row.
        if result.failed is None and result.regulariser:
            self._regulariser = result.regulariser
        if due and result.failed is None:
            valid = slice(None) if result.mask is None else result.mask  # as in the loss and the test score
            now = float(psnr(result.render[:, valid], result.truth[:, valid]))
            if math.isfinite(now):  # the PSNR of equal images is infinite
                self._psnr = now if self._psnr is None else 0.9 * self._psnr + 0.1 * now
            self.log(
                {
                    "step": done,
                    "stage": state.stage,
                    "loss": float(result.loss),
                    "l1": float(result.l1),
                    "ssim": float(result.ssim),
                    "regulariser": self._regulariser,
                    "psnr": None if self._psnr is None else round(self._psnr, 3),
                    "gaussians": len(state.gaussians),
                    "control_points": len(getattr(state.motion, "positions", ())),
                }
            )
            self._regulariser = 0.0
        if due or result.failed:
            bar.advance(1, stage=state.stage, psnr=self._psnr, gaussians=len(state.gaussians))
        else:
            bar.advance(1)
        left = self._estimate.note(done, state.steps_again)
        if left is not None:
            self.tell(left)
        if done % self._between == 0 and result.failed is None:
            self._show("train", result.truth, result.render, done)
        if done == state.step and time.monotonic() - self._shown_at >= PREVIEW_SECONDS:
            self._shown_at = time.monotonic()
            with self._optional("previews"):
                self.show(result)

    def show(self, result: StepResult) -> None:
        """Write ``previews/latest.png``: the truth beside the render."""
        import cv2

        pair = torch.cat([result.truth, result.render], dim=2).clamp(0.0, 1.0)
        pixels = (pair.permute(1, 2, 0).cpu() * 255.0 + 0.5).to(torch.uint8).numpy()[:, :, ::-1]
        done, content = cv2.imencode(".png", pixels)
        if done:
            write_atomically(self.path / PREVIEWS / "latest.png", content.tobytes())

    def log_test_psnr(self, scene: Scene, test: Dataset, step: int) -> None:
        """Log the PSNR of a few test images after ``step`` steps."""
        scene.motion.eval()
        with self._optional("scores of held-out frames"):
            self._test_psnr(scene, test, step)
        scene.motion.train()

    def _test_psnr(self, scene: Scene, test: Dataset, step: int) -> None:
        wanted = range(0, len(test), max(1, len(test) // TEST_IMAGES))
        values = []
        for i in wanted:
            frame = test[i]
            image = scene.render(frame.camera, frame.time).rgb.cpu()
            valid = slice(None) if frame.mask is None else frame.mask
            values.append(float(psnr(image[valid], frame.image[valid])))
            if i == 0:
                self._show("held_out", frame.image.permute(2, 0, 1), image.permute(2, 0, 1), step)
        values = [value for value in values if math.isfinite(value)]
        if values:
            self.log({"step": step, "test_psnr": sum(values) / len(values)})


class ReadOnlyRunFolder(RunFolder):
    """Run folder in processes other than the first: writes nothing."""

    def __enter__(self) -> ReadOnlyRunFolder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def start(self, step: int) -> None:
        pass

    def log(self, entry: dict[str, Any]) -> None:
        pass

    def record(self, state: TrainState, result: StepResult, bar: Progress) -> None:
        pass

    def log_test_psnr(self, scene: Scene, test: Dataset, step: int) -> None:
        pass


def begin_or_resume(folder: RunFolder, config: TrainConfig, data: Dataset, device: str) -> TrainState:
    """Return the state with which training goes on: that of the newest readable checkpoint, or the first one.

    Raises:
        UserError: the checkpoint does not fit the configuration or the data.
    """
    if folder.resume and folder.has_no_checkpoint:
        folder.tell(f"{folder.path}: there is no checkpoint yet; training begins again from step 0")
    elif folder.resume:
        try:
            return TrainState.resume(folder.path, config, data, device)
        except checkpoint.DamagedCheckpoint as error:
            if isinstance(folder, ReadOnlyRunFolder):
                raise UserError(f"{error}; the first process could read it") from error
            folder.tell(f"warning: {checkpoint.fall_back(folder.path, error)}")
        return TrainState.resume(folder.path, config, data, device)
    return TrainState.begin(config, data, device)


def end_here(state: TrainState, folder: RunFolder) -> None:
    """Save a run whose last step is now the one that it has reached, unless its checkpoint says so already."""
    _, metadata = checkpoint.read(folder.path, ())
    if metadata["config"]["steps"] != state.config.steps:
        state.save(folder.path)
