"""Films of a built-in subject in a furnished room, with the truth of everything that a capture has to find.

A film is shot by one camera in the hand (``phone``) or by several that stand still (``rig``). The folder holds what the
cameras recorded; ``truth.npz`` with poses, offsets, exposures; and, for a phone, a data set with true poses: the
decoded frames, and sharp held-out views from elsewhere.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ....errors import UserError
from ....storage.files import read_text
from ....storage.json_files import parse_json
from ....storage.output_folders import paths_in, write_folder_atomically
from ..renderer import SURFACE_POINTS
from .request import FilmRequest, check
from .shooting import Shooting
from .stage import Stage, stage_of
from .truth import write_data_set, write_ground_truth, write_maps, write_truth

MARKER = "film.json"
VERSION = 1
"""Version of the pictures and the truth that a request yields."""


class FilmPlan(NamedTuple):
    """A checked request, ready for ``make_film``."""

    folder: Path
    request: FilmRequest
    stage: Stage
    shooting: Shooting
    made: bool
    """True if the folder already holds this film."""

    @property
    def pictures(self) -> int:
        """Number of pictures to be taken."""
        request = self.request
        held_out = request.test if request.kind == "phone" else 0
        return self.shooting.count * len(self.shooting.takes) + held_out


def plan_film(folder: str | Path, request: FilmRequest, device: str = "cpu") -> FilmPlan:
    """Check the request and plan the cameras; write nothing.

    Args:
        folder: must not exist, or be empty, or hold the result of the same request.
        device: device of the ray casting, ``cpu`` or ``cuda``.

    Raises:
        UserError: one line naming the option or the folder and the remedy.
    """
    from ..zoo import SUBJECTS

    folder = Path(folder)
    if request.subject not in SUBJECTS:
        raise UserError(f"--subject {request.subject}: give one of: {', '.join(SUBJECTS)}")
    check(request)
    made = _recipe_of(folder) == _recipe(request)
    if not made and folder.exists() and (not folder.is_dir() or paths_in(folder)):
        raise UserError(f"{folder}: exists and holds something else; give another --output, or remove it")
    stage = stage_of(request.subject, device)
    return FilmPlan(folder, request, stage, Shooting.plan(request, stage.floor), made)


def make_film(plan: FilmPlan, done: Callable[[], object] = lambda: None) -> Path:
    """Make the folder, unless it already holds the film. The same request gives the same bytes on one machine.

    Args:
        done: called after each picture.

    Raises:
        UserError: the folder cannot be written.
    """
    if not plan.made:
        write_folder_atomically(plan.folder, lambda work: _write(work, plan, done))
    return plan.folder


def _write(work: Path, plan: FilmPlan, done: Callable[[], object]) -> None:
    request, stage, shooting = plan.request, plan.stage, plan.shooting
    rng = np.random.default_rng([request.seed, 7])
    points = stage.sample(SURFACE_POINTS, rng)
    for take in shooting.takes:
        shooting.shoot(stage, take, work / take.file, done)
        if request.maps:
            write_maps(work, stage, shooting, take)
    write_truth(work, shooting)
    if request.kind == "phone":
        write_data_set(work, stage, shooting, request, rng, done)
        write_ground_truth(work, stage, shooting, points)
    (work / MARKER).write_text(json.dumps(_recipe(request), indent=1) + "\n", encoding="utf-8")


def _recipe(request: FilmRequest) -> dict[str, Any]:
    """Make the content of the marker file, which holds no path, date or host."""
    return json.loads(json.dumps({"version": VERSION, **asdict(request)}))


def _recipe_of(folder: Path) -> dict[str, Any] | None:
    try:
        return parse_json(read_text(folder / MARKER))
    except (OSError, ValueError):
        return None
