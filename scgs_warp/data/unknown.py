"""Messages about a path that holds no data set: what it is instead, and what to do with it."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

from ..errors import UserError, shell_words
from ..storage.files import open_regular
from .images import INSPECTED
from .readers.transforms import IMAGE_SUFFIXES

FILMS = (
    *(".mp4", ".mov", ".m4v", ".qt", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".vob", ".mod", ".tod"),
    *(".ts", ".m2t", ".mts", ".m2ts", ".mxf", ".dv", ".3gp", ".3g2", ".wmv", ".asf", ".flv", ".ogv"),
)
VIDEOS = (*FILMS, ".gif")
ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar", ".zst")
SPLATS = (".ply", ".splat", ".spz", ".sog", ".ksplat")
PACKED = (".smc", ".h5", ".hdf5")
MAPS = re.compile("(?:^|[/_-])(?:depth|mask|flow|disp|normal|seg|annotation|alpha|conf|matte)", re.IGNORECASE)
"""What is in the names of folders of images that no camera took."""
DEEPEST, MOST_FOLDERS = 3, 200
"""Depth to which, and number of folders in which, a data set is looked for."""
FEWEST_PHOTOS = 3
RECORD3D = (("metadata.json", "rgb"), ("metadata", "rgbd"))
"""Files and folders by which an export of Record3D is recognised."""
FOREIGN = (
    (("annots.npy",), "the cameras of ZJU-MoCap are a pickle, which can run programs", "EasyMocap", ""),
    (("rgb.txt", "rgb"), "the poses of TUM RGB-D are not read", "", "{folder}/rgb"),
    (("color", "pose"), "the poses of ScanNet are not read", "", "{folder}/color"),
    (("models.json",), "the cameras of Google's Immersive are not read", "", "--rig {folder}"),
    (("camera.pkl",), "the cameras of People-Snapshot are a pickle, which can run programs", "nerfstudio", ""),
    (("all_data.json",), "the cameras of PAC-NeRF are not read", "nerfstudio", ""),
    (("cameras_sphere.npz",), "the cameras of NeuS are not read", "nerfstudio", ""),
    (("KRT",), "the cameras of Multiface are not read", "EasyMocap", ""),
    (
        ("ego_pose", "extrinsics"),
        "the cameras of Waymo, as EmerNeRF and others write them, are not read",
        "nerfstudio",
        "",
    ),
    (("traj.txt", "results"), "the cameras of Replica are not read", "nerfstudio", ""),
    (("frame-000000.pose.txt",), "the cameras of 7-Scenes are not read", "nerfstudio", ""),
)
"""Data sets that are not read: their files and folders, what is to be said, and the layout in which the cameras may be
written, or what ``capture`` is to be given, which finds them anew."""
RENAMED = (
    ("transform*.json", "transforms.json", "frames and poses"),
    ("poses_bounds*.npy", "poses_bounds.npy", "the cameras of LLFF, as RoDynRF writes them"),
)
"""Files that programs name otherwise than they are read, their right name, and what they hold."""
SIGNS = (
    (b"<chunk", "Metashape", "ns-process-data metashape"),
    (b"#name,", "RealityCapture", "ns-process-data realitycapture"),
    (b"# Bundle file", "Bundler", "colmap model_converter"),
)
"""What the files of programs' cameras begin with, the programs, and what makes a layout of them that is read."""


