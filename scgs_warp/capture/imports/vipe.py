"""Results of ViPE, which finds the cameras and the depth of films.

``rgb/NAME.mp4``; ``pose/NAME.npz`` with ``data [N, 4, 4]``, camera-to-world, and ``inds [N]``, numbers of frames;
``intrinsics/NAME.npz`` with ``data [N, 4]`` (fx, fy, cx, cy), and ``inds``; ``intrinsics/NAME_camera.txt``, a line
``0: PINHOLE`` for each frame; ``depth/NAME.zip`` with ``00000.exr``, channel Z. Cameras are OpenCV's.
Layout: Huang et al., ViPE, 2025.
"""

from __future__ import annotations

import tempfile
import zipfile
import zlib
from functools import partial
from pathlib import Path

import numpy as np

from ...errors import UserError
from ...storage.exr_files import INSTALL, read_exr, reads_exr
from ...storage.files import read_text
from ...storage.numpy_files import read_npy
from ..source import Video
from .film_pictures import MOST_FRAMES, FilmPictures
from .monst3r import MAX_TEXT_BYTES
from .scene import ImportedFrame, ImportedScene, intrinsics, rigid

LENS = "PINHOLE"
MAX_MAP_BYTES = 1 << 27
"""Largest size of a depth map's file."""


def recognises(path: Path) -> bool:
    """Return whether the path is a folder of results, or a film, the poses or the intrinsics in one."""
    return bool(_names(path))


def _names(path: Path) -> list[tuple[Path, str]]:
    """Return the folder of results and the name of each film that ``path`` stands for."""
    if path.is_file():
        folder, names = path.parent.parent, [path.stem] if path.parent.name in ("rgb", "pose", "intrinsics") else []
    else:
        folder, names = path, sorted(file.stem for file in (path / "pose").glob("*.npz"))
    return [
        (folder, name)
        for name in names
        if (folder / f"rgb/{name}.mp4").is_file() and (folder / f"intrinsics/{name}.npz").is_file()
    ]


def read(path: Path) -> ImportedScene:
    """Read a result; of more than ``MOST_FRAMES`` frames, every second, third or so is taken.

    Raises:
        UserError: there are several films, or a file is missing, damaged or does not fit; one line names it.
    """
    found = _names(path)
    if len(found) > 1:
        raise UserError(
            f"--poses {path}: holds {len(found)} films of ViPE; give one of them, such as {path}/rgb/{found[0][1]}.mp4"
        )
    folder, name = found[0]
    film, pose_file, lens_file = (
        folder / kind for kind in (f"rgb/{name}.mp4", f"pose/{name}.npz", f"intrinsics/{name}.npz")
    )
    _check_lens(folder / f"intrinsics/{name}_camera.txt")
    poses, lenses = _by_number(pose_file, 16), _by_number(lens_file, 4)
    video = Video(film)
    posed = sorted(number for number in poses if number in lenses)
    filmed = [number for number in posed if number < video.count]
    taken = filmed[:: -(-max(len(filmed), 1) // MOST_FRAMES)]
    pictures, maps = FilmPictures(video, taken), _maps(folder / f"depth/{name}.zip") if reads_exr() else {}
    frames = []
    for number in taken:
        pose = rigid(poses[number].reshape(4, 4), f"{pose_file}: data of frame {number}")
        fx, fy, cx, cy = lenses[number]
        K = intrinsics(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), f"{lens_file}: data of frame {number}")
        depth = partial(_depth, folder / f"depth/{name}.zip", maps[number]) if number in maps else None
        picture = partial(pictures.at, number)
        frames.append(ImportedFrame(picture, np.linalg.inv(pose), K, float(number), depth))
    notes = [f"{len(taken)} of {len(filmed)} frames are taken"] if len(taken) < len(filmed) else []
    if len(filmed) < video.count:
        notes.append(
            f"{video.count - len(filmed)} of {video.count} frames have no pose or intrinsics, and are left out"
        )
    if not reads_exr() and (folder / f"depth/{name}.zip").is_file():
        notes.append(f"depth was not read: {INSTALL}")
    return ImportedScene("ViPE", frames, gravity=False, note="; ".join(notes) or None)


def _by_number(path: Path, count: int) -> dict[int, np.ndarray]:
    """Read the ``count`` numbers of each frame, by the frame's number."""
    data, numbers = read_npy(path, "data"), read_npy(path, "inds")
    good = data.ndim > 1 and data.size == count * len(data) and numbers.shape == (len(data),)
    if not good or not ((numbers >= 0) & (numbers < 1e9)).all():
        raise UserError(
            f"{path}: data is {list(data.shape)} and inds {list(numbers.shape)}, not {count} numbers for each of the "
            "frames; run ViPE again, for a pinhole camera"
        )
    return {int(number): row for number, row in zip(numbers, data.reshape(len(numbers), count))}


def _check_lens(path: Path) -> None:
    """Refuse panoramas and wide lenses, whose images no pinhole camera shows."""
    if not path.is_file():
        return
    try:
        lines = [line for line in read_text(path, MAX_TEXT_BYTES).splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError):
        raise UserError(f"{path}: cannot be read as text; run ViPE again") from None
    other = next((line for line in lines if line.partition(":")[2].strip() != LENS), None)
    if other is not None:
        raise UserError(
            f"{path}: has the camera {other.partition(':')[2].strip()[:40]!r}, and only {LENS} is read; run ViPE's "
            "default pipeline"
        )


def _maps(path: Path) -> dict[int, str]:
    """Return the names of the depth maps in an archive by the numbers of their frames; none without the archive."""
    if not path.is_file():
        return {}
    try:
        with zipfile.ZipFile(path) as archive:
            stems = [name.removesuffix(".exr") for name in archive.namelist() if name.endswith(".exr")]
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError):
        raise UserError(f"{path}: is no zip archive, or a damaged one; run ViPE again") from None
    return {int(stem): f"{stem}.exr" for stem in stems if stem.isascii() and stem.isdigit() and len(stem) < 10}


def _depth(path: Path, name: str) -> np.ndarray:
    """Read the depth [h, w] of a frame; ViPE itself skips maps that do not decode."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open(name) as member:
            content = member.read(MAX_MAP_BYTES + 1)
    except (OSError, zipfile.BadZipFile, zlib.error, EOFError, KeyError, NotImplementedError, RuntimeError):
        raise UserError(f"{path}: {name} is damaged; run ViPE again") from None
    if len(content) > MAX_MAP_BYTES:
        raise UserError(f"{path}: {name} is larger than {MAX_MAP_BYTES >> 20} MiB; run ViPE again")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        file.write_bytes(content)
        try:
            return read_exr(file)
        except UserError as error:
            raise UserError(str(error).replace(folder, str(path))) from None
