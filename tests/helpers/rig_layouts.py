"""The dots of ``layouts`` seen by the cameras of a rig, as programs and data sets for multi-view video lay them out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from helpers.layouts import COLORS, HEIGHT, POINTS, WIDTH, K, dots, save_image, viewmat
from helpers.warped import landing
from scgs_warp.data.points import write_points

STEP = 0.4
CAMERAS, INSTANTS = 4, 3
BENT = np.array([-0.2, 0.05, 0.003, -0.004, 0.01, 0.0, 0.0, 0.0])
"""Distortion of EasyMocap's cameras: k1, k2, p1, p2, k3."""


def write_model(folder: Path, name: Callable[[int], str]) -> None:
    """A COLMAP model of one image of each camera, which has a camera of its own."""
    import pycolmap

    model = pycolmap.Reconstruction()
    for point, color in zip(POINTS, COLORS):
        model.add_point3D(point, pycolmap.Track(), color)
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    for index in range(CAMERAS):
        camera = pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=params, camera_id=index + 1)
        model.add_camera_with_trivial_rig(camera)
    for index in range(CAMERAS):
        view = viewmat(index, STEP)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(view[:3, :3]), view[:3, 3])
        image = pycolmap.Image(name=name(index), camera_id=index + 1, image_id=index + 1)
        model.add_image_with_trivial_frame(image, pose)
    folder.mkdir(parents=True)
    model.write_binary(str(folder))


def write_multipleview(folder: Path) -> None:
    """4DGaussians."""
    write_model(folder / "sparse_", lambda index: f"image{index + 1}.jpg")
    for camera in range(CAMERAS):
        for instant in range(INSTANTS):
            _save(folder / f"cam{camera + 1:02d}/frame_{instant + 1:05d}.jpg", dots(viewmat(camera, STEP)))
    write_points(folder / "points3D_multipleview.ply", POINTS, COLORS)
    np.save(folder / "poses_bounds_multipleview.npy", np.zeros((CAMERAS, 17)))


def write_instants(folder: Path, name: str = "colmap_{}") -> None:
    """SpacetimeGaussians, or 3DGStream with ``name`` ``frame{:06d}``: a model and images for each instant."""
    for instant in range(INSTANTS):
        place = folder / name.format(9 + instant)
        write_model(place / "sparse/0", lambda index: f"cam{index:02d}.png")
        for camera in range(CAMERAS):
            save_image(place / f"images/cam{camera:02d}.png", dots(viewmat(camera, STEP)))
            save_image(place / f"input/cam{camera:02d}.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))


def write_easymocap(folder: Path, own: bool = True, rotations: bool = True) -> None:
    """EasyMocap, with ends of lines and digits as its program writes them.

    Args:
        own: whether the writer is EasyMocap's own, or OpenCV's, which wraps lines.
        rotations: whether matrices stand beside the axes of rotation.
    """
    names = [f"{camera:02d}" for camera in range(CAMERAS)]
    inner, outer = {}, {}
    for camera, name in enumerate(names):
        view = viewmat(camera, STEP)
        inner |= {f"K_{name}": K, f"dist_{name}": BENT[None, :5]}
        outer |= {f"R_{name}": cv2.Rodrigues(view[:3, :3])[0]}
        outer |= {f"Rot_{name}": view[:3, :3]} if rotations else {}
        outer |= {f"T_{name}": view[:3, 3:]}
        for instant in range(INSTANTS):
            image = dots(view, lens=lambda rays: landing(rays, K, BENT))
            _save(folder / f"images/{name}/{instant:06d}.jpg", image)
            save_image(folder / f"masks/{name}/{instant:06d}.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    for file, fields in (("intri.yml", inner), ("extri.yml", outer)):
        (_write_yaml if own else _write_by_opencv)(folder / file, names, fields)


def _write_yaml(path: Path, names: list[str], fields: dict[str, np.ndarray]) -> None:
    lines = ["%YAML:1.0", "---", "names:", *(f'  - "{name}"' for name in names)]
    for key, values in fields.items():
        data = ", ".join(f"{value:.6f}" for value in values.ravel())
        lines += [f"{key}: !!opencv-matrix", f"  rows: {values.shape[0]}", f"  cols: {values.shape[1]}"]
        lines += ["  dt: d", f"  data: [{data}]"]
    path.write_bytes("".join(f"{line}\r\n" for line in lines).encode())


def _write_by_opencv(path: Path, names: list[str], fields: dict[str, np.ndarray]) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.startWriteStruct("names", cv2.FILE_NODE_SEQ)
    for name in names:
        storage.write("", name)
    storage.endWriteStruct()
    for key, values in fields.items():
        storage.write(key, np.ascontiguousarray(values))
    for name in names:
        storage.write(f"H_{name}", HEIGHT)
        storage.write(f"W_{name}", float(WIDTH))
    storage.release()


def write_actors_hq(folder: Path) -> None:
    """ActorsHQ; of the cameras, HumanRF holds out the second."""
    rows = ["name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py"]
    for camera in range(CAMERAS):
        pose, name = np.linalg.inv(viewmat(camera, STEP)), f"Cam{camera + 13:03d}"
        numbers = [WIDTH, HEIGHT, *cv2.Rodrigues(pose[:3, :3])[0].ravel(), *pose[:3, 3]]
        numbers += [K[0, 0] / WIDTH, K[1, 1] / HEIGHT, K[0, 2] / WIDTH, K[1, 2] / HEIGHT]
        rows.append(",".join([name, *(str(number) for number in numbers)]))
        for instant in range(INSTANTS):
            _save(folder / f"rgbs/{name}/{name}_rgb{instant + 15:06d}.jpg", dots(viewmat(camera, STEP)))
            mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
            save_image(folder / f"masks/{name}/{name}_mask{instant + 15:06d}.png", mask)
    (folder / "calibration.csv").write_text("\r\n".join(rows) + "\r\n", newline="")


def _save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 100])
