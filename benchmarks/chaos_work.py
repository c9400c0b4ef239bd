"""Work that ``chaos.py`` disturbs, and the invariants that must hold after every fault."""

from __future__ import annotations

import hashlib
import json
import os
import random
import threading
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import scgs_warp  # noqa: F401  (sets the environment before torch is imported)

from soak import small  # isort: skip
from soak_editor import RandomUser

from scgs_warp.data import load
from scgs_warp.edit import EditSession
from scgs_warp.errors import UserError
from scgs_warp.export.request import ExportRequest
from scgs_warp.export.run import export
from scgs_warp.formats.gaussian_files import read_gaussians
from scgs_warp.live.training_view import TrainingView
from scgs_warp.live.viewer import SceneView
from scgs_warp.scene.scene import Scene
from scgs_warp.storage import checkpoint
from scgs_warp.training.loop import fit

SUFFIXES = (".ply", ".glb", ".splat", ".npz", ".html")
ACTIONS = 12
"""Number of random actions in one piece of the editor's work."""


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


class Training:
    """A run that is resumed until it is complete, then begun anew."""

    name = "training"
    live = False

    def __init__(self, folder: Path, data: Path, reference: Path) -> None:
        self.run, self._data, self._reference = folder / "run", data, reference
        self._step = 0

    def work(self, seed: int) -> None:
        """Train from where the run stands to its end."""
        watcher = None
        with suppress(UserError):
            watcher = self._page() if self.live else None
        resume = self.run.is_dir()
        fit(small("control-points"), load(self._data, "train"), output=self.run, resume=resume, watcher=watcher)

    def _page(self) -> TrainingView:
        view = SceneView("chaos")
        view.wanted.set()  # as if a page were open

        def look() -> None:
            with suppress(OSError, ValueError):
                while True:
                    with urllib.request.urlopen(f"{view.server.url.rstrip('/')}/scene", timeout=5) as answer:
                        answer.read()

        threading.Thread(target=look, daemon=True).start()
        return TrainingView(view, 60)

    def check(self, status: int) -> list[str]:
        """Return the broken invariants after a piece of work that ended with ``status``."""
        broken, step, sound = [], 0, False
        names = [name for name in (checkpoint.FILE, checkpoint.PREVIOUS) if (self.run / name).is_file()]
        for name in names:
            try:
                step = max(step, int(checkpoint.read(self.run, name=name)[1]["step"]))
                sound = True
            except UserError as error:
                broken += [str(error)] if name == checkpoint.FILE else []
        if names and not sound:
            broken.append("no checkpoint is sound")
        if step < self._step:
            broken.append(f"step {self._step} was saved, and {step} is left")
        self._step = step
        log = self.run / "log.jsonl"
        for line in log.read_text(encoding="utf-8").splitlines()[:-1] if log.is_file() else []:
            with suppress(ValueError):
                json.loads(line)
                continue
            broken.append(f"the log holds {line[:60]!r}")
        if status == 0:
            if (self.run / checkpoint.FILE).read_bytes() != self._reference.read_bytes():
                broken.append("the finished run has other bits than one that was not disturbed")
            left = sorted(path.name for path in self.run.rglob(".*.tmp"))
            broken += [f"{name} is left over" for name in left]
        return broken

    def next(self, status: int) -> bool:
        """Return whether the work is complete and begins anew, in an empty folder."""
        if status == 0:
            self._step = 0
        return status == 0


class LiveTraining(Training):
    """The same while a page shows the scene."""

    name, live = "live", True


class Exporting:
    """Exports of one scene, in several formats, each to the same name again and again."""

    name = "export"

    def __init__(self, folder: Path, scene: Path, references: dict[str, str]) -> None:
        self.folder, self._scene, self._references = folder / "exports", scene, references

    def work(self, seed: int) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        for suffix in random.Random(seed).sample(SUFFIXES, 3):
            export_to(self.folder, self._scene, suffix)

    def check(self, status: int) -> list[str]:
        found = [path for path in self.folder.glob("*") if not path.name.startswith(".")]
        return [
            f"{path.name} is not what an undisturbed export writes"
            for path in found
            if digest(path) != self._references.get(path.suffix)
        ]

    def next(self, status: int) -> bool:
        return False


def export_to(folder: Path, scene: Path, suffix: str) -> Path:
    """Export a run to the name that every export of this suffix has."""
    path = folder / f"scene{suffix}"
    still = {"time": 0.5} if suffix in (".ply", ".splat") else {}
    export(ExportRequest(run=scene, output=path, **still))
    return path


class Editing:
    """The editor under random input, with edits, films and exports in one folder."""

    name = "editor"

    def __init__(self, folder: Path, scene: Path) -> None:
        self.folder, self._scene = folder / "edits", scene

    def work(self, seed: int) -> None:
        session = EditSession(Scene.load(self._scene))
        user = RandomUser(session, self.folder, seed)
        try:
            for _ in range(ACTIONS):
                user.act()
            user.rest()
        finally:
            user.stop()
        session.save(self.folder / "kept.json")

    def check(self, status: int) -> list[str]:
        readers: dict[str, Callable[[Path], object]] = {
            ".json": lambda path: EditSession(Scene.load(self._scene)).load(path),
            ".ply": read_gaussians,
            ".mp4": _decode,
        }
        broken = []
        for path in sorted(self.folder.glob("*")) if self.folder.is_dir() else []:
            if path.suffix in readers and not path.name.startswith("."):
                try:
                    readers[path.suffix](path)
                except Exception as error:
                    broken.append(f"{path.name}: {type(error).__name__}: {str(error)[:200]}")
        return broken

    def next(self, status: int) -> bool:
        return False


def _decode(path: Path) -> None:
    import av

    with av.open(os.fspath(path)) as container:
        if next(container.decode(video=0), None) is None:
            raise ValueError("no frame")


Work = Training | Exporting | Editing
