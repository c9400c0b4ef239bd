"""A run's curves for TensorBoard (extra ``tensorboard``): event files with the entries of ``log.jsonl``, beside it."""

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
"""Fields of a log entry and the names of their curves."""
LONGEST_SIDE = 1024
"""Largest side of a picture in pixels: TensorBoard holds all pictures in memory."""


def check_installed() -> None:
    """Refuse ``--tensorboard`` if its package is missing, before anything is computed.

    Raises:
        UserError: the package is missing.
    """
    if importlib.util.find_spec("tensorboard") is None:
        raise UserError('--tensorboard: needs the package tensorboard: pip install "scgs-warp[tensorboard]"')


class TensorBoard:
    """Event files of one run folder.

    A resumed run writes a new file, which withdraws the earlier file's values for the steps to be repeated. Log entries
    missing from the files (because the run was killed, or partly ran without TensorBoard) are added.

    Args:
        folder: the run folder.
        entries: the entries of ``log.jsonl`` up to ``step``.
        step: number of steps done.
        seconds: seconds of training so far.

    Raises:
        OSError: (all methods) the files cannot be written; the object must not be used any further.
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
        """Write a log entry to disk immediately, so that a killed run loses no more here than in the log."""
        self._write(entry, time.time(), {})
        self._writer.flush()

    def _write(self, entry: dict[str, Any], moment: float, known: dict[str, int]) -> None:
        step = int(entry.get("step", 0))
        for field, tag in TAGS.items():
            value = entry.get(field)
            if value is not None and step > known.get(tag, -1):
                self._writer.add_scalar(tag, float(value), step, walltime=moment)

    def show(self, name: str, truth: Tensor, render: Tensor, step: int) -> None:
        """Write a picture of the truth beside the render.

        Args:
            name: name of the series of pictures, one per step.
            truth, render: [3, H, W] in [0, 1].
            step: number of steps done.
        """
        pair = torch.cat([truth.detach(), render.detach().to(truth.device)], dim=2).clamp(0.0, 1.0)
        shrink = math.ceil(max(pair.shape[1:]) / LONGEST_SIDE)
        if 1 < shrink <= min(pair.shape[1:]):
            pair = torch.nn.functional.avg_pool2d(pair, shrink)
        self._writer.add_image(name, pair.cpu(), step)

    def close(self) -> None:
        threading.excepthook = self._loud
        self._writer.close()

    def _thread_ended(self, ended: threading.ExceptHookArgs) -> None:
        """Silence the package's writer thread, which prints a traceback of an error that the next call also raises."""
        if not issubclass(ended.exc_type, OSError) or not type(ended.thread).__module__.startswith("tensorboard."):
            self._loud(ended)


def newest_steps(folder: Path, step: int) -> dict[str, int]:
    """Find the last step, at most ``step``, of each curve in the event files of a folder."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    if not any(folder.glob("events.out.tfevents.*")):
        return {}
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 1})
    events.Reload()
    return {
        tag: max((event.step for event in events.Scalars(tag) if event.step <= step), default=-1)
        for tag in events.Tags()["scalars"]
    }
