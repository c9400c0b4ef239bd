"""Export requests and their validation, without heavy imports."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from ..errors import UserError
from ..formats.sog_files import META, check_folder
from ..geometry.axes import Axis
from ..storage.output_folders import make_parent, refuse_inputs
from ..storage.suffixes import longest_suffix
from ..visualization.video import MAX_FRAMES, SLOWEST
from ..visualization.video import SUFFIXES as FILM_SUFFIXES

Format = Literal[
    "ply",
    "ply-sequence",
    "sog-sequence",
    "compressed.ply",
    "splat",
    "spz",
    "sog",
    "glb",
    "graph",
    "npz",
    "tracks",
    "4dgs",
    "cameras",
    "html",
    "mesh",
]
SUFFIXES: dict[Format, str] = {
    "ply": ".ply",
    "compressed.ply": ".compressed.ply",
    "splat": ".splat",
    "spz": ".spz",
    "sog": ".sog",
    "glb": ".glb",
    "npz": ".npz",
    "tracks": ".csv",
    "4dgs": ".4dgs",
    "cameras": ".json",
    "html": ".html",
    "graph": ".glb",
    "ply-sequence": "",
    "sog-sequence": "",
    "mesh": ".obj",
}
"""Suffix of each format's output. Formats may share a suffix, which then selects the first of them. If a name ends in
several suffixes, the longest of them counts."""
TRACK_SUFFIXES = (".csv", ".npz", ".glb")
"""Suffixes of tracks. The last two select other formats unless ``--format tracks`` is given."""
MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb")
"""Suffixes of meshes. The last two select Gaussians unless ``--format mesh`` is given."""
OTHER_SUFFIXES = {".htm": ".html", ".stl": ".obj", "meta.json": ".sog"}
"""Alternative suffixes, and a whole name: a SOG that is not bundled."""
STILL_FORMATS: tuple[Format, ...] = ("ply", "compressed.ply", "splat", "spz", "sog", "glb")
"""Formats of Gaussians at one instant; ``glb`` holds the motion if no instant is given."""
SEQUENCES = ("ply-sequence", "sog-sequence")
FRAME_FORMATS = (*SEQUENCES, "tracks", "4dgs")
"""Formats of many moments, which hold the motion of every motion model."""
MAX_POINTS = 1_000_000
MESH_LIMITS = {"faces": (100, 10_000_000), "resolution": (16, 2048)}
"""Smallest and largest value of the options of meshes."""


@dataclass(frozen=True)
class ExportRequest:
    """Write a scene as a file that other programs open (docs/formats.md)."""

    output: Path
    """File to write, or the folder of a sequence. An existing one is replaced when the new one is complete. A SOG
    named FOLDER/meta.json is not bundled: its images lie beside it."""
    run: Path | None = None
    """Folder of a run, as apps/train.py writes it."""
    ply: Path | None = None
    """Instead of a run: Gaussians to convert, in a .ply of 3D Gaussian splatting, a .compressed.ply, a .splat, a .spz,
    a .sog or a SOG's meta.json."""
    up: Axis | None = None
    """Axis of --ply's file that points up; -y by default, as in reconstructions from photographs."""
    format: Format | None = None
    """ply, compressed.ply, splat, spz, sog: Gaussians at one instant. ply-sequence, sog-sequence: a file for every
    frame. glb: glTF with Gaussians, moved by control points as an animated skeleton; still with --time. graph: the
    control points and their edges as an animated glTF mesh. npz: Gaussians, weights and trajectories as arrays.
    cameras: the run's cameras as nerfstudio's transforms.json. html: a page that plays the scene. tracks: paths of
    surface points, in .npz, .csv or .glb. 4dgs: Gaussians in linear segments, for players of that format. mesh: the
    surface as triangles, in .obj, .stl, .ply or .glb (docs/mesh.md). By default the output's suffix decides."""
    time: float | None = None
    """Instant of a still, from 0 to 1. Without it, Gaussians are at rest, before the motion; a mesh shows time 0."""
    sequence: bool = False
    """The moving mesh, as one animated .glb whose triangles stay the same."""
    faces: int | None = None
    """Largest number of a mesh's triangles; 100,000 by default."""
    resolution: int | None = None
    """Number of steps into which the longest side of a mesh is divided; 256 by default. More steps show finer details
    and take more time and memory."""
    edit: Path | None = None
    """Edit (docs/editing.md) to apply to the scene."""
    at: float | None = None
    """With --edit: the second of the edit's film that a still shows; 0 by default."""
    frames: int | None = None
    """Frame count of a sequence or an animation, evenly from time 0 to 1; 60 by default. Not with --edit, whose film
    has its own."""
    fps: float | None = None
    """Frames per second of an animation; 30 by default. Not with --edit, whose film has its own."""
    spz_version: Literal[3, 4] | None = None
    """Version of a .spz; 4 by default, 3 for readers that know no newer one."""
    pose: bool = False
    """Let visitors of a page take parts of the scene and pull them (docs/page.md)."""
    captions: Path | None = None
    """Captions of a page, as WebVTT (.vtt)."""
    url: str = ""
    """Address at which a page will be published, for links to it: a picture (.jpg) is then written beside the page."""
    points: str | None = None
    """For tracks: a number of points, spread over the surface, or a .csv of points at time 0 (x,y,z) to follow. By
    default, all Gaussians of the surface."""
    skeleton: Literal["control-points", "parts"] = "control-points"
    """Joints of a moving glb. control-points: the control points, which hold the motion exactly; parts: the parts found
    in the motion, a rig of a dozen named joints that comes close to it."""
    title: str = ""
    """Title of the page; the run's name by default."""
    max_mib: float | None = None
    """Largest page in MiB; colours lose their highest degrees of spherical harmonics, one by one, until it fits. A page
    that still does not fit is refused."""

    @property
    def kind(self) -> Format:
        """Format as requested, or by the output's suffix.

        Raises:
            UserError: the suffix belongs to no format.
        """
        if self.format is not None:
            return self.format
        suffix = output_suffix(self.output)
        for name, ending in SUFFIXES.items():
            if ending == suffix:
                return name
        raise UserError(
            f"--output {self.output}: no format ends in {suffix}; give --format {'|'.join(get_args(Format))}"
        )

    @property
    def still(self) -> bool:
        """True if the output holds one instant."""
        if self.kind == "mesh":
            return not self.sequence
        if self.kind != "glb":
            return self.kind in STILL_FORMATS
        return self.time is not None or self.at is not None or (self.run is None and self.edit is None)


