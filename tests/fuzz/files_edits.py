"""Edit files, journals and markers of interrupted work, films to capture."""

from __future__ import annotations

import functools
import json
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from fuzz.files_cases import Format, check_gaussians, check_numbers, expect, finite, named, within
from helpers.edit_scenes import bar_scene
from scgs_warp.capture import CaptureRequest, picked_frames, pipeline
from scgs_warp.capture.journal import Journal
from scgs_warp.capture.rig.instants import recorded
from scgs_warp.capture.rig.sound import MAX_SECONDS as MAX_SOUND
from scgs_warp.capture.rig.sound import RATE, read_sound
from scgs_warp.capture.rig.synchronisation import synchronise
from scgs_warp.capture.source import open_source
from scgs_warp.data.synthetic import builtin, from_mesh
from scgs_warp.data.synthetic.films.encoding import write_film
from scgs_warp.data.synthetic.films.sound import SAMPLE_RATE
from scgs_warp.edit import EditSession
from scgs_warp.edit.filming import film_camera
from scgs_warp.export.captions import read_captions
from scgs_warp.scene.scene import Scene
from scgs_warp.storage.png_files import write_png
from scgs_warp.visualization.video import film

EDIT = {
    "format": "scgs-warp edit", "version": 2, "comment": "all there is",
    "scene": {"control_points": 20},
    "handles": [
        {"name": "tip", "nodes": {"point": [1.0, -1.0, 0.25], "rings": 1}, "time": 0.0, "pivot": [0.9, -1.0, 0.25]},
        {"name": "end", "nodes": [0, 1, 2], "time": 0.5, "lasts": "frame", "window": 0.2, "stiffness": 2.0,
         "turns": True},
    ],
    "pins": {"beyond": 2},
    "targets": {"tip": {"translation": [0.1, 0.0, 0.2]}},
    "keyframes": [
        {"at": 0.0, "easing": "ease", "targets": {"tip": {}}},
        {"at": 0.5, "targets": {"tip": {"axis": [0, 1, 0], "degrees": 60}, "end": {"rotation": [1, 0.1, 0, 0]}}},
        {"at": 1.0, "easing": "step", "targets": {"tip": {"translation": [0, 0, 0.3]}}},
    ],
    "playback": {"seconds": 1.5, "speed": -1.0, "start": 0.2, "repeat": "swing", "map": [[0, 0.1], [1, 0.9]]},
    "hold": [{"nodes": {"sphere": [0.0, -1.0, 0.25], "radius": 0.3, "time": 0.1}, "time": 0.2, "frame": "world",
              "rings": 1}],
    "exaggerate": {"factor": 1.5, "about": 0.3, "nodes": {"box": [[0, -2, -2], [2, 2, 2]]}},
    "film": {
        "seconds": 1.0, "fps": 8, "size": 64, "background": [1, 1, 1],
        "shot": {"kind": "orbit", "up": [0, 0, 1], "fov": 50, "turns": 0.5, "views": [
            {"at": 0, "azimuth": 230, "elevation": 10, "distance": 3.2, "target": [0, 0, 0]},
            {"at": 0.9, "azimuth": 310}]},
    },
}  # fmt: skip


@functools.cache
def scene() -> Scene:
    return bar_scene(nodes=20, gaussians=60)


def write_edit(folder: Path) -> None:
    EditSession(scene())
    folder.mkdir()
    (folder / "edit.json").write_text(json.dumps(EDIT))


def load_edit(folder: Path) -> None:
    """Read, save again, pose and place the camera, as ``apps/edit.py --script`` does."""
    session = EditSession(scene())
    session.load(folder / "edit.json")
    check_numbers(session.edit, "edit", 1e9)
    expect(1 <= session.edit.film.frames <= 4_000_000, f"{session.edit.film.frames} frames")
    session.save(folder / ".saved.json")
    (folder / ".saved.json").unlink()
    for at in (0.0, 0.4, 0.9):
        time = session.scene_time(at)
        within("time", time)
        check_gaussians(session.gaussians_at(time, at))
        finite("control points", session.node_positions(time, at))
        camera = film_camera(session, at, 32)
        finite("camera", camera.viewmat, camera.K)


def silent(total: int, text: str) -> Any:
    return nullcontext(SimpleNamespace(advance=lambda count=1: None))


def _result() -> dict[str, Any]:
    return picked_frames.PickedFrames(
        [0, 3, 5], [0.0, 0.3, 0.5], ["a", "b", "c"], (0.0, 1.0), (64, 48), 9, 1, 1
    )._asdict()


def write_journal(folder: Path) -> None:
    journal = Journal(folder, lambda earlier: "a film")
    settings = dict.fromkeys(("frames", "start", "end"), None) | {"size": 1280}
    with journal.started():
        journal.stage("frames", settings, _result, lambda: None)
        journal.stage("masks", "auto", lambda: {"share": 0.2}, lambda: None)
        journal.stage("cameras", 0, lambda: 3, lambda: None)


