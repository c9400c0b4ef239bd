"""Ray casting of a moving surface with Warp's mesh queries, on tensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor

from ...kernels import raycast_figure as kernels
from ...runtime.cuda_graph import on_torch_stream
from ...runtime.launch import launch, warp_view
from ...types import Camera
from .shading import Shading
from .surface import Surface

TOLERANCE = 2e-3
"""Largest distance behind the first hit of a ray at which a point counts as visible, world units."""


@dataclass(frozen=True)
class Lamp:
    """Quality of the light."""

    spread: float = 0.35
    """Radius of the key light over its distance: larger makes softer shadows."""
    sky_rays: int = 40
    key_rays: int = 16
    reach: float = 0.5
    """Distance beyond which an occluder does not darken the sky, world units."""


class PosedSurface(NamedTuple):
    """A surface at one time, ready for ray queries."""

    mesh: wp.Mesh
    vertices: Tensor
    """[P, 3] world; the mesh shares this memory."""
    normals: Tensor
    """[P, 3] unit."""
    light: Tensor
    """[P, 3] irradiance."""
    key: Tensor
    """[P] strength of the key light times its visible share."""


class Raycaster:
    """Ray caster for one moving surface on one device; constant data is uploaded once."""

    def __init__(
        self, surface: Surface, device: str = "cpu", shading: Shading | None = None, lamp: Lamp | None = None
    ) -> None:
        self.surface = surface
        self.device = device
        self.shading = shading or Shading()
        self.lamp = lamp or Lamp()
        self.rest = self._tensor(surface.rest)
        self.faces = torch.from_numpy(surface.faces.reshape(-1)).to(device)
        self.face_part = torch.from_numpy(surface.face_part).to(device)
        materials = surface.materials
        self.kinds = torch.tensor([material.kind for material in materials], dtype=torch.int32, device=device)
        self.colors = self._tensor([material.colors for material in materials])
        self.frequencies = self._tensor([material.frequency for material in materials])
        self.shine = self._tensor([(material.shine, material.exponent) for material in materials])
        self.light_direction = torch.nn.functional.normalize(self._tensor([self.shading.light]), dim=1)
        self._moved: tuple[Tensor, wp.Mesh] | None = None

    def _tensor(self, values) -> Tensor:
        return torch.as_tensor(np.asarray(values, np.float32)).to(self.device)

    def pose(self, time: float) -> PosedSurface:
        """Pose and light the surface at ``time`` in [0, 1]."""
        points, normals = (self._tensor(values) for values in self.surface.posed(time))
        mesh = mesh_over(points, self.faces)
        light, key = torch.ones_like(points), torch.zeros(len(points), device=self.device)
        if not self.shading.unlit:
            lamp, shading = self.lamp, self.shading
            launch(
                kernels.light_vertices, len(points), mesh.id, points, normals, self.light_direction, lamp.spread,
                lamp.sky_rays, lamp.key_rays, lamp.reach, shading.ambient / 0.5, shading.diffuse / 0.5, light, key,
                grain=64,
            )  # fmt: skip
        return PosedSurface(mesh, points, normals, light, key)

    def pose_lit_as(self, lit: PosedSurface | None, time: float) -> PosedSurface:
        """Pose the surface at ``time``, with the light of a pose at nearly the same time, or unlit. The result is valid
        until the next call, which moves the same mesh."""
        points, normals = (self._tensor(values) for values in self.surface.posed(time))
        if self._moved is None:
            self._moved = points, mesh_over(points, self.faces)
        vertices, mesh = self._moved
        vertices.copy_(points)
        if vertices.is_cuda:
            with on_torch_stream(vertices.device):
                mesh.refit()
        else:
            mesh.refit()
        if lit is None:
            return PosedSurface(mesh, vertices, normals, torch.ones_like(vertices), torch.zeros_like(vertices[:, 0]))
        return PosedSurface(mesh, vertices, normals, lit.light, lit.key)

    def render(self, posed: PosedSurface, camera: Camera, samples: int = 4) -> Tensor:
        """Render [H, W, 4] premultiplied colour and coverage with ``samples`` x ``samples`` rays per pixel."""
        image = torch.zeros(camera.height, camera.width, 4, device=self.device)
        self._cast(posed, camera, pixel_window(posed.vertices, camera), samples, image)
        return image

    def render_rows(self, posed: PosedSurface, camera: Camera, rows: range, samples: int, image: Tensor) -> None:
        """Write some rows of ``image`` [H, W, 4], over their whole width."""
        self._cast(posed, camera, (0, rows.start, camera.width, len(rows)), samples, image)

    def _cast(
        self, posed: PosedSurface, camera: Camera, window: tuple[int, int, int, int], samples: int, image: Tensor
    ) -> None:
        left, top, columns, rows = window
        camera_to_world = torch.linalg.inv(camera.viewmat.double())[:3].float().contiguous().to(self.device)
        launch(
            kernels.raycast, columns * rows, posed.mesh.id, self.faces, self.rest, posed.light, posed.normals,
            posed.key, self.light_direction, self.face_part, self.kinds, self.colors, self.frequencies, self.shine,
            camera_to_world, camera.K.to(self.device), left, top, columns, samples, image, grain=64,
        )  # fmt: skip

    def visible(self, posed: PosedSurface, camera: Camera, points: Tensor) -> Tensor:
        """Return [P] bool, True for surface points [P, 3] that the camera sees."""
        seen = torch.empty(len(points), dtype=torch.int32, device=self.device)
        launch(
            kernels.visible, len(points), posed.mesh.id, points, camera.viewmat.to(self.device),
            camera.K.to(self.device), camera.width, camera.height, TOLERANCE, seen,
        )  # fmt: skip
        return seen.bool()


def mesh_over(vertices: Tensor, faces: Tensor) -> wp.Mesh:
    """Make a Warp mesh that shares the memory of vertices [P, 3] and faces [3 F], on torch's stream."""
    if not vertices.is_cuda:
        return wp.Mesh(points=warp_view(vertices, wp.vec3), indices=warp_view(faces))
    with on_torch_stream(vertices.device):
        return wp.Mesh(points=warp_view(vertices, wp.vec3), indices=warp_view(faces))


def pixel_window(vertices: Tensor, camera: Camera) -> tuple[int, int, int, int]:
    """Return (left, top, columns, rows) of the pixels that a mesh of vertices [P, 3] may touch."""
    view = camera.to(vertices.device)
    points = vertices @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    if bool((points[:, 2] < 1e-3).any()):
        return 0, 0, camera.width, camera.height
    pixels = points @ view.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    low = (pixels.amin(0) - 1).floor().long().tolist()
    high = (pixels.amax(0) + 2).ceil().long().tolist()
    left, top = max(low[0], 0), max(low[1], 0)
    return left, top, max(min(high[0], camera.width) - left, 0), max(min(high[1], camera.height) - top, 0)
