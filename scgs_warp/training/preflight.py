"""Refusals of a run before any image is read."""

from __future__ import annotations

import os
from pathlib import Path

from ..config.presets import TrainConfig, to_dict
from ..config.recorded import with_newer_fields
from ..config.validation import check
from ..data.dataset import Dataset
from ..errors import UserError
from ..motion.chunks import empty_chunk
from ..ops.shapes import shown
from ..storage import checkpoint
from ..storage.locks import AlreadyLocked, lock_file
from .resuming import check_same_configuration, check_steps
from .run_folder import LOCK, SETTINGS, refuse_existing

CHOSEN_BY_THE_DATA = (
    "init_from",
    "motion.hyper_dim",
    "densify.prune_large",
    "densify.least_views",
    "densify.clear_distance",
    "densify.faint_share",
    "loss.pooled",
    "pretrain.arap_by",
    "pretrain.fade",
    "pretrain.steps",
    "optim.network_scale",
)
"""Settings that ``automatic.resolve_auto`` may change, so that they can be compared only when the data is known."""


def refuse_early(config: TrainConfig, output: Path, resume: bool) -> None:
    """Refuse what can be refused without the data: impossible settings, an existing run, a folder that cannot be
    written, and other settings or fewer steps than those of the run that is to continue.

    Raises:
        UserError: names the file or option, and the remedy. A damaged checkpoint is no error here.
    """
    check(config)
    refuse_existing(output, resume)
    refuse_unwritable(output)
    if in_use(output):
        raise UserError(f"{output}: another trainer is running here; wait for it or choose another --output")
    if not resume:
        return
    if not output.is_dir():
        raise UserError(f"{output}: no such run folder; give one that apps/train.py wrote, or no --resume")
    if not (output / checkpoint.FILE).is_file():
        return
    try:
        _, metadata = checkpoint.read(output, ())
    except checkpoint.DamagedCheckpoint:
        return
    source = str(output / checkpoint.FILE)
    saved, step = metadata.get("config"), metadata.get("step")
    if isinstance(saved, dict):
        saved = with_newer_fields(saved, recorded=True)
        try:
            check_same_configuration(saved, to_dict(config), source, besides=CHOSEN_BY_THE_DATA)
        except UserError as error:
            if (output / SETTINGS).is_file():
                raise
            raise UserError(f"{error}; {output / SETTINGS}, which holds them, is missing: restore it") from None
    if isinstance(step, int):
        check_steps(step, config, source)


def refuse_unwritable(output: Path) -> None:
    """Refuse a run folder that cannot be made or written, as far as that is known without making it.

    Raises:
        UserError: names the folder and the remedy.
    """
    checkpoint.check_name(output.absolute())
    if os.path.lexists(output) and not output.is_dir():
        raise UserError(f"{output}: is no folder; choose another --output")
    folders = (output.absolute(), *output.absolute().parents)
    nearest = next((folder for folder in folders if os.path.lexists(folder)), output)
    if not os.path.isdir(nearest) or not os.access(nearest, os.W_OK | os.X_OK):
        raise UserError(f"{output}: cannot be made or written in {nearest}; choose another --output")


def refuse_data(config: TrainConfig, data: Dataset) -> None:
    """Refuse frames on which a configuration cannot be trained. In a chunk of time without a training frame, nothing
    would train the network.

    Raises:
        UserError: names the data set and the remedy.
    """
    if not isinstance(data, Dataset):
        raise UserError(f"data is {shown(data)}; give a data set, such as scgs_warp.data.load returns")
    if data.background != config.data.background:
        raise UserError(f"{data.folder}: loaded on {data.background}, but data.background is {config.data.background}")
    if len(data) == 0:
        raise UserError(f"{data.folder}: the {data.split} split has no frames; nothing to train on")
    chunks = config.motion.chunks
    empty = empty_chunk(data.times.tolist(), chunks)
    if empty is not None:
        span = f"{empty / chunks:.3g} to {(empty + 1) / chunks:.3g}"
        raise UserError(f"motion.chunks is {chunks}; no training frame lies at times {span}: give fewer chunks")


def in_use(folder: Path) -> bool:
    """Return whether a trainer holds the lock of a run folder."""
    if not (folder / LOCK).is_file():
        return False
    try:
        os.close(lock_file(folder / LOCK))  # gives the lock back
    except AlreadyLocked:
        return True
    except OSError:
        return False
    return False
