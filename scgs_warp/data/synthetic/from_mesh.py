"""From a glTF file, or the built-in figure, to a folder that trains: ``plan`` looks, ``film`` makes."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ...errors import UserError
from ...storage.json_files import parse_json
from ..gltf.scene import GltfScene, read_scene
from .builtin import FigureSubject
from .contact_sheet import Sheet
from .mesh import Look, MeshSubject
from .orbit_cameras import Filming, Shot, shots
from .renderer import SURFACE_POINTS, Background, Optics, Subject, write_pictures, write_png, write_whole

MARKER = "synthesis.json"
SHEET = "contact_sheet.png"
VERSION = 1
"""Raised whenever the same request gives other pictures or another ground truth."""
LARGEST = 8192


@dataclass(frozen=True)
class Request:
    """What to make; everything that its bytes depend on, the file's contents apart."""

    mesh: Path | None = None
    """None: the built-in figure."""
    clip: str | None = None
    """None: the file's first."""
    start: float | None = None
    """Seconds of the clip that become time 0; None: its first keyframe."""
    end: float | None = None
    """Seconds of the clip that become time 1; None: its last keyframe."""
    filming: Filming = field(default_factory=Filming)
    look: Look = field(default_factory=Look)
    samples: int = 4
    """Rays per pixel and axis."""
    background: Background = "transparent"
    seed: int = 0


class Plan(NamedTuple):
    """A request that was looked at and can be carried out: see ``film``."""

    folder: Path
    request: Request
    subject: Subject
    points: Any
    """Surface points whose tracks become the ground truth."""
    shots: dict[str, list[Shot]]
    recipe: dict[str, Any]
    """Goes into the marker: the request, and what was found in the file."""
    lines: list[str]
    """What was found, for the user."""
    made: bool
    """The folder holds just this already."""

    @property
    def counts(self) -> dict[str, int]:
        """Pictures of each split."""
        return {split: len(found) for split, found in self.shots.items()}


def check(request: Request) -> None:
    """Refuse what cannot work.

    Raises:
        UserError: naming the option, its value and the remedy.
    """
    filming = request.filming
    if not (8 <= filming.width <= LARGEST and 8 <= filming.height <= LARGEST):
        raise UserError(f"--size {filming.width} {filming.height}: give 8 to {LARGEST} pixels")
    for name, least in (("train", 2), ("test", 1), ("val", 0), ("views", 1)):
        if getattr(filming, name) < least:
            raise UserError(f"--{name} {getattr(filming, name)}: give at least {least}")
    if not 1.0 <= filming.fov <= 150.0:
        raise UserError(f"--fov {filming.fov:g}: give 1 to 150 degrees")
    low, high = filming.elevation
    if not -85.0 <= low <= high <= 85.0:
        raise UserError(f"--elevation {low:g} {high:g}: give two angles from -85 to 85 degrees, the lower one first")
    if not np.isfinite(filming.turns):
        raise UserError(f"--turns {filming.turns:g}: give a number")
    if not 1 <= request.samples <= 16:
        raise UserError(f"--samples {request.samples}: give 1 to 16 rays per pixel and axis")
    if request.seed < 0:
        raise UserError(f"--seed {request.seed}: give 0 or more")
    for name in ("ambient", "diffuse"):
        if not 0.0 <= getattr(request.look, name) <= 100.0:
            raise UserError(f"--{name} {getattr(request.look, name):g}: give 0 to 100 (1 is full daylight)")
    if request.mesh is None:
        set_anyway = [name for name in ("clip", "start", "end") if getattr(request, name) is not None]
        if set_anyway or request.look != Look():
            name = set_anyway[0] if set_anyway else "light, --ambient, --diffuse, --unlit"
            raise UserError(f"--{name}: is for glTF files; give one with --mesh, or leave it out")


def span_of(scene: GltfScene, start: float | None, end: float | None) -> tuple[float, float]:
    """The seconds of the clip that become times 0 and 1.

    Raises:
        UserError: they lie outside the clip, or in the wrong order.
    """
    clip = scene.clip
    if clip is None:
        if start is not None or end is not None:
            raise UserError(f"--start, --end: {scene.path} holds no animation; leave them out")
        return 0.0, 0.0
    first = clip.start if start is None else start
    last = clip.end if end is None else end
    if start is None and end is None:
        return first, last
    if not (0.0 <= first < last <= clip.end + 1e-6):
        raise UserError(
            f"--start {first:g} --end {last:g}: clip {clip.name} lasts from {clip.start:g} to {clip.end:g} seconds; "
            "give two of them, the earlier one as --start"
        )
    return first, last


