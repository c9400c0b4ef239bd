"""Lenses: the pinhole camera inside a camera model, and undistortion of images to this pinhole camera.

pycolmap evaluates the camera models of COLMAP, which include those of OpenCV and most of nerfstudio; OpenCV resamples
pixels.
Pixel centres are at +0.5, as in COLMAP; OpenCV's own functions count from the centre of the first pixel.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import cv2
import numpy as np

from ..runtime.pycolmap_import import import_pycolmap

ROWS = 64
"""Number of image rows whose rays are projected at once, to limit memory."""
DIRECTIONS = 16
RADII = 512
"""Number of directions, and number of steps along each, at which a model is tested for folding back."""
EDGE_TOLERANCE = 0.01
"""Tolerance for rounding errors beyond the outermost pixel centres, in pixels."""
SINGLE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_FISHEYE", "SIMPLE_DIVISION")
SINGLE_FOCAL += ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
BROWN4 = "BROWN4"
"""Model that COLMAP does not have: (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4), the radial part a polynomial with k4 at
the eighth power of the radius, as nerfstudio's OPENCV, Metashape and RealityCapture have it."""
PINHOLE_AT_ZERO = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_DIVISION", "DIVISION")
"""Models that reduce to a pinhole if all parameters beyond the first three or four are 0."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics at the size of the file, and lens distortion."""

    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "PINHOLE"
    """COLMAP's name of the camera model, or ``BROWN4``."""
    params: tuple[float, ...] = ()
    """Parameters of the model in COLMAP's order, including focal lengths and centre; empty for a pinhole."""
    skew: float = 0.0
    """Skew in pixels: shift of x per unit of y."""

    @property
    def distorted(self) -> bool:
        """True if the image differs from that of a pinhole camera."""
        if self.skew != 0.0:
            return True
        if self.model in ("PINHOLE", "SIMPLE_PINHOLE"):
            return False
        first = 3 if self.model in SINGLE_FOCAL else 4
        return self.model not in PINHOLE_AT_ZERO or any(value != 0.0 for value in self.params[first:])


def make_lens(model: str, params: tuple[float, ...], skew: float = 0.0) -> Lens:
    """Make the lens of a COLMAP model, or of ``BROWN4``, with these parameters.

    Raises:
        ValueError: the model is unknown, the number of parameters is wrong, or their values are impossible.
    """
    pycolmap = import_pycolmap()
    known = pycolmap.CameraModelId.__members__
    if (model not in known and model != BROWN4) or model == "INVALID":
        raise ValueError(f"camera model {model[:40]!r} is not known")
    if model == "EQUIRECTANGULAR":
        raise ValueError("camera model EQUIRECTANGULAR sees all around, which no pinhole does")
    if not all(math.isfinite(value) and abs(value) < 1e9 for value in (*params, skew)):
        raise ValueError("camera parameters are not finite, or absurd")
    if not _takes(model, params):
        raise ValueError(f"camera model {model} does not take {len(params)} parameters")
    fx, fy = (params[0], params[0]) if model in SINGLE_FOCAL else params[:2]
    cx, cy = params[1:3] if model in SINGLE_FOCAL else params[2:4]
    if fx <= 0 or fy <= 0:
        raise ValueError("the focal length is not positive")
    return Lens(fx, fy, cx, cy, model, params, skew)


def _takes(model: str, params: tuple[float, ...]) -> bool:
    """Return whether a model that is known has as many parameters."""
    if model == BROWN4:
        return len(params) == 10
    camera = import_pycolmap().Camera(model=model, width=1, height=1)
    camera.params = list(params)
    return camera.verify_params()


def rescaled(lens: Lens, size: tuple[int, int], new: tuple[int, int]) -> Lens:
    """Return the lens of images of one (width, height) for the same images at a new one."""
    if lens.model == BROWN4:
        scales = (new[0] / size[0], new[1] / size[1])
        return make_lens(BROWN4, (*(x * s for x, s in zip(lens.params[:4], 2 * scales)), *lens.params[4:]), lens.skew)
    camera = import_pycolmap().Camera(model=lens.model, width=size[0], height=size[1])
    camera.params = list(lens.params)
    camera.rescale(*new)
    return make_lens(lens.model, tuple(camera.params))


