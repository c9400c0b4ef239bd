"""The same small scene in every layout that is read: dots in space, each painted where its camera should see it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from helpers.scenes import look_at
from helpers.warped import landing
from scgs_warp.data import Dataset

WIDTH, HEIGHT, FOCAL = 80, 60, 90.0
K = np.array([[FOCAL, 0.0, 38.0], [0.0, FOCAL + 4, 31.0], [0.0, 0.0, 1.0]])
CENTRED = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
POINTS = np.random.default_rng(3).uniform(-0.8, 0.8, (24, 3))
COLORS = np.random.default_rng(4).integers(60, 256, (24, 3)).astype(np.uint8)
PINHOLE = np.zeros(8)


def viewmat(index: int, step: float = 0.1) -> np.ndarray:
    """[4, 4] world-to-camera, OpenCV, on an arc around the dots."""
    angle = step * index
    eye = torch.tensor([4 * np.cos(angle), 4 * np.sin(angle), 1.0 + 0.3 * np.sin(index)], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return look_at(eye, torch.zeros(3, dtype=torch.float64), up).numpy()


def dots(
    view: np.ndarray,
    intrinsics: np.ndarray = K,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    lens: Callable[[np.ndarray], np.ndarray] | None = None,
) -> np.ndarray:
    """[H, W, 3] uint8 BGR: a 5 x 5 dot for each point, nearest on top. ``lens``: rays [N, 2] to pixels [N, 2]."""
    image = np.full((size[1], size[0], 3), 30, np.uint8)
    local = POINTS @ view[:3, :3].T + view[:3, 3]
    rays = local[:, :2] / local[:, 2:]
    pixels = landing(rays, intrinsics, PINHOLE) if lens is None else lens(rays)
    for index in np.argsort(-local[:, 2]):
        column, row = np.floor(pixels[index]).astype(int)
        image[max(row - 2, 0) : max(row + 3, 0), max(column - 2, 0) : max(column + 3, 0)] = COLORS[index][::-1]
    return image


def share_found(data: Dataset, tolerance: float = 1e-3) -> float:
    """Return the share of points whose pixel has their colour; some hide behind others."""
    found = []
    points, colors = torch.from_numpy(POINTS).float(), torch.from_numpy(COLORS / 255.0).float()
    for frame in data:
        camera = frame.camera
        pixels = (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T
        pixels = (pixels[:, :2] / pixels[:, 2:]).floor().long()
        inside = ((pixels >= 1) & (pixels < torch.tensor([camera.width - 1, camera.height - 1]))).all(1)
        columns, rows = pixels[inside].unbind(1)
        close = (frame.image[rows, columns] - colors[inside]).abs().amax(1) < tolerance
        found.append(close if frame.mask is None else close[frame.mask[rows, columns]])
    return float(torch.cat(found).float().mean())


def save_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def save_json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def write_nerfies(
    folder: Path,
    count: int = 12,
    radial: tuple[float, ...] = (0.0, 0.0, 0.0),
    tangential: tuple[float, float] = (0.0, 0.0),
    scale: float = 0.5,
) -> None:
    """HyperNeRF's rig: two cameras take turns in being held out."""
    lens = np.array([radial[0], radial[1], *tangential, radial[2], 0, 0, 0])
    names = [f"{index:06d}" for index in range(1, count + 1)]
    centre = np.array([0.5, -0.25, 0.125])
    for index, name in enumerate(names):
        view = viewmat(index)
        # The file's world is larger, and elsewhere: scene.json brings it to that of the dots.
        position = -view[:3, :3].T @ view[:3, 3] / scale + centre
        camera = {
            "orientation": view[:3, :3].tolist(),
            "position": position.tolist(),
            "focal_length": FOCAL,
            "principal_point": K[:2, 2].tolist(),
            "skew": 0.0,
            "pixel_aspect_ratio": K[1, 1] / FOCAL,
            "radial_distortion": list(radial),
            "tangential_distortion": list(tangential),
            "image_size": [WIDTH, HEIGHT],
        }
        save_json(folder / f"camera/{name}.json", camera)
        image = dots(view, lens=lambda rays: landing(rays, K, lens))
        save_image(folder / f"rgb/1x/{name}.png", image)
        save_image(
            folder / f"rgb/2x/{name}.png", cv2.resize(image, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA)
        )
    ids = {"ids": names, "train_ids": names[::2], "val_ids": names[1::2], "count": count, "num_exemplars": count // 2}
    save_json(folder / "dataset.json", ids)
    metadata = {n: {"warp_id": 100 + i, "appearance_id": i, "camera_id": i % 2} for i, n in enumerate(names)}
    save_json(folder / "metadata.json", metadata)
    save_json(folder / "scene.json", {"scale": scale, "center": centre.tolist(), "near": 0.1, "far": 9.0})
    np.save(folder / "points.npy", (POINTS / scale + centre).astype(np.float32))


def write_panoptic(folder: Path, instants: int = 5, cameras: int = 4) -> None:
    """Dynamic 3D Gaussians: all cameras but the last train, at every instant."""
    for name, chosen in (("train", range(cameras - 1)), ("test", [cameras - 1])):
        content: dict = {"w": WIDTH, "h": HEIGHT, "k": [], "w2c": [], "fn": [], "cam_id": []}
        for instant in range(instants):
            rows = {"k": [], "w2c": [], "fn": [], "cam_id": []}
            for camera in chosen:
                view = viewmat(camera, 0.5)
                rows["k"].append(K.tolist())
                rows["w2c"].append(view.tolist())
                rows["fn"].append(f"{camera}/{instant:06d}.jpg")
                rows["cam_id"].append(camera)
                path = folder / "ims" / rows["fn"][-1]
                path.parent.mkdir(parents=True, exist_ok=True)
                assert cv2.imwrite(str(path), dots(view), [cv2.IMWRITE_JPEG_QUALITY, 100])
            for key, row in rows.items():
                content[key].append(row)
        save_json(folder / f"{name}_meta.json", content)
    cloud = np.concatenate([POINTS, COLORS / 255.0, np.ones((len(POINTS), 1))], 1)
    np.savez(folder / "init_pt_cld.npz", data=cloud)


def write_poses_bounds(folder: Path, cameras: int = 4, instants: int = 3, inner: str = "images") -> None:
    """Neural 3D Video, unpacked to images."""
    rows = []
    for camera in range(cameras):
        view = viewmat(camera, 0.4)
        right, down, forward = view[:3, :3]
        position = -view[:3, :3].T @ view[:3, 3]
        pose = np.stack([down, right, -forward, position, [HEIGHT, WIDTH, FOCAL]], axis=1)
        rows.append(np.concatenate([pose.ravel(), [1.0, 9.0]]))
        for instant in range(instants):
            save_image(folder / f"cam{camera:02d}" / inner / f"{instant:04d}.png", dots(view, CENTRED))
    np.save(folder / "poses_bounds.npy", np.array(rows))


def colmap_lens(model: str) -> tuple[list[float], Callable[[np.ndarray], np.ndarray]]:
    """Parameters of a COLMAP model, slightly bent, and where its rays land: by OpenCV where OpenCV has the model."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    single = np.array([[fx, 0, cx], [0, fx, cy], [0, 0, 1]])
    both = [fx, fy, cx, cy]
    zero = [0.0] * 4
    brown = {
        "SIMPLE_PINHOLE": (single, []),
        "PINHOLE": (K, []),
        "SIMPLE_RADIAL": (single, [-0.2]),
        "RADIAL": (single, [-0.2, 0.05]),
        "OPENCV": (K, [-0.2, 0.05, 0.003, -0.004]),
        "FULL_OPENCV": (K, [0.2, 0.05, 0.003, -0.004, 0.01, 0.3, 0.02, 0.001]),
    }
    if model in brown:
        intrinsics, further = brown[model]
        start = [fx, cx, cy] if intrinsics is single else both
        return [*start, *further], lambda rays: landing(rays, intrinsics, np.array([*further, *zero, *zero][:8]))
    fish = {
        "OPENCV_FISHEYE": (K, [0.05, -0.01, 0.002, 0.0]),
        "SIMPLE_RADIAL_FISHEYE": (single, [0.05]),
        "RADIAL_FISHEYE": (single, [0.05, -0.01]),
    }
    if model in fish:
        intrinsics, further = fish[model]
        start = [fx, cx, cy] if intrinsics is single else both
        return [*start, *further], lambda rays: landing(rays, intrinsics, np.array([*further, *zero][:4]), True)
    assert model == "FOV"
    omega = 0.6

    def fov(rays: np.ndarray) -> np.ndarray:
        radius = np.linalg.norm(rays, axis=1, keepdims=True)
        bent = np.arctan(2 * radius * np.tan(omega / 2)) / omega
        return rays * bent / radius * (fx, fy) + (cx, cy)

    return [*both, omega], fov


def write_colmap(
    folder: Path,
    count: int = 14,
    model: str = "PINHOLE",
    text: bool = False,
    names: Callable[[int], str] | None = None,
    origin: np.ndarray | float = 0.0,
) -> None:
    """A model that pycolmap writes, in sparse/0, with observations."""
    import pycolmap

    params, lens = colmap_lens(model)
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params, camera_id=7)
    reconstruction.add_camera_with_trivial_rig(camera)
    for point, color in zip(POINTS, COLORS):
        reconstruction.add_point3D(point + origin, pycolmap.Track(), color)
    for index in range(count):
        name = names(index) if names else f"frame_{index + 1}.png"
        view = viewmat(index)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(view[:3, :3]), view[:3, 3] - view[:3, :3] @ (np.zeros(3) + origin))
        seen = [pycolmap.Point2D(np.array([3.0, 4.0])), pycolmap.Point2D(np.array([5.0, 6.0]))] * (index % 3)
        image = pycolmap.Image(name=name, camera_id=7, image_id=index + 1, points2D=seen)
        reconstruction.add_image_with_trivial_frame(image, pose)
        save_image(folder / "images" / name, dots(view, lens=lens))
    place = folder / "sparse/0"
    place.mkdir(parents=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(str(place))
