"""Stages of a rig's capture: sound, frames, still pictures, cameras, points, undistorted images."""

from __future__ import annotations

import hashlib
import math
import shutil
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...data.dataset import spread
from ...errors import UserError
from ...runtime.progress import ShowProgress, progress
from ...storage.json_files import as_number
from ...storage.png_files import write_png
from .. import features, pictures
from ..colmap import remove_database
from ..features import FrameFiles
from ..journal import Journal, disk_errors
from ..source import Video, read_rgb
from ..writing import FILE
from . import adjustment, cameras, own_lenses, still, synchronisation
from .common_size import CommonSize, common_size, common_size_of
from .exposure import describe_exposures
from .instants import Recorded, TimeLine, recorded, shortened_by, time_line
from .neural_video import POSES, KnownCameras, known_cameras, write_neural_video
from .points import points_at
from .request import FEWEST_CAMERAS, RigRequest, check, videos_of
from .sound import read_sound
from .writing import FEW_CAMERAS, write_rig

SHEET = "contact_sheet.png"


class RigResult(NamedTuple):
    """Result of a rig's capture."""

    names: list[str]
    starts: list[float]
    """Seconds at which the cameras begin, the earliest at 0."""
    registered: list[str]
    """Names of the cameras that were found."""
    held_out: str
    """Name of the camera that is held out, or what is held out of fewer than ``FEW_CAMERAS``."""
    lines: list[str]
    """Description of the result, for the user."""
    made_before: bool


def capture_rig(request: RigRequest, folder: Path, *, device: str = "cpu", show: ShowProgress = progress) -> RigResult:
    """Make the data set in ``folder``, or resume an interrupted attempt.

    A folder in the layout of Neural 3D Video (``poses_bounds.npy`` beside the videos) keeps its cameras, and is written
    in this layout again, with images and points.

    Args:
        device: device of the comparison of descriptors.
        show: ``show(total, text)`` is a context manager that shows progress; its value has ``advance()``.

    Raises:
        UserError: a video or an option is invalid, or too few cameras were found.
    """
    videos = videos_of(request.folder)
    check(request, list(videos))
    known = known_cameras(request.folder, list(videos))
    with disk_errors(folder):
        rig = _Rig(request, folder, videos, FILE if known is None else POSES, device, show)
        with rig.journal.started():
            return _capture(rig, known)


def _capture(rig: _Rig, known: KnownCameras | None) -> RigResult:
    """Run or resume all stages.

    Args:
        known: cameras that need not be found.
    """
    request, folder, files, names, show = rig.request, rig.folder, rig.files, rig.names, rig.show
    before = rig.journal.finished
    starts = [0.0] * len(files) if known is not None and request.offsets is None else rig.starts()
    line = rig.frames(starts, known is not None)
    if known is not None:
        if not before:
            found = rig.points(known.cameras(rig.size_of))
            write_neural_video(folder, request.folder, names, len(line.seconds), rig.picture_file, found, show)
        lines = [rig.describe(line), f"cameras of {request.folder.name}/poses_bounds.npy", *rig.cut_off()]
        return RigResult(names, starts, names, names[0], lines, before)
    solved = rig.cameras(line)
    missing = [name for number, name in enumerate(names) if number not in solved.cameras]
    rig.enough(solved, missing)
    held_out = request.held_out or names[min(solved.cameras)]
    if held_out in missing:
        raise UserError(f"--held-out {held_out}: its pose was not found; hold out another camera")
    lines = [rig.describe(line), rig.describe_clock(starts)]
    lines += shortened_by(names, starts, [each.seconds for each in rig.recorded]) if request.end is None else []
    lines += [f"note: {', '.join(missing)}: too little in common with the others; left out"] if missing else []
    lines += own_lenses.describe_lenses(solved) if request.lens == "auto" else []
    lines += [*rig.size.describe(names), *rig.cut_off(), *rig.unadjusted(), *rig.unsteady(), *rig.exposures]
    if not before:
        extra = rig.points(solved.cameras)
        write_rig(folder, solved, extra, names, line, held_out, rig.picture, show, rig.size.turns)
    held = held_out if len(solved.cameras) >= FEW_CAMERAS else "every eighth instant"
    return RigResult(names, starts, [n for n in names if n not in missing], held, lines, before)