def output_suffix(path: Path) -> str:
    """Return the value of ``SUFFIXES`` that the name of an output stands for, or what follows its last dot."""
    suffix = longest_suffix(path, [*filter(None, SUFFIXES.values()), *OTHER_SUFFIXES]) or path.suffix.lower()
    return OTHER_SUFFIXES.get(suffix, suffix)


def check_request(request: ExportRequest) -> None:
    """Check a request before anything is loaded.

    Raises:
        UserError: naming the option and the remedy.
    """
    kind = request.kind
    if (request.run is None) == (request.ply is None):
        raise UserError("export.py: give one of --run and --ply")
    if request.up is not None and request.ply is None:
        raise UserError(f"--up {request.up}: belongs to --ply; a run knows from its cameras what is up")
    if request.run is None and kind == "cameras":
        raise UserError(f"--format {kind}: needs --run; a file of Gaussians has no cameras")
    one_instant = kind in STILL_FORMATS or (kind == "mesh" and not request.sequence)
    if request.run is None and request.edit is None and not one_instant and kind != "html":
        if request.format is None and not output_suffix(request.output):
            endings = ", ".join(SUFFIXES[kind] for kind in (*STILL_FORMATS, "html", "mesh"))
            raise UserError(f"--output {request.output}: has no suffix; end the name in one of {endings}")
        raise UserError(f"--format {kind}: needs --run, or an --edit that moves the Gaussians of {request.ply}")
    if request.time is not None and not 0 <= request.time <= 1:
        raise UserError(f"--time {request.time:g}: give a time from 0 to 1")
    if request.time is not None and (not one_instant or request.edit is not None):
        other = (
            "an edit's film is shown at --at SECONDS" if request.edit else "leave it out: the format holds all times"
        )
        raise UserError(f"--time {request.time:g}: {other}")
    if request.edit is not None and kind == "cameras":
        raise UserError(f"--format {kind}: holds the cameras of the training; leave --edit out")
    if request.at is not None and (request.edit is None or not one_instant):
        raise UserError(f"--at {request.at:g}: is a second of an edit's film; give it with --edit and a still format")
    if request.at is not None and not 0 <= request.at <= 3600:
        raise UserError(f"--at {request.at:g}: give a second of the film, from 0 to 3600")
    if request.edit is not None and (request.frames, request.fps) != (None, None):
        given, field = ("--fps", "fps") if request.frames is None else ("--frames", "seconds or film.fps")
        remedy = f"leave it out, or change film.{field} in {request.edit}"
        raise UserError(f"{given}: the film of an edit has its own; {remedy}")
    if request.frames is not None and not 1 <= request.frames <= MAX_FRAMES:
        raise UserError(f"--frames {request.frames}: give 1 to {MAX_FRAMES}")
    if request.frames == 1 and kind == "4dgs":
        raise UserError("--frames 1: --format 4dgs needs at least two moments; give --frames 2 or more")
    if request.fps is not None and not SLOWEST <= request.fps <= 1000:
        raise UserError(f"--fps {request.fps:g}: give {SLOWEST} to 1000 frames a second")
    _check_unused(request)
    _check_mesh(request)
    if request.max_mib is not None and not request.max_mib > 0:
        raise UserError(f"--max-mib {request.max_mib:g}: give more than 0 MiB")
    if request.url and not re.fullmatch(r"https?://[^\s/]+/\S*\.html?", request.url, re.IGNORECASE):
        raise UserError(f"--url {request.url}: give the page's whole address, such as https://example.org/scene.html")
    points = None if request.points is None else Path(request.points)
    refuse_inputs(request.output, [request.ply, request.edit, request.captions, points], request.run)
    check_output(request.output, kind)