def load_journal(folder: Path) -> None:
    """Resume as ``apps/capture.py`` does, which makes unusable files again."""
    journal = Journal(folder, lambda earlier: "a film")
    with journal.started():
        _resume(journal)


def _resume(journal: Journal) -> None:
    source = SimpleNamespace(count=9, video=True, path=Path("film.mp4"))
    before, picked_frames.choose = picked_frames.choose, lambda *_: (_ for _ in ()).throw(_Again)  # type: ignore[assignment]
    try:
        frames = picked_frames.pick_frames(CaptureRequest(Path("film.mp4")), source, journal, silent)  # type: ignore[arg-type]
        check_numbers(frames._asdict(), "frames")
        expect(len(frames.indices) == len(frames.seconds), "frames without a time")
        expect(all(name.endswith(".png") for name in frames.files), "names")
    except _Again:
        return
    finally:
        picked_frames.choose = before
    journal.stage("masks", "auto", lambda: {"share": 0.0}, lambda: None)
    within("share", pipeline._share(journal), -1e300, 1e300)


class _Again(Exception):
    """Run the stage again."""


MARKERS = (from_mesh, builtin)


def write_markers(folder: Path) -> None:
    folder.mkdir()
    for module in MARKERS:
        (folder / module.MARKER).write_text(json.dumps({"version": 1, "size": 400, "seed": 0, "list": [1, {"a": 2}]}))


def load_markers(folder: Path) -> None:
    for module in MARKERS:
        found = module._recipe_of(folder)
        expect(found is None or found is not NotImplemented, "marker")


def write_video(folder: Path) -> None:
    folder.mkdir()
    random = np.random.default_rng(0)
    with film(folder / "film.mp4", 10) as frames:
        for _ in range(8):
            frames.write(random.integers(0, 256, (48, 64, 3), np.uint8))


def write_folder(folder: Path) -> None:
    folder.mkdir()
    random = np.random.default_rng(0)
    for index in range(3):
        write_png(folder / f"{index}.png", random.integers(0, 256, (24, 32, 3), np.uint8))


def load_source(folder: Path) -> None:
    """Open a film as ``apps/capture.py`` does."""
    videos = sorted(folder.glob("*.mp4"))
    source = open_source(videos[0] if videos else folder)
    for still in source.frames(640):
        expect(still.image.dtype == np.uint8 and still.image.ndim == 3 and still.image.size > 0, "image")
        finite("seconds", still.seconds)
    expect(bool(source.digest()), "digest")


CAPTIONS = """WEBVTT Title

NOTE none

1
00:00.500 --> 00:01.250 align:start
Hello <b>there</b> &amp; here

01:00:00.000 --> 01:00:02.000
second
line
"""


def write_captions(folder: Path) -> None:
    folder.mkdir()
    (folder / "film.vtt").write_text(CAPTIONS)


def load_captions(folder: Path) -> None:
    for cue in read_captions(folder / "film.vtt"):
        finite("cue", cue["from"], cue["to"])
        expect(cue["to"] > cue["from"] >= 0.0 and bool(cue["text"].strip()), "cue")


def write_sounding(folder: Path) -> None:
    """A film with two seconds of sound, of 30 small pictures."""
    folder.mkdir()
    random = np.random.default_rng(0)
    pictures = [random.integers(0, 256, (48, 64, 3), np.uint8) for _ in range(30)]
    write_film(folder / "cam0.mp4", pictures, 15.0, 40, random.normal(0, 0.1, 2 * SAMPLE_RATE).astype(np.float32))


def load_sounding(folder: Path) -> None:
    """Read sound and moments as ``apps/capture.py --rig`` does."""
    seconds = recorded(folder / "cam0.mp4").seconds
    finite("moments", seconds)
    expect(seconds.ndim == 1 and len(seconds) > 0 and bool((np.diff(seconds) >= 0).all()), "moments ascend")
    sound = read_sound(folder / "cam0.mp4")
    if sound is not None:
        finite("sound", sound.samples, sound.start)
        expect(sound.samples.ndim == 1 and len(sound.samples) < 10 * MAX_SOUND * RATE, "length of the sound")
        starts = synchronise([sound, sound]).starts
        expect(bool(np.isnan(starts).all() or np.isfinite(starts).all()), "starts")


FORMATS = (
    Format("captions", write_captions, load_captions, share=0.5),
    Format("edit", write_edit, load_edit, share=2.5),
    Format("journal", write_journal, load_journal, named(("work/journal.json",))),
    Format("marker", write_markers, load_markers, share=0.3),
    Format("film", write_video, load_source, share=0.7),
    Format("images", write_folder, load_source, share=0.7),
    Format("sound", write_sounding, load_sounding, share=0.5),
)
