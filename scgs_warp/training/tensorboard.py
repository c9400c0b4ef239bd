"""A run's curves for TensorBoard (extra ``tensorboard``): event files beside ``log.jsonl``, of the same entries."""

from __future__ import annotations

import importlib.util
import math
import threading
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..errors import UserError

TAGS = {
    "loss": "loss/total",
    "l1": "loss/l1",
    "ssim": "loss/ssim",
    "regulariser": "loss/regulariser",
    "psnr": "psnr/train",
    "test_psnr": "psnr/held_out",
    "gaussians": "size/gaussians",
    "control_points": "size/control_points",
}
"""Fields of a log entry, and the curves they make."""
LONGEST = 1024
"""Pixels of a picture's longer side, at most: TensorBoard holds them all in memory."""


def check_installed() -> None:
    """Before anything is computed.

    Raises:
        UserError: the package is missing.
    """
    if importlib.util.find_spec("tensorboard") is None:
        raise UserError('--tensorboard: needs the package tensorboard: pip install "scgs-warp[tensorboard]"')


class TensorBoard:
    """The event files of one run directory.

    A run that is resumed goes on in a file of its own, which takes back what an earlier one says of steps that will be
    done again. What the log has and the files lack (a kill before it was written, a part of the run without
    TensorBoard) is written again.

    Args:
        folder: the run directory.
        entries: those of ``log.jsonl`` up to ``step``.
        step: the step the run stands at.
        seconds: of training so far.

    Raises:
        OSError: of each method: the files cannot be written. Such a board is of no further use.
    """

    def __init__(self, folder: Path, entries: list[dict[str, Any]], step: int, seconds: float) -> None:
        from torch.utils.tensorboard import SummaryWriter

        known = newest_steps(folder, step)
        self._loud = threading.excepthook
        threading.excepthook = self._thread_ended
        self._writer = SummaryWriter(str(folder), purge_step=step + 1)
        began = time.time() - seconds
        for entry in entries:
            self._write(entry, began + float(entry.get("seconds", seconds)), known)
        self._writer.flush()

    def record(self, entry: dict[str, Any]) -> None:
        """A log entry, on disk when this returns: a kill loses no more here than in the log."""
        self._write(entry, time.time(), {})
        self._writer.flush()

    def _write(self, entry: dict[str, Any], moment: float, known: dict[str, int]) -> None:
        step = int(entry.get("step", 0))
        for field, tag in TAGS.items():
            value = entry.get(field)
            if value is not None and step > known.get(tag, -1):
                self._writer.add_scalar(tag, float(value), step, walltime=moment)

    def show(self, name: str, truth: Tensor, render: Tensor, step: int) -> None:
        """Truth beside render.

        Args:
            name: of the pictures, one for each step.
            truth, render: [3, H, W] in [0, 1].
            step: steps done.
        """
        pair = torch.cat([truth.detach(), render.detach().to(truth.device)], dim=2).clamp(0.0, 1.0)
        shrink = math.ceil(max(pair.shape[1:]) / LONGEST)
        if 1 < shrink <= min(pair.shape[1:]):
            pair = torch.nn.functional.avg_pool2d(pair, shrink)
        self._writer.add_image(name, pair.cpu(), step)

    def close(self) -> None:
        threading.excepthook = self._loud
        self._writer.close()

    def _thread_ended(self, ended: threading.ExceptHookArgs) -> None:
        """The package's own thread writes the files; it prints a traceback of what it also raises at the next call."""
        if not issubclass(ended.exc_type, OSError) or not type(ended.thread).__module__.startswith("tensorboard."):
            self._loud(ended)


def newest_steps(folder: Path, step: int) -> dict[str, int]:
    """The last step, ``step`` at most, of each curve in the event files of a folder."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    if not any(folder.glob("events.out.tfevents.*")):
        return {}
    found = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 1})
    found.Reload()
    return {
        tag: max((event.step for event in found.Scalars(tag) if event.step <= step), default=-1)
        for tag in found.Tags()["scalars"]
    }