def project(lens: Lens, rays: np.ndarray) -> np.ndarray:
    """Project camera rays [N, 3] (x right, y down, z forward) to pixels [N, 2] of the file; NaN where the model is
    undefined."""
    model, params = lens.model, lens.params
    if not params:
        model, params = "PINHOLE", (lens.fx, lens.fy, lens.cx, lens.cy)
    with np.errstate(all="ignore"):
        if model == BROWN4:
            pixels = _brown4(params, np.asarray(rays, np.float64))
        else:
            camera = import_pycolmap().Camera(model=model, width=1, height=1)
            camera.params = list(params)
            pixels = np.asarray(camera.img_from_cam(np.ascontiguousarray(rays, np.float64)), np.float64)
    pixels[:, 0] += lens.skew / lens.fy * (pixels[:, 1] - lens.cy)
    return pixels


def _brown4(params: tuple[float, ...], rays: np.ndarray) -> np.ndarray:
    """Project rays [N, 3] to pixels [N, 2]; NaN behind the camera."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4 = params
    x, y = np.where(rays[:, 2] > 0.0, rays[:, :2].T / rays[:, 2], np.nan)
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4)))
    u = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
    v = y * radial + 2.0 * p2 * x * y + p1 * (square + 2.0 * y * y)
    return np.stack([fx * u + cx, fy * v + cy], axis=1)


def valid_radius(lens: Lens, width: int, height: int) -> float:
    """Return the tangent of the largest angle to the optical axis up to which the model is monotonic.

    Distortion polynomials fold back beyond the range to which they were fitted. The result is infinite if the model is
    monotonic over the whole image.
    """
    corners = [abs(x) for x in (lens.cx, width - lens.cx)], [abs(y) for y in (lens.cy, height - lens.cy)]
    farthest = math.hypot(max(corners[0]) / lens.fx, max(corners[1]) / lens.fy)
    angles = np.linspace(0.0, 2.0 * math.pi, DIRECTIONS, endpoint=False)
    radii = np.linspace(0.0, farthest, RADII)
    across = radii[None, :, None] * np.stack([np.cos(angles), np.sin(angles)], 1)[:, None]
    rays = np.concatenate([across, np.ones((DIRECTIONS, RADII, 1))], 2)
    pixels = project(lens, rays.reshape(-1, 3)).reshape(DIRECTIONS, RADII, 2) - (lens.cx, lens.cy)
    with np.errstate(invalid="ignore"):
        outwards = np.diff(np.linalg.norm(pixels, axis=2), axis=1) > 0  # False for NaN
    stuck = ~outwards.all(axis=0)
    return float(radii[stuck.argmax()]) if stuck.any() else math.inf


@functools.lru_cache(maxsize=4)
def undistortion_maps(lens: Lens, width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Map the pinhole's pixels to the file: return coordinates x [H, W] and y [H, W] float32 in OpenCV's convention,
    and [H, W] bool, True for pixels inside the file."""
    x = (np.arange(width) + 0.5 - lens.cx) / lens.fx
    y = (np.arange(height) + 0.5 - lens.cy) / lens.fy
    limit = valid_radius(lens, width, height)
    columns, rows = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    valid = np.empty((height, width), bool)
    for first in range(0, height, ROWS):
        band = slice(first, min(first + ROWS, height))
        grid = np.stack(np.broadcast_arrays(x[None, :], y[band, None], 1.0), axis=2)
        pixels = project(lens, grid.reshape(-1, 3)).reshape(*grid.shape[:2], 2) - 0.5
        inside = (pixels >= -EDGE_TOLERANCE) & (
            pixels <= (width - 1 + EDGE_TOLERANCE, height - 1 + EDGE_TOLERANCE)
        )  # False for NaN
        valid[band] = inside.all(axis=2) & (np.hypot(grid[..., 0], grid[..., 1]) < limit)
        pixels = np.where(valid[band, :, None], pixels, -9.0)
        columns[band], rows[band] = pixels[..., 0], pixels[..., 1]
    return columns, rows, valid


def undistort(image: np.ndarray, lens: Lens) -> np.ndarray:
    """Resample an image [H, W, ...] bilinearly to the lens's pinhole camera; pixels outside the file are 0."""
    columns, rows, valid = undistortion_maps(lens, image.shape[1], image.shape[0])
    moved = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    moved[~valid] = 0
    return moved


def valid_pixels(lens: Lens, width: int, height: int) -> np.ndarray:
    """Return [H, W] bool, True for pixels of the undistorted image that lie inside the file."""
    return undistortion_maps(lens, width, height)[2]
