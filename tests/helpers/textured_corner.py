"""A textured corner, wall and floor, before a rig of five cameras, and COLMAP's model of it from few features."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scgs_warp.capture.colmap import quiet
from scgs_warp.capture.features import FrameFiles
from scgs_warp.capture.rig.cameras import RigCamera, straightened
from scgs_warp.capture.rig.points import lens_of
from scgs_warp.storage.png_files import write_png

WIDTH, HEIGHT, FOCAL = 320, 240, 280.0
ANGLES = (-24.0, -12.0, 0.0, 12.0, 24.0)
WALL, FLOOR = 5.0, 1.2
"""Depth of the wall and height of the floor below the cameras; y points down."""


def true_cameras(
    distortion: float = 0.0, angles=ANGLES, lens: tuple[str, tuple[float, ...]] | None = None
) -> dict[int, RigCamera]:
    """Cameras on an arc about a point before the wall; ``lens`` is a model of COLMAP with its parameters."""
    model, params = lens or ("SIMPLE_RADIAL", (FOCAL, WIDTH / 2, HEIGHT / 2, distortion))
    cameras = {}
    for number, angle in enumerate(angles):
        turn = np.radians(angle)
        rotation = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
        centre = np.array([0.0, 0.0, 4.0]) + rotation.T @ [0.0, 0.1 * (number % 2), -4.0]
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ centre
        cameras[number] = RigCamera(model, params, WIDTH, HEIGHT, viewmat)
    return cameras


def surface(camera: RigCamera) -> np.ndarray:
    """Return the points [H, W, 3] that the pixels show."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    with quiet() as pycolmap:
        flat = np.asarray(lens_of(pycolmap, camera).cam_from_img(np.stack([columns, rows], 2).reshape(-1, 2)))
    rays = np.concatenate([flat, np.ones((len(flat), 1))], 1) @ camera.viewmat[:3, :3]
    centre = -camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3]
    to_wall = (WALL - centre[2]) / rays[:, 2]
    to_floor = np.where(rays[:, 1] > 1e-6, (FLOOR - centre[1]) / np.maximum(rays[:, 1], 1e-6), np.inf)
    return (centre + rays * np.minimum(to_wall, to_floor)[:, None]).reshape(camera.height, camera.width, 3)


def picture(camera: RigCamera) -> np.ndarray:
    """Return what a camera sees, [H, W, 3] uint8."""
    random = np.random.default_rng(5)
    grains = [random.uniform(0, 255, (side, side, 3)).astype(np.float32) for side in (400, 90)]
    texture = sum(0.5 * cv2.resize(grain, (2048, 2048), interpolation=cv2.INTER_CUBIC) for grain in grains)
    points = surface(camera).astype(np.float32)
    x = points[..., 0] * 100 + 1024
    y = (points[..., 1] + np.where(points[..., 1] > FLOOR - 1e-3, WALL - points[..., 2], 0.0)) * 100 + 1024
    image = cv2.remap(texture, x, y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return image.clip(0, 255).astype(np.uint8)


def project(camera: RigCamera, points: np.ndarray) -> np.ndarray:
    """Return the pixels [P, 2] of points [P, 3]; the corner of the first is at (0, 0)."""
    with quiet() as pycolmap:
        local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        return np.asarray(lens_of(pycolmap, camera).img_from_cam(local))


def stills(folder: Path, cameras: dict[int, RigCamera], masks: dict[int, np.ndarray] | None = None) -> FrameFiles:
    """Write the pictures."""
    (folder / "stills").mkdir()
    (folder / "masks").mkdir()
    names = [f"cam{number}.png" for number in cameras]
    for name, (number, camera) in zip(names, cameras.items()):
        write_png(folder / "stills" / name, picture(camera))
        mask = np.full((camera.height, camera.width), 255, np.uint8) if masks is None else masks[number]
        write_png(folder / "masks" / name, np.repeat(mask[..., None], 3, 2))
    return FrameFiles(folder / "stills", names, folder / "masks")


def model_of(
    cameras: dict[int, RigCamera], names: list[str], features: int = 60, noise: float = 0.4, shared: bool = True
):
    """Return a reconstruction from features in the middle of the pictures, whose places err by ``noise`` pixels."""
    random = np.random.default_rng(2)
    points = np.stack(
        [random.uniform(-0.5, 0.5, features), random.uniform(-0.5, 0.5, features), np.full(features, WALL)], 1
    )
    points[::3, 1:] = np.stack([np.full(len(points[::3]), FLOOR), random.uniform(4.0, 4.8, len(points[::3]))], 1)
    with quiet() as pycolmap:
        model = pycolmap.Reconstruction()
        for number, camera in cameras.items():
            own = 1 if shared else number + 1
            if not model.exists_camera(own):
                lens = lens_of(pycolmap, camera)
                lens.camera_id = own
                model.add_camera_with_trivial_rig(lens)
            pixels = project(camera, points) + random.normal(0.0, noise, (features, 2))
            image = pycolmap.Image(name=names[number], points2D=[pycolmap.Point2D(p) for p in pixels], camera_id=own)
            image.image_id = number + 1
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(camera.viewmat[:3, :3]), camera.viewmat[:3, 3])
            model.add_image_with_trivial_frame(image, pose)
        for index, point in enumerate(points):
            track = pycolmap.Track()
            for number in cameras:
                track.add_element(number + 1, index)
            model.add_point3D(point, track, np.array([index, 1, 2], np.uint8))
    return straightened(model)


def misplaced(found: dict[int, RigCamera], true: dict[int, RigCamera]) -> float:
    """Return the 90th percentile of the distance, in pixels, between what a camera shows and what the cameras beside it
    say that it shows."""
    errors = []
    for number in list(true)[1:-1]:
        points = surface(true[number])[8::16, 8::16].reshape(-1, 3)
        seen = {each: project(true[each], points) for each in (number - 1, number, number + 1)}
        sizes = {each: (true[each].width, true[each].height) for each in seen}
        usable = np.logical_and.reduce([(p >= 0).all(1) & (p <= sizes[each]).all(1) for each, p in seen.items()])
        with quiet() as pycolmap:
            sides = [
                np.asarray(lens_of(pycolmap, found[each]).cam_from_img(seen[each][usable])).T
                for each in (number - 1, number + 1)
            ]
        placed = cv2.triangulatePoints(found[number - 1].viewmat[:3], found[number + 1].viewmat[:3], *sides)
        errors.append(np.linalg.norm(project(found[number], (placed[:3] / placed[3]).T) - seen[number][usable], axis=1))
    return float(np.quantile(np.concatenate(errors), 0.9))
