"""Scenes of other programs, as ``apps/capture.py --poses`` reads them."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from fuzz.files_cases import Format, check_dataset
from fuzz.files_edits import silent
from helpers.foreign_scenes import WRITERS
from scgs_warp.capture import import_scene
from scgs_warp.data import load


def _loader(source: Callable[[Path], Path]) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        with tempfile.TemporaryDirectory() as place:
            import_scene(source(folder), Path(place) / "data", silent)
            check_dataset(load(Path(place) / "data"))

    return read


def _found(folder: Path) -> Path:
    """Return the .npz in a folder; the folder if it has none, or one for each frame."""
    files = list(folder.glob("*.npz"))
    return files[0] if len(files) == 1 else folder


FORMATS = tuple(
    Format(f"import-{name.lower().replace(' ', '-')}", write, _loader(_found), share=0.6)
    for name, write in WRITERS.items()
)
