"""Data sets made from a glTF file or a built-in subject: ``plan_synthesis`` checks a request, ``synthesize`` writes
the data set."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import UserError
from ...storage.files import read_text
from ...storage.json_files import parse_json
from ...storage.output_folders import paths_in, write_folder_atomically
from ..dataset import spread
from ..gltf.scene import GltfScene, read_scene
from .contact_sheet import ContactSheet
from .mesh import MeshSubject
from .orbit_cameras import FilmingSettings, PlannedPicture, camera_of, plan_pictures
from .renderer import SURFACE_POINTS, Background, Optics, Subject, write_pictures, write_png
from .shading import Shading
from .zoo import SUBJECTS
from .zoo import VERSION as ZOO_VERSION
from .zoo.rods import FILE as RODS_FILE
from .zoo.rods import RodsSubject

MARKER = "synthesis.json"
SHEET = "contact_sheet.png"
VERSION = 1
"""Version of the pictures and the ground truth that a request yields."""
MAX_SIDE = 8192
LOOKED_AT, SMALL = 24, 100
"""Number of pictures, and their size in pixels, in which backs of surfaces are looked for."""
MANY_BACKS = 0.01
"""Share of the subject's pixels that backs must cover to be told."""


@dataclass(frozen=True)
class SynthesisRequest:
    """Settings of a data set: everything that determines its bytes, except the contents of the mesh file."""

    mesh: Path | None = None
    """A glTF file; None: a built-in subject."""
    clip: str | None = None
    """Name of the clip; None: the file's first one that moves."""
    start: float | None = None
    """Time of the clip, in seconds, that becomes time 0; None: its first keyframe."""
    end: float | None = None
    """Time of the clip, in seconds, that becomes time 1; None: its last keyframe."""
    filming: FilmingSettings = field(default_factory=FilmingSettings)
    shading: Shading = field(default_factory=Shading)
    samples: int = 4
    """Number of rays per pixel along each axis."""
    background: Background = "transparent"
    seed: int = 0
    subject: str | None = None
    """Name of a built-in subject, a key of ``zoo.SUBJECTS``; None: ``robot``, unless there is a mesh."""


class SynthesisPlan(NamedTuple):
    """A checked request, ready for ``synthesize``."""

    folder: Path
    request: SynthesisRequest
    subject: Subject
    points: Any
    """Surface points whose tracks become the ground truth."""
    pictures: dict[str, list[PlannedPicture]]
    recipe: dict[str, Any]
    """Content of the marker file: the request and the identity of the mesh file."""
    lines: list[str]
    """Description of the subject, for the user."""
    made: bool
    """True if the folder already holds this data set."""

    @property
    def counts(self) -> dict[str, int]:
        """Number of pictures of each split."""
        return {split: len(pictures) for split, pictures in self.pictures.items()}

    @property
    def truth_files(self) -> list[str]:
        """Names of the files with the true motion."""
        return ["ground_truth.npz", *([RODS_FILE] if isinstance(self.subject, RodsSubject) else [])]


def check(request: SynthesisRequest) -> None:
    """Check the values of a request.

    Raises:
        UserError: naming the option, its value and the remedy.
    """
    filming = request.filming
    if not (8 <= filming.width <= MAX_SIDE and 8 <= filming.height <= MAX_SIDE):
        raise UserError(f"--size {filming.width} {filming.height}: give 8 to {MAX_SIDE} pixels")
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
        if not 0.0 <= getattr(request.shading, name) <= 100.0:
            raise UserError(f"--{name} {getattr(request.shading, name):g}: give 0 to 100 (1 is full daylight)")
    direction = np.asarray(request.shading.light, np.float64)
    if not np.isfinite(direction).all() or not np.linalg.norm(direction) > 0:
        raise UserError("--light: give a direction that is not zero, as --light -0.4 -0.6 0.7")
    _check_subject(request)


def _check_subject(request: SynthesisRequest) -> None:
    if request.mesh is not None and request.subject is not None:
        raise UserError(f"--subject {request.subject}: give either --subject or --mesh")
    if request.subject is not None and request.subject not in SUBJECTS:
        raise UserError(f"--subject {request.subject}: give one of: {', '.join(SUBJECTS)}")
    if request.mesh is None:
        given = [name for name in ("clip", "start", "end") if getattr(request, name) is not None]
        given += ["two-sided"] if request.shading.two_sided else []
        if given:
            raise UserError(f"--{given[0]}: is for glTF files; give one with --mesh, or leave it out")