def not_a_folder(path: Path) -> UserError:
    """Return the error for a path that is no folder."""
    suffix = path.suffix.lower()
    if not path.exists():
        parent = path.parent
        others = [entry.name for entry in parent.iterdir() if entry.is_dir()] if parent.is_dir() else []
        near = difflib.get_close_matches(path.name, others, 1)
        hint = f"; did you mean {parent / near[0]}?" if near else ""
        return UserError(
            f"{path}: no such folder{hint or '; give the folder of a data set (docs/data.md lists the layouts)'}"
        )
    if suffix in VIDEOS:
        return UserError(
            f"{path}: a video has no cameras yet; find them with: scgs-warp capture {shell_words(path)} --output "
            f"{shell_words(f'data/{path.stem}')}"
        )
    if suffix == ".r3d":
        return UserError(
            f"{path}: a recording of Record3D; import it with: scgs-warp capture --poses {shell_words(path)} --output "
            f"{shell_words(f'data/{path.stem}')}"
        )
    if suffix in ARCHIVES:
        return UserError(f"{path}: is an archive; unpack it and give the folder that it makes")
    if suffix in SPLATS:
        return UserError(
            f"{path}: holds Gaussians or points, not images; to see a file of Gaussians: scgs-warp view --ply "
            f"{shell_words(path)} "
            "--output film.mp4"
        )
    if suffix == ".npz":
        return UserError(
            f"{path}: is no folder; if it holds the cameras of MegaSaM, VGGT, MapAnything, Depth Anything 3, "
            f"SpatialTrackerV2 or Pi3: scgs-warp capture --poses {shell_words(path)} --output "
            f"{shell_words(f'data/{path.stem}')}"
        )
    if suffix in PACKED:
        return UserError(
            f"{path}: images and cameras in HDF5, as those of DNA-Rendering, are not read; unpack them with the tools "
            "of their data set, and write them in the layout of EasyMocap (docs/data.md)"
        )
    if suffix == ".json" or path.name == "poses_bounds.npy":
        return UserError(f"{path}: is a file of a data set; give its folder: --data {shell_words(path.parent)}")
    if suffix in IMAGE_SUFFIXES:
        return UserError(f"{path}: is one image; give the folder of a data set (docs/data.md lists the layouts)")
    return UserError(f"{path}: is a file; give the folder of a data set (docs/data.md lists the layouts)")


def no_layout(folder: Path, recognised: Callable[[Path], bool]) -> UserError:
    """Return the error for a folder without a known layout.

    Args:
        recognised: whether a folder holds a layout that can be read.
    """
    if (folder / "checkpoint.safetensors").is_file():
        return UserError(
            f"{folder}: is the folder of a run, which view and evaluate take as --run; --data takes a folder of images "
            "with cameras"
        )
    entries = sorted(folder.iterdir())
    if not entries:
        return UserError(f"{folder}: is empty; give the folder of a data set (docs/data.md lists the layouts)")
    for inner in _below(folder):
        if recognised(inner):
            return UserError(f"{folder}: the data set is in a folder below; give --data {shell_words(inner)}")
    above = next((outer for outer in list(folder.parents)[:2] if recognised(outer)), None)
    if above is not None:
        return UserError(f"{folder}: is a part of a data set; give its folder: --data {shell_words(above)}")
    program = _exported_by(folder)
    if program is not None:
        return UserError(
            f"{folder}: is an export of {program}; make a data set of it: scgs-warp capture --poses "
            f"{shell_words(folder)} --output {shell_words(f'data/{folder.resolve().name}')}"
        )
    foreign = next(filter(None, map(_foreign, (folder, *_below(folder)))), None) or _of_program(entries)
    if foreign is not None:
        return UserError(foreign)
    renamed = _renamed(entries)
    if renamed is not None:
        return UserError(renamed)
    if sum(entry.suffix.lower() in IMAGE_SUFFIXES for entry in entries) >= FEWEST_PHOTOS:
        return UserError(
            f"{folder}: holds images without cameras; find them with: scgs-warp capture {shell_words(folder)} --output "
            f"{shell_words(f'data/{folder.resolve().name}-cameras')}"
        )
    film = next((entry for entry in entries if entry.suffix.lower() in (*VIDEOS, *PACKED)), None)
    if film is not None:
        return not_a_folder(film)
    photos = _photos_below(folder)
    if photos is not None:
        return UserError(
            f"{folder}: its cameras are in no layout that is read (docs/data.md lists them); write them as "
            f"transforms.json of nerfstudio, or find those of {photos.name} anew: scgs-warp capture "
            f"{shell_words(photos)} --output {shell_words(f'data/{folder.resolve().name}')}"
        )
    return UserError(
        f"{folder}: holds no known layout: no transforms_train.json (D-NeRF, Blender), transforms.json (nerfstudio), "
        "dataset.json (HyperNeRF, NeRF-DS, DyCheck), train_meta.json (Panoptic), poses_bounds.npy (Neural 3D Video), "
        "intri.yml (EasyMocap), calibration.csv (ActorsHQ) or sparse/0 (COLMAP); give the folder that holds one of "
        "these"
    )


