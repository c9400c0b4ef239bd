"""Stages of a capture: frames, masks, features, matches, cameras, undistorted images."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import UserError
from ..runtime.progress import progress
from ..storage.json_files import as_number
from ..visualization.video import write_png
from . import bundle_adjustment, features, mapping, moving, picking, pictures, writing
from .colmap import remove_database
from .completeness import Incomplete
from .diagnosis import Outcome, notes, too_few
from .features import CameraModel, FrameFiles, Matching
from .folder_content import photographs_left_out
from .given_masks import read_masks
from .journal import Journal, disk_errors
from .limits import check_limits
from .source import Source, SourceFrame, open_source, read_rgb

MAX_SECONDS = 1e9
"""Largest plausible time in a film, seconds."""
MIN_FRAMES = 6
"""Smallest number of frames for a capture."""
SHEET, CAMERAS = "contact_sheet.png", "cameras.png"
VIDEO_FRAMES = 150

ShowProgress = Callable[[int, str], AbstractContextManager[Any]]


@dataclass(frozen=True)
class CaptureRequest:
    """Settings of a capture."""

    source: Path
    """A video, or a folder of images."""
    frames: int | None = None
    """Largest number of frames; None: ``VIDEO_FRAMES`` for a video, all images for a folder."""
    start: float | None = None
    end: float | None = None
    """End of the part of the video to use, seconds; ``start`` is its beginning."""
    size: int = 1280
    """Largest size of the longer side of the images, pixels."""
    masks: str = "auto"
    """``auto``: masks of independently moving pixels; ``none``: no masks; anything else: a path of masks."""
    matching: Matching = "auto"
    camera_model: CameraModel = "SIMPLE_RADIAL"
    fov: float | None = None
    """Horizontal field of view, degrees; None if unknown."""
    features: int = 4096
    """Largest number of features per frame."""
    least: float = 0.5
    """Smallest share of the frames that must get a camera."""
    seed: int = 0
    keep: writing.Keep = "all"
    """What the data set shows. ``moving`` needs given masks."""


class PickedFrames(NamedTuple):
    """The picked frames of a source."""

    indices: list[int]
    """Indices in the source."""
    seconds: list[float]
    names: list[str]
    """File names of the images of a folder; empty strings for a video."""
    span: tuple[float, float]
    """Times of the video, in seconds, that become times 0 and 1."""
    size: tuple[int, int]
    """(width, height)"""
    seen: int
    """Number of frames in the source."""
    blurred: int
    alike: int
    decoded: int = 0
    """Number of frames of an incomplete video that can be decoded."""
    announced: int = 0
    """Number of frames of an incomplete video according to its header; 0 if nothing is missing."""

    @property
    def incomplete(self) -> Incomplete | None:
        """What is there of an incomplete video."""
        return Incomplete(self.decoded, self.announced, self.span[1]) if self.announced else None

    @property
    def files(self) -> list[str]:
        return [f"{moving.frame_name(index)}.png" for index in self.indices]


class CaptureResult(NamedTuple):
    """Result of a capture."""

    outcome: Outcome
    lines: list[str]
    """Description of the result, for the user."""
    made_before: bool
    """True if the folder was already complete."""


def check(request: CaptureRequest) -> None:
    """Check the values of a request.

    Raises:
        UserError: naming the option, its value and the remedy.
    """
    if request.frames is not None and request.frames < MIN_FRAMES:
        raise UserError(f"--frames {request.frames}: give at least {MIN_FRAMES}")
    check_limits(request)
    start, end = request.start or 0.0, math.inf if request.end is None else request.end
    if not 0.0 <= start < end:
        raise UserError(f"--start {start:g} --end {end:g}: give two seconds of the video, the earlier one as --start")
    if not request.masks.strip():
        raise UserError("--masks: is followed by an empty name; give auto, none, a folder or a video")
    if request.keep == "moving" and request.masks in ("auto", "none"):
        raise UserError(
            "--keep-static off: needs masks of the whole mover, black where it is; give --masks DIR or --masks "
            "FILE.mp4 (masks that are found cover only a part of it)"
        )
    if request.keep == "static" and request.masks == "none":
        raise UserError("--keep-moving off: needs masks; leave out --masks none, or give --masks DIR")


def capture(
    request: CaptureRequest, folder: Path, *, device: str = "cpu", show: ShowProgress = progress
) -> CaptureResult:
    """Make the data set in ``folder``, or resume an interrupted attempt.

    Args:
        device: device of the comparison of descriptors.
        show: ``show(total, text)`` is a context manager that shows progress; its value has ``advance()``.

    Raises:
        UserError: the source, the masks or an option is invalid, or too few frames got a camera.
    """
    check(request)
    source = open_source(request.source)
    if request.masks not in ("auto", "none"):
        open_source(Path(request.masks))
    with disk_errors(folder):
        journal = Journal(folder, source.digest)
        with journal.started():
            return _capture(request, source, journal, device, show)


def _capture(
    request: CaptureRequest, source: Source, journal: Journal, device: str, show: ShowProgress
) -> CaptureResult:
    """Run or resume all stages."""
    folder, before = journal.folder, journal.finished
    frames = _frames(request, source, journal, show)
    _enough(request, frames)
    frame_files = _masks(request, source, frames, journal, show)
    if request.keep == "moving" and _share(journal) == 0.0:
        raise UserError(f"{request.masks}: no pixel is black, so nothing moves; masks are black where something moves")
    outcome, solved = _solve(request, source, frames, frame_files, journal, device, show)
    if request.keep != "all" or journal.knows("images"):  # Folders of earlier versions have no such stage.
        journal.stage("images", request.keep, dict, lambda: None)
    lines = _lines(request, frames, outcome)
    if not before:
        _draw_sheet(folder / SHEET, frames, frame_files, solved, source.video)
    if solved is None or outcome.registered < max(request.least * len(frames.indices), 3):
        raise UserError(too_few(str(folder), outcome))
    if not before:
        _write(folder, frames, frame_files, solved, request.keep, show)
    return CaptureResult(outcome, [*lines, *notes(outcome)], before)


def _enough(request: CaptureRequest, frames: PickedFrames) -> None:
    if len(frames.indices) >= MIN_FRAMES:
        return
    if frames.seen < MIN_FRAMES:
        if frames.incomplete is not None:
            raise UserError(f"{request.source}: only {frames.incomplete.describe()}")
        raise UserError(f"{request.source}: {frames.seen} frames are too few; film a few seconds, or give more images")
    raise UserError(
        f"{request.source}: {len(frames.indices)} of {frames.seen} frames are neither blurred nor alike "
        f"({frames.blurred} blurred, {frames.alike} alike); hold the camera more steadily and walk with it"
    )


def _frames(request: CaptureRequest, source: Source, journal: Journal, show: ShowProgress) -> PickedFrames:
    """Pick the frames and write them."""
    folder = journal.work / "frames"

    def make() -> dict[str, Any]:
        chosen = _choose(request, source, show)
        wanted = dict.fromkeys(chosen.indices)
        folder.mkdir(exist_ok=True)
        size, names = (0, 0), []
        with show(len(wanted), "writing frames") as bar:
            for still in _until(source.frames(request.size), max(wanted, default=-1)):
                if still.index in wanted:
                    write_png(folder / f"{moving.frame_name(still.index)}.png", still.image)
                    size = still.image.shape[1], still.image.shape[0]
                    names.append(still.name)
                    bar.advance()
        return chosen._replace(size=size, names=names)._asdict()

    settings = {key: getattr(request, key) for key in ("frames", "start", "end", "size")}
    stored = journal.stage("frames", settings, make, lambda: shutil.rmtree(folder, ignore_errors=True))
    frames = _frames_of(stored)
    if frames is None:
        raise journal.damaged("frames")
    return frames


def _frames_of(stored: Any) -> PickedFrames | None:
    """Parse the picked frames from a journal; return None if the entry is malformed."""
    try:
        frames = PickedFrames(**{**stored, "span": tuple(stored["span"]), "size": tuple(stored["size"])})
        totals = (frames.seen, frames.blurred, frames.alike, frames.decoded, frames.announced)
        counts = (*frames.indices, *frames.size, *totals)
        whole = all(isinstance(count, int) and 0 <= count < 2**31 for count in counts)
        numbers = [as_number(second) for second in (*frames.seconds, *frames.span)]
        times = all(number is not None and abs(number) <= MAX_SECONDS for number in numbers)
        names = len(frames.names) in (0, len(frames.indices)) and all(isinstance(name, str) for name in frames.names)
        lengths = len(frames.seconds) == len(frames.indices) and len(frames.span) == len(frames.size) == 2
    except (KeyError, TypeError):
        return None
    return frames if whole and times and names and lengths else None


def _until(stills: Iterator[SourceFrame], last: int) -> Iterator[SourceFrame]:
    return takewhile(lambda still: still.index <= last, stills)


def _choose(request: CaptureRequest, source: Source, show: ShowProgress) -> PickedFrames:
    """Choose the frames to use; for a folder, all of them unless a number is given."""
    start, end = request.start or 0.0, math.inf if request.end is None else request.end
    with show(source.count, "looking at frames") as bar:
        within = (
            still
            for still in takewhile(lambda still: still.seconds <= end or not source.video, _shown(source, bar))
            if still.seconds >= start or not source.video
        )
        measures = picking.measure(within)
    if not len(measures.index):
        raise UserError(f"--start {start:g}: {source.path} ends before; give a second of the video")
    if source.video or request.frames is not None:
        picked = picking.pick(measures, request.frames or VIDEO_FRAMES)
    else:
        picked = picking.Selection(list(range(len(measures.index))), 0, 0)
    seconds = measures.seconds[picked.places].tolist()
    span = (float(measures.seconds[0]), float(measures.seconds[-1]))
    indices = measures.index[picked.places].tolist()
    there = (0, 0) if source.incomplete is None else source.incomplete[:2]
    return PickedFrames(indices, seconds, [], span, (0, 0), len(measures.index), picked.blurred, picked.alike, *there)


def _shown(source: Source, bar: Any) -> Iterator[SourceFrame]:
    for still in source.frames(picking.SHARPNESS_SIDE):
        yield still
        bar.advance()


def _masks(
    request: CaptureRequest, source: Source, frames: PickedFrames, journal: Journal, show: ShowProgress
) -> FrameFiles:
    """Write the masks, if requested."""
    folder, mask_folder = journal.work / "frames", journal.work / "masks"
    files = frames.files
    if request.masks == "none":
        journal.stage("masks", "none", dict, lambda: shutil.rmtree(mask_folder, ignore_errors=True))
        return FrameFiles(folder, files, None)
    path = Path(request.masks)

    def make() -> dict[str, Any]:
        mask_folder.mkdir(exist_ok=True)
        if request.masks == "auto":
            masks = moving.find_moving(lambda k: read_rgb(folder / files[k]), len(files))
        else:
            masks = read_masks(path, source, frames.indices, frames.names, frames.size)
        shares = []
        with show(len(files), "finding what moves" if request.masks == "auto" else "reading masks") as bar:
            for name, mask in zip(files, masks, strict=True):  # strict: masks are checked once the last one is read
                write_png(mask_folder / name, np.repeat(np.where(mask, 0, 255).astype(np.uint8)[..., None], 3, 2))
                shares.append(mask.mean())
                bar.advance()
        return {"share": float(np.mean(shares))}

    kind = "auto" if request.masks == "auto" else open_source(path).digest(journal.earlier)
    journal.stage("masks", kind, make, lambda: shutil.rmtree(mask_folder, ignore_errors=True))
    return FrameFiles(folder, files, mask_folder)


def _solve(
    request: CaptureRequest,
    source: Source,
    frames: PickedFrames,
    frame_files: FrameFiles,
    journal: Journal,
    device: str,
    show: ShowProgress,
) -> tuple[Outcome, mapping.CameraSolution | None]:
    """Run the stages of features, matches and cameras."""
    database, model, adjusted = (journal.work / name for name in ("database.db", "model", "adjusted"))
    count = len(frame_files.names)
    focal = None if request.fov is None else 0.5 * frames.size[0] / math.tan(math.radians(request.fov) / 2)
    chosen = features.pairs(count, request.matching, source.video)

    def find() -> None:
        features.begin(database, frame_files, request.camera_model, focal)
        with show(count, "features") as bar:
            features.extract(database, frame_files, request.features, bar.advance)

    def compare() -> None:
        with show(len(chosen), "matching") as bar:
            features.match(database, frame_files, chosen, request.seed, device, bar.advance)

    def solve_cameras() -> int:
        with show(count, "cameras") as bar:
            return mapping.solve(database, frame_files, model, request.seed, lambda: bar.done < count and bar.advance())

    def adjust() -> None:
        with show(bundle_adjustment.ROUNDS, "adjusting cameras") as bar:
            bundle_adjustment.adjust_model(model, adjusted, bar.advance)

    settings = [request.camera_model, request.fov, request.features]
    journal.stage("features", settings, find, lambda: remove_database(database))
    journal.stage("matches", [request.matching, request.seed], compare, lambda: features.forget(database))
    found = journal.stage("cameras", request.seed, solve_cameras, lambda: shutil.rmtree(model, ignore_errors=True))
    if found and (
        not journal.finished or journal.knows("adjustment")
    ):  # Folders of earlier versions have no such stage.
        journal.stage("adjustment", None, adjust, lambda: shutil.rmtree(adjusted, ignore_errors=True))
        model = adjusted
    solved = mapping.read_solution(model, frame_files)
    masked = 0.0 if frame_files.masks is None else _share(journal)
    registered, arc = (len(solved.places), solved.arc) if solved else (0, 0.0)
    return Outcome(count, registered, arc, features.links(database, frame_files), masked), solved


def _share(journal: Journal) -> float:
    """Return the share of masked pixels, read from the journal."""
    stored = journal.result("masks")
    share = as_number(stored.get("share")) if isinstance(stored, dict) else None
    if share is None:
        raise journal.damaged("masks")
    return share


def _lines(request: CaptureRequest, frames: PickedFrames, outcome: Outcome) -> list[str]:
    left_out = f" ({frames.blurred} blurred, {frames.alike} alike)" if frames.blurred or frames.alike else ""
    missing = [] if frames.incomplete is None else [f"note: {request.source}: {frames.incomplete.describe()}"]
    missing += photographs_left_out(request.source) if request.source.is_dir() else []
    return [
        f"{outcome.picked} of {frames.seen} frames picked{left_out}, {frames.size[0]} x {frames.size[1]}; "
        f"{100 * outcome.masked:.0f} % of their pixels move; {outcome.links.features} features a frame",
        *missing,
    ]


def _draw_sheet(
    path: Path, frames: PickedFrames, frame_files: FrameFiles, solved: mapping.CameraSolution | None, video: bool
) -> None:
    def load(k: int) -> tuple[np.ndarray, np.ndarray | None]:
        mask = None if frame_files.masks is None else read_rgb(frame_files.masks / frame_files.names[k])[..., 0] < 128
        return read_rgb(frame_files.folder / frame_files.names[k]), mask

    captions = [f"{k}: {second:.2f} s" if video else f"{k}" for k, second in enumerate(frames.seconds)]
    pictures.sheet(path, load, captions, set(solved.places if solved else ()))


def _write(
    folder: Path, frames: PickedFrames, frame_files: FrameFiles, solved: mapping.CameraSolution, keep: writing.Keep,
    show: ShowProgress,
) -> None:  # fmt: skip
    with show(len(solved.places), "undistorting") as bar:
        pinhole = writing.undistort(frame_files, solved, folder, bar.advance, keep)
    scene = writing.scene_of(frame_files, solved, pinhole, frames.seconds, frames.span)
    pictures.cameras(folder / CAMERAS, scene)
    writing.write_scene(folder, scene, keep)