def _check_unused(request: ExportRequest) -> None:
    """Refuse options that would have no effect."""
    kind = request.kind
    if request.time is not None and request.run is None:
        raise UserError(f"--time {request.time:g}: a file of Gaussians has no times; leave it out")
    given = {"--title": request.title, "--url": request.url, "--pose": request.pose, "--captions": request.captions}
    name = next((name for name, value in given.items() if value), None if request.max_mib is None else "--max-mib")
    if kind != "html" and name is not None:
        raise UserError(f"{name}: belongs to a page; leave it out, or give --format html")
    if kind != "spz" and request.spz_version is not None:
        raise UserError(f"--spz-version: --format {kind} has no such versions; leave it out")
    name = "--frames" if request.frames is not None else "--fps" if request.fps is not None else None
    if name is not None and request.still:
        remedy = "leave out --time" if kind == "glb" and request.time is not None else "give --format ply-sequence"
        remedy = "give --sequence" if kind == "mesh" else remedy
        raise UserError(f"{name}: --output {request.output} is to hold one instant; leave {name} out, or {remedy}")
    if name is not None and kind in ("html", "cameras"):
        raise UserError(f"{name}: --format {kind} has no frames; leave it out")
    if request.points is not None and kind != "tracks":
        raise UserError(f"--points {request.points}: belongs to tracks; leave it out, or give --format tracks")
    if request.points is not None and request.points.isdecimal() and not 1 <= int(request.points) <= MAX_POINTS:
        raise UserError(f"--points {request.points}: give 1 to {MAX_POINTS:,}, or a .csv of points")
    if request.skeleton == "parts" and (kind != "glb" or request.still):
        remedy = "leave out --time" if kind == "glb" and request.time is not None else "give --format glb and --run"
        raise UserError(f"--skeleton parts: --output {request.output} is to hold no skeleton; {remedy}")
    if request.fps is not None and kind in SEQUENCES:
        raise UserError(f"--fps: a {kind} does not say how fast it is; leave it out, and give --frames")


def _check_mesh(request: ExportRequest) -> None:
    for name in ("sequence", "faces", "resolution"):
        value = getattr(request, name)
        if request.kind != "mesh" and value is not None and value is not False:
            raise UserError(f"--{name}: belongs to a mesh; leave it out, or give --format mesh")
    for name, (least, most) in MESH_LIMITS.items():
        value = getattr(request, name)
        if value is not None and not least <= value <= most:
            raise UserError(f"--{name} {value}: give {least:,} to {most:,}")
    if request.sequence and request.output.suffix.lower() != ".glb":
        raise UserError(f"--sequence: --output {request.output} holds one instant; a moving mesh is a .glb")


def check_output(path: Path, kind: Format, option: str = "--output") -> None:
    """Check that the output can be written; make missing folders. Errors name the option.

    Raises:
        UserError: the suffix is wrong, a file or folder is in the way, or the folder cannot be written.
    """
    ending, suffix, name = SUFFIXES[kind], output_suffix(path), path.name.lower()
    of_files = tuple(filter(None, (*SUFFIXES.values(), *OTHER_SUFFIXES, *FILM_SUFFIXES)))
    if name in of_files and name != META:
        raise UserError(f"{option} {path}: is a suffix without a name; put one before it")
    if not ending and name.endswith(of_files):
        raise UserError(f"{option} {path}: is named like a file; name a folder for the frames of --format {kind}")
    choices = {"tracks": TRACK_SUFFIXES, "mesh": MESH_SUFFIXES}.get(kind, (ending,))
    if ending and suffix not in choices:
        longer = f", not in {suffix}," if suffix.endswith(ending) else f" (not {META})" if path.name == META else ""
        raise UserError(f"{option} {path}: end the name in {' or '.join(choices)}{longer} for --format {kind}")
    if ending and path.is_dir():
        raise UserError(f"{option} {path}: is a folder; give another name")
    if not ending and path.exists() and not path.is_dir():
        raise UserError(f"{option} {path}: is a file; name a folder for --format {kind}")
    if name == META:
        check_folder(path)
    make_parent(path)