def _renamed(entries: list[Path]) -> str | None:
    """Return the message about a file of cameras that has another name than the one that is read; None without one."""
    for pattern, name, what in RENAMED:
        for entry in entries:
            if entry.match(pattern) and entry.is_file():
                return f"{entry}: is read under another name; call it {name} if it lists {what}"
    return None


def _foreign(folder: Path) -> str | None:
    """Return the message about data sets that are not read; None for other folders."""
    for names, what, layout, given in FOREIGN:
        if all((folder / name).exists() for name in names):
            remedy = f"write them in the layout of {layout} (docs/data.md)"
            if given:
                output = shell_words(f"data/{folder.resolve().name}")
                remedy = f"find them: scgs-warp capture {given.format(folder=shell_words(folder))} --output {output}"
            return f"{folder / names[0]}: {what}; {remedy}"
    return None


def _of_program(entries: list[Path]) -> str | None:
    """Return the message about cameras of other programs that are not read; None if there are none."""
    for entry in entries:
        if entry.suffix.lower() in (".xml", ".csv", ".out") and entry.is_file():
            try:
                with open_regular(entry) as file:
                    start = file.read(INSPECTED)
            except OSError:
                continue
            for sign, program, command in SIGNS:
                if sign in start:
                    return (
                        f"{entry}: cameras of {program} are not read; export them from there for COLMAP, or convert "
                        f"them: {command}"
                    )
    return None


def _exported_by(folder: Path) -> str | None:
    """Name the program whose export ``capture --poses`` reads; None for other folders."""
    if any(folder.glob("keyframes/*cameras")):
        return "Polycam"
    for base in (folder, folder / "EXR_RGBD"):
        if any((base / file).is_file() and (base / images).is_dir() for file, images in RECORD3D):
            return "Record3D"
    if any(folder.glob("frame_[0-9]*.json")):
        return "3D Scanner App"
    if (folder / "odometry.csv").is_file() and (folder / "rgb.mp4").is_file():
        return "Stray Scanner"
    if (folder / "color").is_dir() and any((folder / "camera").glob("*.npz")):
        return "CUT3R"
    if any((folder / "pose").glob("*.npz")) and any((folder / "rgb").glob("*.mp4")):
        return "ViPE"
    if (folder / "camera_poses.txt").is_file() and (folder / "results_output").is_dir():
        return "DA3-Streaming"
    if (folder / "0000.npz").is_file():
        return "Uni4D"
    return "MonST3R" if (folder / "pred_traj.txt").is_file() else None


def _photos_below(folder: Path) -> Path | None:
    """Return the folder below with the most photographs; None if none holds ``FEWEST_PHOTOS``."""
    counts: dict[Path, int] = {}
    for inner in _below(folder):
        if MAPS.search(inner.relative_to(folder).as_posix()) is None:
            try:
                counts[inner] = sum(name.lower().endswith(IMAGE_SUFFIXES) for name in os.listdir(inner))
            except OSError:
                continue
    most = max(counts, key=lambda inner: counts[inner], default=None)
    return most if most is not None and counts[most] >= FEWEST_PHOTOS else None


def _below(folder: Path) -> Iterator[Path]:
    """Yield the folders below ``folder``, the nearest first, up to ``DEEPEST`` and ``MOST_FOLDERS``."""
    level, seen = [folder], 0
    for _ in range(DEEPEST):
        found: list[Path] = []
        for outer in level:
            try:
                found += sorted(Path(entry.path) for entry in os.scandir(outer) if entry.is_dir(follow_symlinks=False))
            except OSError:
                continue
        for inner in found:
            seen += 1
            if seen > MOST_FOLDERS:
                return
            yield inner
        level = found
