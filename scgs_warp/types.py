"""The values that walk through the pipeline. Frozen; shapes stand beside the fields.

``Frame -> motion -> Pose [M] -> skin -> Gaussians at t [N] -> project -> Splats [N] -> bin -> Tiles -> composite ->
Image``
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in OpenCV convention: x right, y down, z forward; pixel centres at +0.5. Nothing is checked.

    OpenGL's and Blender's camera-to-world ``c2w`` becomes a viewmat by ``inv(c2w @ diag(1, -1, -1, 1))``.
    """

    viewmat: Tensor
    """[4, 4] world-to-camera, float32."""
    K: Tensor
    """[3, 3] intrinsics in pixels, float32."""
    width: int
    """Of the image, pixels."""
    height: int
    """Of the image, pixels."""

    def to(self, device: torch.device | str) -> Camera:
        """The same camera with its tensors on a device."""
        return Camera(self.viewmat.to(device), self.K.to(device), self.width, self.height)

    @property
    def position(self) -> Tensor:
        """[3] centre of projection, world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


@dataclass(frozen=True)
class Frame:
    """One observation: a camera, a time in [0, 1] and what it saw. Images are stored planar; [H, W, 3] is a view."""

    camera: Camera
    """Where it was taken, world."""
    time: float
    """When it was taken, in [0, 1]."""
    image: Tensor
    """[H, W, 3] float32 in [0, 1], on the data set's background; ``image.permute(2, 0, 1)`` is contiguous."""
    alpha: Tensor | None = None
    """[H, W] float32 coverage, where the data has it."""
    mask: Tensor | None = None
    """[H, W] bool, True where the pixel is valid; None: all are."""
    name: str = ""
    """Stem of the file it came from."""


@dataclass(frozen=True)
class Pose:
    """Where the control points are at one instant, and how they are turned."""

    translations: Tensor
    """[M, 3] displacement from the control points' rest positions."""
    rotations: Tensor
    """[M, 4] wxyz, unit."""
    shape_rotations: Tensor | None = None
    """[M, 4] wxyz, unit; a rotation for the Gaussians' shape alone. None: ``rotations`` turn both."""
    log_scales: Tensor | None = None
    """[M, 3] change of the Gaussians' log scales. None: none."""


@dataclass(frozen=True)
class Gaussians:
    """Activated Gaussians at one instant: nothing here knows time. float32, one device, world units unless said
    otherwise."""

    means: Tensor
    """[N, 3] centres."""
    quats: Tensor
    """[N, 4] wxyz, need not be unit."""
    scales: Tensor
    """[N, 3] > 0, standard deviations."""
    opacities: Tensor
    """[N] in [0, 1]"""
    sh_dc: Tensor
    """[N, 3] spherical harmonics coefficients of degree 0: colour is ``0.5 + 0.2821 * sh_dc``, and what follows."""
    sh_rest: Tensor
    """[N, K - 1, 3] the higher ones; K = (degree + 1)^2."""


@dataclass(frozen=True)
class Splats:
    """Gaussians projected to one image."""

    means2d: Tensor
    """[N, 2] pixels."""
    conics: Tensor
    """[N, 3] upper triangle (xx, xy, yy) of the inverse 2D covariance, 1 / px^2."""
    depths: Tensor
    """[N] camera z."""
    opacities: Tensor
    """[N] after the antialiasing compensation, if any."""
    radii: Tensor
    """[N, 2] int32 half extents in pixels along x and y; (0, 0) where culled."""
    width: int
    height: int


@dataclass(frozen=True)
class Tiles:
    """Which splats touch which tile, nearest first."""

    ranges: Tensor
    """[T, 2] int32, begin and end of each tile (row major) in the two lists below."""
    splats: Tensor
    """[P] int32, splat index of each (tile, splat) pair, sorted by tile, then depth."""
    slots: Tensor
    """[P] int32, emission index of each pair: where its gradient is written."""
    offsets: Tensor
    """[N + 1] int64, a splat's pairs were emitted at ``offsets[i] .. offsets[i + 1]``."""
    width: int
    height: int
    columns: int
    rows: int
    tile_size: int = 16
    windows: tuple[tuple[int, int], ...] = ()
    """Where the lists would not fit into memory together they are empty, and these are the tiles, each time from begin
    to end, that compositing lists and draws at once, in this order."""


@dataclass(frozen=True)
class Image:
    """A rendered image. Stored planar, so ``rgb.permute(2, 0, 1)`` is contiguous."""

    rgb: Tensor
    """[H, W, 3] colour on the background."""
    alpha: Tensor
    """[H, W] accumulated opacity."""
    depth: Tensor
    """[H, W] expected depth: accumulated depth divided by alpha, 0 where alpha is 0 (gsplat's ED)."""


@dataclass
class Stats:
    """What densification needs, filled by the backward pass of compositing; a buffer handed in, not a hook."""

    grad_norm: Tensor
    """[N] sum over images of the norm of the loss gradient to the 2D mean, in normalised device coordinates."""
    count: Tensor
    """[N] images in which the Gaussian was visible (float32)."""
    max_radii: Tensor
    """[N] largest screen radius seen, as a fraction of the longer image side."""
    absolute: bool = False
    """Sum the absolute per-pixel gradients instead of their (cancelling) sum."""

    @staticmethod
    def zeros(count: int, device: torch.device | str, absolute: bool = False) -> Stats:
        return Stats(*(torch.zeros(count, device=device) for _ in range(3)), absolute=absolute)

    def rows(self, index: Tensor) -> Stats:
        """Of these Gaussians."""
        return Stats(self.grad_norm[index], self.count[index], self.max_radii[index], absolute=self.absolute)
