"""Layers of a render other than colour: depth, coverage, control points and their trails."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Literal, get_args

import cv2
import numpy as np
from torch import Tensor

from ..errors import UserError
from ..types import Camera, Image
from .figures import to_bytes

if TYPE_CHECKING:
    from ..scene.scene import Scene

Show = Literal["rgb", "depth", "alpha", "nodes", "trajectories"]

TRAIL = 0.15
"""Length of a trail as a share of the motion's duration."""
TRAIL_STEPS = 15
"""Number of straight segments of a trail."""
TRACKED_GAUSSIANS = 400
"""Number of Gaussians to track if a motion model has no control points."""
RANGE_SAMPLES = 8
"""Number of frames from which a film's range of depths is determined."""

HIDDEN_OPACITY = 0.25
"""Opacity of points and trails behind the surface."""
SURFACE_THICKNESS = 0.02
"""Largest distance behind the surface at which a point counts as visible, as a share of its depth: control points lie
inside the body that they move."""
SURFACE_ALPHA = 0.5
"""Alpha above which depth is valid."""
FRACTION_BITS = 4
"""Fractional bits of the coordinates given to OpenCV, so that dots move smoothly by less than a pixel."""


def depth_range(images: Iterable[Image]) -> tuple[float, float]:
    """Determine one range of depths (near, far) for a whole film from some of its images.

    The range is the 2nd to 98th percentile of the depth of opaque pixels, slightly widened; (0, 1) without opaque
    pixels.
    """
    samples = []
    for image in images:
        depth = image.depth[image.alpha > SURFACE_ALPHA].detach().cpu().numpy()
        samples.append(depth[:: max(1, len(depth) // 50_000)])
    depths = np.concatenate(samples) if samples else np.zeros(0)
    if len(depths) == 0:
        return 0.0, 1.0
    near, far = np.percentile(depths, (2, 98)).tolist()
    margin = max(0.05 * (far - near), 1e-3 * abs(far))
    return near - margin, far + margin


def color_depth(image: Image, near: float, far: float) -> np.ndarray:
    """Map depth to turbo's colours, [H, W, 3] uint8: warm and bright is near, blue is far, and no surface is black."""
    depth, alpha = image.depth.detach().cpu().numpy(), image.alpha.detach().cpu().numpy()
    nearness = np.clip((far - np.nan_to_num(depth)) / (far - near or 1.0), 0.0, 1.0)
    # Turbo is almost black at its blue end and dark at its red end, so both ends are cut.
    colors = cv2.applyColorMap(to_bytes(0.1 + 0.75 * nearness), cv2.COLORMAP_TURBO)[..., ::-1]
    return (colors * np.nan_to_num(alpha)[..., None].clip(0.0, 1.0) + 0.5).astype(np.uint8)


def grey_alpha(image: Image) -> np.ndarray:
    """Draw coverage in grey, [H, W, 3] uint8, white where opaque."""
    return np.ascontiguousarray(np.repeat(to_bytes(image.alpha)[..., None], 3, axis=-1))


def position_colors(points: Tensor | np.ndarray) -> np.ndarray:
    """Map positions [M, 3] to RGB [M, 3] uint8; neighbours have similar colours, so that a film can be followed."""
    positions = _array(points)
    if len(positions) == 0:
        return np.zeros((0, 3), np.uint8)
    low, high = np.percentile(positions, (2, 98), axis=0)
    inside = np.clip((positions - low) / np.where(high > low, high - low, 1.0), 0.0, 1.0)
    return (60 + 195 * inside).astype(np.uint8)


def project_points(points: Tensor | np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Project world points [..., 3] to pixels [..., 2] (pixel centres at +0.5) and depths [...]."""
    viewmat = camera.viewmat.detach().cpu().double().numpy()
    K = camera.K.detach().cpu().double().numpy()
    with np.errstate(invalid="ignore", over="ignore"):  # Non-finite points stay non-finite and are not drawn.
        seen = _array(points) @ viewmat[:3, :3].T + viewmat[:3, 3]
    depths = seen[..., 2]
    image = seen @ K.T
    return image[..., :2] / np.where(depths == 0, np.nan, depths)[..., None], depths


def _array(points: Tensor | np.ndarray) -> np.ndarray:
    return points.detach().cpu().double().numpy() if isinstance(points, Tensor) else np.asarray(points, np.float64)


def _drawable(pixels: np.ndarray, depths: np.ndarray, camera: Camera) -> np.ndarray:
    """Return [...] whether points lie in front of the camera and within the range of OpenCV's integers."""
    limit = 4 * max(camera.width, camera.height)
    return np.isfinite(pixels).all(-1) & (depths > 0) & (np.abs(pixels) < limit).all(-1)


def _hidden(pixels: np.ndarray, depths: np.ndarray, image: Image | None) -> np.ndarray:
    """Return [...] whether an opaque surface lies in front of each point."""
    if image is None:
        return np.zeros(depths.shape, bool)
    surface, alpha = image.depth.detach().cpu().numpy(), image.alpha.detach().cpu().numpy()
    height, width = surface.shape
    finite = np.nan_to_num(pixels, nan=-1.0).clip(-1e6, 1e6)
    column, row = np.floor(finite[..., 0]).astype(int), np.floor(finite[..., 1]).astype(int)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row = column.clip(0, width - 1), row.clip(0, height - 1)
    behind = depths * (1.0 - SURFACE_THICKNESS) > surface[row, column]
    return inside & behind & (alpha[row, column] > SURFACE_ALPHA)


def _fixed_point(pixels: np.ndarray) -> np.ndarray:
    """Convert to OpenCV's fixed-point coordinates, whose pixel centres are integers."""
    return np.rint((pixels - 0.5) * (1 << FRACTION_BITS)).astype(np.int32)


def _blend(below: np.ndarray, above: np.ndarray) -> np.ndarray:
    return cv2.addWeighted(below, 1.0 - HIDDEN_OPACITY, above, HIDDEN_OPACITY, 0.0)


def draw_points(
    rgb: np.ndarray, points: Tensor, camera: Camera, colors: np.ndarray, image: Image | None = None
) -> np.ndarray:
    """Draw points as dots, the nearest on top, and faintly where the surface hides them.

    Args:
        rgb: [H, W, 3] uint8, the camera's size; not modified.
        points: [M, 3] world.
        camera: the camera of ``rgb``.
        colors: [M, 3] uint8.
        image: render whose depth hides points; None: no point is hidden.

    Returns:
        [H, W, 3] uint8.
    """
    canvas = np.ascontiguousarray(rgb).copy()
    pixels, depths = project_points(points, camera)
    keep = _drawable(pixels, depths, camera)
    hidden = _hidden(pixels, depths, image)
    radius = max(2.0, 0.007 * max(camera.width, camera.height))
    order = np.argsort(-depths, kind="stable")
    for faint in (True, False):
        layer = canvas.copy() if faint else canvas
        for index in order[(keep & (hidden == faint))[order]]:
            x, y = _fixed_point(pixels[index]).tolist()
            for size, color in ((radius + 1.0, (20, 20, 20)), (radius, colors[index].tolist())):
                cv2.circle(layer, (x, y), round(size * (1 << FRACTION_BITS)), color, -1, cv2.LINE_AA, FRACTION_BITS)
        canvas = _blend(canvas, layer) if faint else layer
    return canvas


def draw_trails(rgb: np.ndarray, tracks: np.ndarray, camera: Camera, image: Image | None = None) -> np.ndarray:
    """Draw the trail of each point, from dark blue (oldest) to yellow (now), and faintly where the surface hides it.

    Args:
        rgb: [H, W, 3] uint8, the camera's size; not modified.
        tracks: [T, M, 3] world positions at T successive times, oldest first.
        camera: the camera of ``rgb``.
        image: render whose depth hides points; None: no point is hidden.

    Returns:
        [H, W, 3] uint8.
    """
    canvas = np.ascontiguousarray(rgb).copy()
    steps = len(tracks) - 1
    if steps < 1 or tracks.shape[1] == 0:
        return canvas
    pixels, depths = project_points(tracks, camera)
    keep = _drawable(pixels, depths, camera)
    hidden = _hidden(pixels, depths, image)
    ramp = cv2.applyColorMap(np.linspace(40, 235, steps).astype(np.uint8)[None], cv2.COLORMAP_PLASMA)[0, :, ::-1]
    thickness = max(1, round(0.002 * max(camera.width, camera.height)))
    places = _fixed_point(np.where(keep[..., None], pixels, 0.0))
    ends = np.stack([places[:-1], places[1:]], axis=2)
    for faint in (True, False):
        layer = canvas.copy() if faint else canvas
        for step in range(steps):
            chosen = keep[step] & keep[step + 1] & (hidden[step + 1] == faint)
            if chosen.any():
                lines = list(ends[step][chosen])
                cv2.polylines(layer, lines, False, ramp[step].tolist(), thickness, cv2.LINE_AA, FRACTION_BITS)
        canvas = _blend(canvas, layer) if faint else layer
    return canvas


def interpolate_tracks(tracks: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Interpolate ``tracks`` [T, M, 3], at T evenly spaced times from 0 to 1, at ``times`` [S] to [S, M, 3]."""
    position = np.clip(times, 0.0, 1.0) * (len(tracks) - 1)
    low = np.minimum(np.floor(position).astype(int), max(len(tracks) - 2, 0))
    high = np.minimum(low + 1, len(tracks) - 1)
    share = (position - low)[:, None, None]
    return tracks[low] * (1.0 - share) + tracks[high] * share


class Painter:
    """Painter of a film's frames from (camera, time); shared data is prepared once.

    Args:
        scene: the scene.
        show: ``rgb``, ``depth``, ``alpha``, ``nodes`` (control points) or ``trajectories``.
        views: the film's (camera, time) pairs, of which some are rendered to determine the range of depths.

    Raises:
        UserError: there is no such ``show``, or it is ``nodes`` and the scene has no control points.
    """

    def __init__(self, scene: Scene, show: Show, views: Sequence[tuple[Camera, float]]) -> None:
        if show not in get_args(Show):
            raise UserError(f"show {show!r}: choose one of {', '.join(get_args(Show))}")
        self._scene = scene
        self._show = show
        if show == "depth":
            sample = views[:: max(1, len(views) // RANGE_SAMPLES)]
            self._range = depth_range(scene.render(camera, time) for camera, time in sample)
        elif show == "nodes":
            points = scene.control_points_at(0.0)
            if len(points) == 0:
                raise UserError(
                    f"--show nodes: the motion model {scene.motion_name!r} of this run has no control points; "
                    "choose rgb, depth, alpha or trajectories"
                )
            self._colors = position_colors(points)
        elif show == "trajectories":
            self._tracks = tracks(scene)

    def paint(self, camera: Camera, time: float) -> np.ndarray:
        """Paint one frame, [H, W, 3] uint8."""
        image = self._scene.render(camera, time)
        if self._show == "depth":
            return color_depth(image, *self._range)
        if self._show == "alpha":
            return grey_alpha(image)
        rgb = to_bytes(image.rgb)
        if self._show == "nodes":
            points = self._scene.control_points_at(time)
            return draw_points((rgb * 0.6).astype(np.uint8), points, camera, self._colors, image)
        if self._show == "trajectories":
            times = np.linspace(max(0.0, time - TRAIL), time, TRAIL_STEPS + 1)
            return draw_trails((rgb * 0.5).astype(np.uint8), interpolate_tracks(self._tracks, times), camera, image)
        return rgb


def tracks(scene: Scene, samples: int = 100) -> np.ndarray:
    """Return tracks [samples, M, 3] of the control points, or of some opaque Gaussians of scenes without control
    points, at evenly spaced times from 0 to 1."""
    times = np.linspace(0.0, 1.0, samples).tolist()
    if len(scene.control_points_at(0.0)):
        return np.stack([_array(scene.control_points_at(time)) for time in times])
    opaque = (scene.gaussians_at(0.0).opacities > SURFACE_ALPHA).nonzero()[:, 0]
    chosen = opaque[:: max(1, len(opaque) // TRACKED_GAUSSIANS)]
    return np.stack([_array(scene.gaussians_at(time).means[chosen]) for time in times])
