"""Stages of a capture: frames, masks, features, matches, cameras, undistorted images."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import UserError
from ..runtime.progress import ShowProgress, progress
from ..storage.json_files import as_number
from ..storage.png_files import write_png
from . import bundle_adjustment, features, mapping, moving, pictures, writing
from .colmap import remove_database
from .diagnosis import Outcome, notes, too_few, unseen_between, unseen_ends
from .features import FrameFiles
from .folder_content import photographs_left_out
from .given_masks import read_masks
from .journal import Journal, disk_errors
from .picked_frames import VIDEO_FRAMES, PickedFrames, pick_frames
from .request import MIN_FRAMES, CaptureRequest, check
from .source import Source, is_hidden, open_source, read_rgb

SHEET, CAMERAS = "contact_sheet.png", "cameras.png"


class CaptureResult(NamedTuple):
    """Result of a capture."""

    outcome: Outcome
    lines: list[str]
    """Description of the result, for the user."""
    made_before: bool
    """True if the folder was already complete."""


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
    given = [f"--{name}" for name in ("start", "end") if getattr(request, name) is not None]
    if given and not source.video:
        raise UserError(f"{given[0]}: is for a video, but {request.source} is a folder; give one of the images to use")
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
    frames = pick_frames(request, source, journal, show)
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
    if source.video:
        lines += _unseen(frames, solved)
    return CaptureResult(outcome, [*lines, *notes(outcome)], before)


def _unseen(frames: PickedFrames, solved: mapping.CameraSolution) -> list[str]:
    """Tell of the times of a film at which no frame has a camera."""
    places = set(solved.places)
    seconds = [second for place, second in enumerate(frames.seconds) if place in places]
    without = [second for place, second in enumerate(frames.seconds) if place not in places]
    return unseen_ends(seconds, frames.span) + unseen_between(seconds, without, frames.span)


def _enough(request: CaptureRequest, frames: PickedFrames) -> None:
    if len(frames.indices) >= MIN_FRAMES:
        return
    if frames.seen < MIN_FRAMES:
        if frames.incomplete is not None:
            raise UserError(f"{request.source}: only {frames.incomplete.describe()}")
        if frames.seen == 1 and request.source.is_file():
            raise UserError(f"{request.source}: is a single picture; give a film, or a folder of images")
        raise UserError(f"{request.source}: {frames.seen} frames are too few; film a few seconds, or give more images")
    raise UserError(
        f"{request.source}: {len(frames.indices)} of {frames.seen} frames are neither blurred nor alike "
        f"({frames.blurred} blurred, {frames.alike} alike); hold the camera more steadily and walk with it"
    )


def _masks(
    request: CaptureRequest, source: Source, frames: PickedFrames, journal: Journal, show: ShowProgress
) -> FrameFiles:
    """Write the masks, if requested."""
    folder, mask_folder = journal.work / "frames", journal.work / "masks"
    files = frames.files
    if request.masks == "none":
        journal.stage("masks", "none", dict, lambda: shutil.rmtree(mask_folder, ignore_errors=True))
        return FrameFiles(folder, files, None, frames.cut_out)
    path = Path(request.masks)

    def make() -> dict[str, Any]:
        mask_folder.mkdir(exist_ok=True)
        if request.masks == "auto":
            masks = moving.find_moving(lambda k: read_rgb(folder / files[k]), len(files))
        else:
            whole = read_masks(path, source, frames.indices, frames.names, frames.whole_size, frames.turns)
            masks = map(frames.bars.cut, whole)
        shares = []
        with show(len(files), "finding what moves" if request.masks == "auto" else "reading masks") as bar:
            for name, mask in zip(files, masks, strict=True):  # strict: masks are checked once the last one is read
                shares.append(mask.mean())
                if frames.cut_out:
                    mask = mask | is_hidden(folder / name)
                write_png(mask_folder / name, np.repeat(np.where(mask, 0, 255).astype(np.uint8)[..., None], 3, 2))
                bar.advance()
        return {"share": float(np.mean(shares))}

    kind = "auto" if request.masks == "auto" else open_source(path).digest(journal.earlier)
    journal.stage("masks", kind, make, lambda: shutil.rmtree(mask_folder, ignore_errors=True))
    return FrameFiles(folder, files, mask_folder, frames.cut_out)


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
    exhaustive = len(chosen) == count * (count - 1) // 2
    whole = frames.seen <= (request.frames or (VIDEO_FRAMES if source.video else frames.seen))
    links = features.links(database, frame_files)
    return Outcome(count, registered, arc, links, masked, exhaustive, whole, source.video), solved


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
    turned = sum(turns > 0 for turns in frames.turns)
    missing += [f"note: {turned} images are turned by a quarter, so that all have one lens"] if turned else []
    missing += ["note: black bars beside the pictures are cut off"] if any(frames.bars) else []
    missing += ["frames are cut out by alpha; what it hides is left out"] if frames.cut_out else []
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
    scene = writing.scene_of(frame_files, solved, pinhole, frames.seconds, frames.span, frames.turns)
    pictures.cameras(folder / CAMERAS, scene)
    writing.write_scene(folder, scene, keep)
