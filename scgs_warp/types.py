"""Frozen dataclasses passed along the pipeline, with each field's shape.

``Frame -> motion -> Pose [M] -> skin -> Gaussians at t [N] -> project -> Splats [N] -> bin -> Tiles -> composite ->
Image``
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in OpenCV convention: x right, y down, z forward; pixel centres at +0.5. The fields are checked
    only when an image is rendered.

    A camera-to-world matrix ``c2w`` of OpenGL or Blender becomes ``viewmat = inv(c2w @ diag(1, -1, -1, 1))``.
    """

    viewmat: Tensor
    """[4, 4] world-to-camera, float32."""
    K: Tensor
    """[3, 3] intrinsics in pixels, float32."""
    width: int
    """Image width, pixels."""
    height: int
    """Image height, pixels."""

    def to(self, device: torch.device | str) -> Camera:
        """Return the camera with its tensors on a device."""
        return Camera(self.viewmat.to(device), self.K.to(device), self.width, self.height)

    @property
    def position(self) -> Tensor:
        """Centre of projection, [3], world."""
        viewmat = self.viewmat
        if viewmat.device.type != "cpu" or viewmat.requires_grad:
            return -viewmat[:3, :3].T @ viewmat[:3, 3]
        # Twelve numbers take Python less time than seven operations take torch.
        rows = viewmat.tolist()
        return viewmat.new_tensor([-sum(row[axis] * row[3] for row in rows[:3]) for axis in range(3)])


@dataclass(frozen=True)
class Frame:
    """One observation: a camera, a time in [0, 1] and an image. Images are stored planar and viewed as [H, W, 3]."""

    camera: Camera
    """Camera of the image, world."""
    time: float
    """Time of the image, in [0, 1]."""
    image: Tensor
    """[H, W, 3] float32 in [0, 1], on the data set's background; ``image.permute(2, 0, 1)`` is contiguous."""
    alpha: Tensor | None = None
    """[H, W] float32 coverage. None: the data has no coverage."""
    mask: Tensor | None = None
    """[H, W] bool, True for valid pixels. None: all are valid."""
    name: str = ""
    """Stem of the image file's name."""
    depth: Tensor | None = None
    """[h, w] float32 depth along the camera's z, world units, 0 where unknown, of any size with the proportions of the
    image. None: no depth map. Frames that a data set reads have none; ask it for ``Dataset.depth``."""


@dataclass(frozen=True)
class Pose:
    """Positions and rotations of the control points at one instant."""

    translations: Tensor
    """[M, 3] displacement from the control points' rest positions."""
    rotations: Tensor
    """[M, 4] wxyz, unit."""
    shape_rotations: Tensor | None = None
    """[M, 4] wxyz, unit; separate rotations for the Gaussians' shapes. None: ``rotations`` turn shapes, too."""
    log_scales: Tensor | None = None
    """[M, 3] change of the Gaussians' log scales. None: no change."""
    tints: Tensor | None = None
    """[M, 3] change of the logarithms of the Gaussians' colours. None: no change. A pose has ``log_scales`` or
    ``tints``, not both, because skinning blends three values beside the motion."""

    @property
    def turns_of_shapes(self) -> Tensor:
        """[M, 4] wxyz rotations of the Gaussians' shapes."""
        return self.rotations if self.shape_rotations is None else self.shape_rotations


@dataclass(frozen=True)
class Gaussians:
    """Activated Gaussians at one instant: float32, on one device, in world units unless stated otherwise."""

    means: Tensor
    """[N, 3] centres."""
    quats: Tensor
    """[N, 4] wxyz, need not be unit."""
    scales: Tensor
    """[N, 3] > 0, standard deviations."""
    opacities: Tensor
    """[N] in [0, 1]"""
    sh_dc: Tensor
    """[N, 3] spherical harmonics of degree 0: colour is ``0.5 + 0.2821 * sh_dc`` plus the higher degrees."""
    sh_rest: Tensor
    """[N, K - 1, 3] spherical harmonics of the higher degrees; K = (degree + 1)^2."""
    sharpness: float = 0.0
    """Value s >= 0 by which they fall off faster than a Gaussian: the opacity is multiplied by exp(-u - s u^2), where u
    is half the squared distance from the mean in units of the covariance."""

    def tensors(self) -> dict[str, Tensor]:
        """Return the fields with a row per Gaussian, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}

    def plain(self) -> Gaussians:
        """Return the most similar Gaussians of sharpness 0, for programs that draw no others: smaller by the factor
        with which alpha falls to 1/100 of the opacity at the same distance. Tails that reach less far would leave gaps;
        longer ones blur outlines."""
        if self.sharpness == 0.0:
            return self
        return replace(self, scales=self.scales * plain_scale(self.sharpness), sharpness=0.0)


def plain_scale(sharpness: float) -> float:
    """Return the ratio of the scales of the most similar Gaussians to those with this sharpness."""
    depth = math.log(100.0)
    return math.sqrt(2.0 / (1.0 + math.sqrt(1.0 + 4.0 * sharpness * depth)))


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
    """[N] opacities, after the antialiasing compensation if it is used."""
    radii: Tensor
    """[N, 2] int32 half extents in pixels along x and y; (0, 0) where culled."""
    width: int
    height: int
    sharpness: float = 0.0
    """That of :class:`Gaussians`."""


@dataclass(frozen=True)
class Tiles:
    """Lists of the splats that touch each tile, nearest first."""

    ranges: Tensor
    """[T, 2] int32, begin and end of each tile (row major) in ``splats`` and ``slots``."""
    splats: Tensor
    """[P] int32, splat index of each (tile, splat) pair, sorted by tile, then depth."""
    slots: Tensor
    """[P] int32, emission index of each pair: the slot that its gradient is written to. [0]: made for an image without
    gradients."""
    offsets: Tensor
    """[N + 1] int64, splat i owns the slots from ``offsets[i]`` up to ``offsets[i + 1]``."""
    width: int
    height: int
    columns: int
    rows: int
    tile_size: int = 16
    windows: tuple[tuple[int, int], ...] = ()
    """Windows of tiles (begin, end). If the lists of all tiles do not fit into memory together, the lists above are
    empty, and compositing lists and draws the windows one after the other."""


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
    """Statistics for densification: a buffer that the backward pass of compositing adds to."""

    grad_norm: Tensor
    """[N] sum over images of the norm of the loss gradient to the 2D mean, in normalised device coordinates."""
    count: Tensor
    """[N] number of images in which the Gaussian was visible (float32)."""
    max_radii: Tensor
    """[N] largest screen radius seen, as a fraction of the longer image side."""
    absolute: bool = False
    """Flag that absolute gradients are summed over pixels, so that opposite ones do not cancel."""
    outcome: Tensor | None = None
    """[1] int32 outcome of a recorded step so far: nothing is added unless it is fine. None: always add."""

    @property
    def sums(self) -> tuple[Tensor, Tensor, Tensor]:
        """The three buffers."""
        return self.grad_norm, self.count, self.max_radii

    @staticmethod
    def zeros(count: int, device: torch.device | str, absolute: bool = False) -> Stats:
        return Stats(*(torch.zeros(count, device=device) for _ in range(3)), absolute=absolute)

    def rows(self, index: Tensor) -> Stats:
        """Return the statistics of the Gaussians in ``index``."""
        return Stats(self.grad_norm[index], self.count[index], self.max_radii[index], absolute=self.absolute)