class _Rig:
    """A rig in work."""

    def __init__(
        self, request: RigRequest, folder: Path, videos: dict[str, Path], marker: str, device: str, show: ShowProgress
    ) -> None:
        """
        Args:
            videos: by the names of the cameras.
            marker: file whose presence marks a finished folder.
        """
        self.request, self.folder = request, folder
        self.names, self.files = list(videos), list(videos.values())
        self.device, self.show = device, show
        self.videos = [Video(file) for file in self.files]
        self.journal = Journal(folder, self._digest, marker)
        self.work = self.journal.work
        self.recorded: list[Recorded] = []
        self.size = CommonSize(request.size, [0] * len(videos), None)
        self.exposures: list[str] = []
        """Note on cameras that are darker or brighter than most."""

    def _digest(self, earlier: bool) -> str:
        return hashlib.sha256("".join(video.digest(earlier) for video in self.videos).encode()).hexdigest()

    def starts(self) -> list[float]:
        """Return the seconds at which the cameras begin: the given ones, or those found by sound."""
        given = self.request.offsets
        if given is not None:
            begins = np.broadcast_to(np.array(given, np.float64), len(self.files))
            return (begins - begins.min()).tolist()
        stored = self.journal.stage("sound", None, self._listen, lambda: None)
        found = [as_number(value) for value in stored.get("starts", [])] if isinstance(stored, dict) else []
        if len(found) != len(self.files) or any(value is None or abs(value) > 1e9 for value in found):
            raise self.journal.damaged("sound")
        return [value for value in found if value is not None]

    def _listen(self) -> dict[str, Any]:
        with self.show(len(self.files), "listening") as bar:
            sounds = []
            for file in self.files:
                sounds.append(read_sound(file))
                bar.advance()
        shown = [str(file.relative_to(self.request.folder)) for file in self.files]
        silent = [file for file, sound in zip(shown, sounds) if sound is None]
        if silent:
            raise UserError(
                f"{', '.join(silent)}: no sound to synchronise by; give --offsets, the second at which each video "
                "begins, or --offsets 0 if all begin at once"
            )
        clock = synchronisation.synchronise(sounds)
        lost = [file for file, start in zip(shown, clock.starts) if not np.isfinite(start)]
        if lost:
            raise UserError(
                f"{', '.join(lost)}: its sound matches that of no other camera; give --offsets, or take it out"
            )
        return {"starts": clock.starts.tolist(), "disagreement": clock.disagreement}

    def describe_clock(self, starts: list[float]) -> str:
        """Say how the cameras were synchronised."""
        if self.request.offsets is not None:
            return "begins as given by --offsets"
        stored = self.journal.result("sound")
        begins = ", ".join(f"{name} {start:.3f}" for name, start in zip(self.names, starts))
        off = as_number(stored.get("disagreement")) or 0.0
        return f"begins by sound, in seconds: {begins}; pairs of cameras disagree by {1000 * off:.1f} ms"

    def frames(self, starts: list[float], known: bool) -> TimeLine:
        """Choose the instants, and write each camera's frames. Those of known cameras are all taken, as they are."""
        request, folder = self.request, self.work / "frames"
        self.recorded = [recorded(file) for file in self.files]
        own = [each.seconds for each in self.recorded]
        count = len(own[0]) if known and request.frames is None else request.frames
        line = time_line(self.names, starts, own, count, request.start, request.end)

        def make() -> dict[str, Any]:
            folder.mkdir(exist_ok=True)
            size = CommonSize(request.size, [0] * len(own), None)
            if not known:
                size = common_size(self.videos, line.frames, request.size, self.show)
            with self.show(line.frames.size, "writing frames") as bar:
                for camera, video in enumerate(self.videos):
                    self._unpack(video, camera, line, size, bar)
            return size._asdict()

        settings = [request.start, request.end, count, request.size, [round(start, 6) for start in starts]]
        stored = self.journal.stage("frames", settings, make, lambda: shutil.rmtree(folder, ignore_errors=True))
        size = common_size_of(stored, len(own))
        if size is None:
            raise self.journal.damaged("frames")
        self.size = size
        return line

    def _unpack(self, video: Video, camera: int, line: TimeLine, size: CommonSize, bar: Any) -> None:
        wanted: dict[int, list[int]] = {}
        for instant, index in enumerate(line.frames[camera].tolist()):
            wanted.setdefault(index, []).append(instant)
        left, own = len(line.seconds), self.recorded[camera]
        tolerated = 0.5 * float(np.median(np.diff(own.seconds)))
        for frame in video.frames(size.whole(camera), wanted):
            if own.timed and abs(frame.seconds - own.seconds[frame.index]) > tolerated:
                raise UserError(
                    f"{video.path}: frames before second {frame.seconds:.2f} cannot be decoded; copy it again from "
                    "where it was recorded, or leave out this part of all videos (--start, --end)"
                )
            for instant in wanted[frame.index]:
                write_png(self.picture_file(camera, instant), size.shown(camera, frame.image))
                left -= 1
                bar.advance()
            if left == 0:
                return
        raise UserError(f"{video.path}: ends before its last frame; save it again, or give an earlier --end")

    def picture_file(self, camera: int, instant: int) -> Path:
        """Return the file of a camera's frame."""
        return self.work / "frames" / f"{self.names[camera]}_{instant:05d}.png"

    def picture(self, camera: int, instant: int) -> np.ndarray:
        """Read a camera's frame [H, W, 3] uint8 RGB, as recorded."""
        return read_rgb(self.picture_file(camera, instant))

    def size_of(self, camera: int) -> tuple[int, int]:
        """Return (width, height) of a camera's frames."""
        height, width = self.picture(camera, 0).shape[:2]
        return width, height

    def _stills(self, line: TimeLine) -> FrameFiles:
        """Make one picture per camera in which nothing moves, and its mask."""
        folder, masks = self.work / "stills", self.work / "still_masks"
        some = np.array(spread(len(line.seconds), still.MOST_MOMENTS))

        def make() -> dict[str, Any]:
            folder.mkdir(exist_ok=True)
            masks.mkdir(exist_ok=True)
            shares, shifts, bumps = [], [], []
            with self.show(len(self.files), "finding what stands still") as bar:
                for camera, name in enumerate(self.names):
                    made = still.still_of([self.picture(camera, int(instant)) for instant in some])
                    write_png(folder / f"{name}.png", made.image)
                    mask = np.where(made.moves, 0, 255).astype(np.uint8)
                    write_png(masks / f"{name}.png", np.repeat(mask[..., None], 3, 2))
                    shares.append(float(made.moves.mean()))
                    shifts.append(made.shift)
                    seconds = (self.request.start or 0.0) + line.moments[camera][some]
                    bumps.append(made.bump and seconds[list(made.bump)].tolist())
                    bar.advance()
            return {"moves": shares, "shifts": shifts, "bumps": bumps}

        def clear() -> None:
            shutil.rmtree(folder, ignore_errors=True)
            shutil.rmtree(masks, ignore_errors=True)

        self.journal.stage("stills", None, make, clear)
        return FrameFiles(folder, [f"{name}.png" for name in self.names], masks)

    def cameras(self, line: TimeLine) -> cameras.RigSolution:
        """Find the cameras with COLMAP."""
        request, stills = self.request, self._stills(line)
        database, model, target = (self.work / name for name in ("database.db", "model", "adjusted"))
        count, chosen = len(self.names), cameras.pairs_of(len(self.names))
        sizes = {self.size_of(camera) for camera in range(count)}
        shared = request.lens == "shared" or (request.lens == "auto" and len(sizes) == 1)
        if shared and len(sizes) > 1:
            raise UserError("--lens shared: the videos have different sizes; give --lens each")
        width = self.size_of(0)[0]
        focal = None if request.fov is None else 0.5 * width / math.tan(math.radians(request.fov) / 2)

        def find() -> None:
            features.begin(database, stills, request.camera_model, focal, shared)
            with self.show(count, "features") as bar:
                features.extract(database, stills, request.features, bar.advance)

        def compare() -> None:
            with self.show(len(chosen), "matching") as bar:
                features.match(database, stills, chosen, request.seed, self.device, bar.advance)

        def solve_cameras() -> int:
            found = cameras.solve(database, stills, model, request.seed)
            if shared and request.lens == "auto":
                lens = (request.camera_model, focal)
                own_lenses.prefer_own_lenses(database, stills, model, *lens, request.seed, self.device)
            return found

        settings = [request.camera_model, request.fov, request.features, shared]
        self.journal.stage("features", settings, find, lambda: remove_database(database))
        self.journal.stage("matches", request.seed, compare, lambda: features.forget(database))
        with self.show(1, "cameras") as bar:
            self.journal.stage("cameras", request.seed, solve_cameras, lambda: shutil.rmtree(model, ignore_errors=True))
            bar.advance()
        # Captures that earlier versions finished have no adjusted cameras.
        if model.is_dir() and (self.journal.knows("adjustment") or not self.journal.finished):
            with self.show(adjustment.ROUNDS * count, "adjusting cameras") as bar:
                self.journal.stage(
                    "adjustment",
                    None,
                    lambda: adjustment.adjust(model, stills, target, bar.advance),
                    lambda: shutil.rmtree(target, ignore_errors=True),
                )
            model = target
        solved = cameras.read_solution(model, stills.names)
        self._draw(stills, set(solved.cameras) if solved else set())
        if solved is None:
            raise UserError(self._nothing_found(database, stills))
        self.exposures = describe_exposures(model, stills, self.names)
        return solved

    def _nothing_found(self, database: Path, stills: FrameFiles) -> str:
        links = features.links(database, stills)
        return (
            f"{self.folder}: no two cameras see enough in common ({links.features} features a camera, {links.inliers} "
            "matches between neighbours); put cameras closer together (at most 20 degrees apart), or show them more "
            "texture; contact_sheet.png shows what each camera sees"
        )

    def _draw(self, stills: FrameFiles, registered: set[int]) -> None:
        if self.journal.finished:
            return
        assert stills.masks is not None
        masks = stills.masks

        def load(k: int) -> tuple[np.ndarray, np.ndarray]:
            return read_rgb(stills.folder / stills.names[k]), read_rgb(masks / stills.names[k])[..., 0] < 128

        pictures.sheet(self.folder / SHEET, load, self.names, registered)

    def enough(self, solved: cameras.RigSolution, missing: list[str]) -> None:
        """Refuse a solution with too few cameras."""
        found = len(solved.cameras)
        if found < max(self.request.least * len(self.names), FEWEST_CAMERAS):
            raise UserError(
                f"{self.folder}: {found} of {len(self.names)} cameras found; {', '.join(missing)} share too little "
                "with the others: put cameras closer together, or show them more texture; --least "
                f"{math.floor(100 * found / len(self.names)) / 100:g} takes it as it is (finished work is kept; the "
                "same command continues from it)"
            )

    def points(self, known: dict[int, cameras.RigCamera]) -> tuple[np.ndarray, np.ndarray]:
        """Triangulate what the cameras see at the first instant."""
        first = {number: self.picture(number, 0) for number in known}
        total = len(known) + len(known) * (len(known) - 1) // 2
        with self.show(total, "points") as bar:
            return points_at(first, known, self.request.features, self.device, bar.advance)

    def describe(self, line: TimeLine) -> str:
        """Describe the time line."""
        length = float(line.seconds[-1])
        return (
            f"{len(self.names)} cameras, {len(line.seconds)} instants within {length:.2f} s that all of them recorded"
        )

    def cut_off(self) -> list[str]:
        """Name the videos that end before their headers say; they shorten the time of all cameras."""
        found = zip(self.files, self.recorded)
        return [f"note: {file}: {each.incomplete.describe()}" for file, each in found if each.incomplete is not None]

    def unadjusted(self) -> list[str]:
        """Say if the cameras could not be adjusted to matches of the still pictures."""
        if not self.journal.knows("adjustment") or self.journal.result("adjustment") is not False:
            return []
        return ["note: the cameras could not be adjusted to dense matches, and stay as their features place them"]

    def unsteady(self) -> list[str]:
        """Name the cameras that do not stand still."""
        stored = self.journal.result("stills")
        shifts, bumps = (stored.get(key, []) if isinstance(stored, dict) else [] for key in ("shifts", "bumps"))
        lines = []
        for name, shift, bump in zip_longest(self.names, shifts, bumps):
            if (as_number(shift) or 0.0) > still.MAX_SHIFT:
                lines.append(f"note: {name} {_moved(bump)}")
        return lines


def _moved(bump: Any) -> str:
    """Say that a camera moved, and what to do.

    Args:
        bump: seconds before and after which it stood still; anything else if it moved for longer, or that is unknown.
    """
    seconds = [as_number(second) for second in bump] if isinstance(bump, list) else []
    before, after = seconds if len(seconds) == 2 else (None, None)
    if before is None or after is None:
        return (
            "moved while recording, but each camera of a rig gets one pose; give --start and --end of a part in which "
            "it stands still, with another --output, or take its video out"
        )
    end, start = math.floor(100 * before) / 100, math.ceil(100 * after) / 100
    return (
        f"was moved between seconds {end:g} and {start:g}, but each camera of a rig gets one pose; --end {end:g} or "
        f"--start {start:g}, with another --output, takes one part"
    )