def load_subject(request: Request, device: str) -> tuple[Subject, dict[str, Any], list[str]]:
    """The subject, what of it goes into the marker, and lines that say what was found.

    Raises:
        UserError: the mesh, the clip or the time range cannot be used.
    """
    if request.mesh is None:
        return FigureSubject(device), {"subject": "built-in figure"}, ["the built-in figure"]
    scene = read_scene(request.mesh, request.clip)
    span = span_of(scene, request.start, request.end)
    subject = MeshSubject(scene, span, request.look, device)
    clip = scene.clip
    found = {
        "subject": scene.path.name,
        "sha256": scene.digest,
        "clip": clip.name if clip else None,
        "seconds": list(span),
        "world_from_gltf": scene.world_from_gltf.tolist(),
    }
    return subject, found, describe(scene, span)


def describe(scene: GltfScene, span: tuple[float, float]) -> list[str]:
    """What a user wants to know about a file before it is filmed."""
    triangles = scene.triangles
    lines = [
        f"{scene.path.name}: {len(triangles.faces):,} triangles, {len(scene.materials) - 1} materials, "
        f"{len(scene.textures)} textures, {len(scene.palette)} bones"
    ]
    if scene.clip is None:
        lines.append("it holds no animation: nothing will move")
    else:
        others = [clip.name for clip in scene.clips if clip is not scene.clip]
        more = f"; there are also {', '.join(others)}" if others else ""
        lines.append(f"clip {scene.clip.name}, {span[0]:.2f} to {span[1]:.2f} s{more}")
    if scene.skipped:
        lines.append(f"{scene.skipped} sets of points or lines are left out")
    return lines


def plan(folder: str | Path, request: Request, device: str = "cpu") -> Plan:
    """Read what there is to read and refuse what cannot be made; nothing is written yet.

    Args:
        folder: must not exist, or be empty, or hold the result of the same request.
        device: where rays are cast, ``cpu`` or ``cuda``.

    Raises:
        UserError: one line naming the option or the file, the field and the remedy.
    """
    folder = Path(folder)
    check(request)
    subject, found, lines = load_subject(request, device)
    recipe = _recipe(request, found)
    made = _recipe_of(folder) == recipe
    if not made and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{folder}: exists and holds something else; give another --output, or remove it")
    rng = np.random.default_rng(request.seed)
    points = subject.sample(SURFACE_POINTS, rng)
    return Plan(folder, request, subject, points, shots(request.filming, rng), recipe, lines, made)


def film(planned: Plan, progress: Callable[[int, int], None] | None = None) -> Path:
    """Make the data set, unless it is there already. The same request gives the same bytes.

    Args:
        progress: called with (done, total) after each picture.

    Returns:
        The folder.

    Raises:
        UserError: it cannot be written.
    """
    if planned.made:
        return planned.folder
    filming, request = planned.request.filming, planned.request
    optics = Optics(float(np.radians(filming.fov)), filming.width, filming.height, request.samples, request.background)
    total, sheet, count = sum(planned.counts.values()), Sheet(planned.counts), 0

    def done() -> None:
        nonlocal count
        count += 1
        if progress is not None:
            progress(count, total)

    def write(work: Path) -> None:
        write_pictures(work, planned.subject, planned.points, planned.shots, optics, done, sheet)
        write_png(work / SHEET, cv2.cvtColor(sheet.draw(), cv2.COLOR_RGB2BGR))
        (work / MARKER).write_text(json.dumps(planned.recipe, indent=1) + "\n")

    write_whole(planned.folder, write)
    return planned.folder


def _recipe(request: Request, found: dict[str, Any]) -> dict[str, Any]:
    """What JSON gives back as it was: no path, no date, no host."""
    options = {key: value for key, value in asdict(request).items() if key not in ("mesh", "clip", "start", "end")}
    return json.loads(json.dumps({"version": VERSION, **found, **options}))


def _recipe_of(folder: Path) -> dict[str, Any] | None:
    try:
        return parse_json((folder / MARKER).read_text())
    except (OSError, ValueError):
        return None