def span_of(scene: GltfScene, start: float | None, end: float | None) -> tuple[float, float]:
    """Return the times of the clip, in seconds, that become times 0 and 1.

    Raises:
        UserError: the times lie outside the clip, or are in the wrong order.
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


def load_subject(request: SynthesisRequest, device: str) -> tuple[Subject, dict[str, Any], list[str]]:
    """Load the subject; return it with its part of the recipe (the marker file's content) and its description.

    Raises:
        UserError: the mesh, the clip or the time range is invalid.
    """
    if request.mesh is None:
        return _load_builtin(request.subject or "robot", request.shading, device)
    scene = read_scene(request.mesh, request.clip)
    span = span_of(scene, request.start, request.end)
    subject = MeshSubject(scene, span, request.shading, device)
    clip = scene.clip
    identity = {
        "subject": scene.path.name,
        "sha256": scene.digest,
        "clip": clip.name if clip else None,
        "seconds": list(span),
        "world_from_gltf": scene.world_from_gltf.tolist(),
    }
    return subject, identity, describe(scene, span)


def _load_builtin(name: str, shading: Shading, device: str) -> tuple[Subject, dict[str, Any], list[str]]:
    subject = SUBJECTS[name](device, shading)
    if name == "robot":
        return subject, {"subject": "built-in figure"}, ["the built-in figure"]
    return subject, {"subject": f"built-in {name}", "subject_version": ZOO_VERSION}, [f"the built-in subject {name}"]


def describe(scene: GltfScene, span: tuple[float, float]) -> list[str]:
    """Describe a file for the user: sizes, clips and omitted primitives."""
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
        if scene.clip.ignored:
            lines.append(f"{scene.clip.ignored} of its channels move neither nodes nor weights, and are left out")
        if span[0] == span[1]:
            lines.append("the clip has no length: nothing will move; choose another with --clip")
        elif not scene.clip.moves:
            lines.append("no value changes in the clip: nothing will move; choose another with --clip")
    if scene.skipped:
        lines.append(f"{scene.skipped} sets of points or lines are left out")
    return lines


def plan_synthesis(folder: str | Path, request: SynthesisRequest, device: str = "cpu") -> SynthesisPlan:
    """Load the subject and check the request; write nothing.

    Args:
        folder: must not exist, or be empty, or hold the result of the same request.
        device: device of the ray casting, ``cpu`` or ``cuda``.

    Raises:
        UserError: one line naming the option or the file, the field and the remedy.
    """
    folder = Path(folder)
    check(request)
    subject, identity, lines = load_subject(request, device)
    recipe = _recipe(request, identity)
    made = _recipe_of(folder) == recipe
    if not made and folder.exists() and (not folder.is_dir() or paths_in(folder)):
        raise UserError(f"{folder}: exists and holds something else; give another --output, or remove it")
    rng = np.random.default_rng(request.seed)
    points = subject.sample(SURFACE_POINTS, rng)
    pictures = plan_pictures(request.filming, rng)
    lines += _backs(subject, pictures["train"], request)
    return SynthesisPlan(folder, request, subject, points, pictures, recipe, lines, made)


def _backs(subject: Subject, pictures: list[PlannedPicture], request: SynthesisRequest) -> list[str]:
    """Tell if parts of a file's subject vanish from behind: no scene looks like that."""
    if not isinstance(subject, MeshSubject) or request.shading.two_sided:
        return []
    fov = math.radians(request.filming.fov)
    chosen = [pictures[index] for index in spread(len(pictures), LOOKED_AT)]
    views = [(own.time, camera_of(own.camera_to_world, fov, SMALL, SMALL)) for own in chosen]
    share = subject.share_of_backs(views)
    if share < MANY_BACKS:
        return []
    return [
        f"{100 * share:.0f} % of the subject are backs of surfaces that the file shows from one side only: they vanish "
        "from behind, which training cannot learn; --two-sided shows them"
    ]


def synthesize(planned: SynthesisPlan, progress: Callable[[int, int], None] | None = None) -> Path:
    """Make the data set, unless it already exists. The same request gives the same bytes.

    Args:
        progress: called with (done, total) after each picture.

    Returns:
        The folder.

    Raises:
        UserError: the folder cannot be written.
    """
    if planned.made:
        return planned.folder
    filming, request = planned.request.filming, planned.request
    optics = Optics(float(np.radians(filming.fov)), filming.width, filming.height, request.samples, request.background)
    total, sheet, count = sum(planned.counts.values()), ContactSheet(planned.counts), 0

    def done() -> None:
        nonlocal count
        count += 1
        if progress is not None:
            progress(count, total)

    def write(work: Path) -> None:
        write_pictures(work, planned.subject, planned.points, planned.pictures, optics, done, sheet)
        write_png(work / SHEET, sheet.draw())
        if isinstance(planned.subject, RodsSubject):
            times = {split: [picture.time for picture in own] for split, own in planned.pictures.items()}
            planned.subject.write_rods(work, times)
        (work / MARKER).write_text(json.dumps(planned.recipe, indent=1) + "\n", encoding="utf-8")

    write_folder_atomically(planned.folder, write)
    return planned.folder


def _recipe(request: SynthesisRequest, identity: dict[str, Any]) -> dict[str, Any]:
    """Make the content of the marker file, which holds no path, date or host."""
    look = asdict(request.shading)
    if not look["two_sided"]:  # earlier versions did not have it
        del look["two_sided"]
    options = {
        "filming": asdict(request.filming),
        "look": look,
        "samples": request.samples,
        "background": request.background,
        "seed": request.seed,
    }
    return json.loads(json.dumps({"version": VERSION, **identity, **options}))


def _recipe_of(folder: Path) -> dict[str, Any] | None:
    try:
        return parse_json(read_text(folder / MARKER))
    except (OSError, ValueError):
        return None
