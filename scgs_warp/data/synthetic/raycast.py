"""Ray casting of the built-in figure with Warp's mesh queries, on tensors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor

from ...kernels import raycast_figure as kernels
from ...runtime.cuda_graph import warp_stream
from ...runtime.launch import launch, warp_view
from ...types import Camera
from .figure import PARTS, Figure, Part
from .figure_motion import bone_transforms

LIGHT = (-0.42, -0.62, 0.66)
"""Direction to the key light: above and in front of the figure, on its right."""
LIGHT_SPREAD = 0.35
SKY_RAYS, KEY_RAYS = 40, 16
OCCLUSION_REACH = 0.5
TOLERANCE = 2e-3
"""Largest distance behind the first hit of a ray at which a point counts as visible, world units."""


class PosedFigure(NamedTuple):
    """The figure at one time, ready for ray queries."""

    mesh: wp.Mesh
    vertices: Tensor
    """[P, 3] world; the mesh shares this memory."""
    light: Tensor
    """[P, 3] irradiance."""


class Raycaster:
    """Ray caster for one figure on one device; constant data is uploaded once."""

    def __init__(self, figure: Figure, device: str = "cpu", parts: tuple[Part, ...] = PARTS) -> None:
        self.figure = figure
        self.device = device
        self.bones = [part.bone for part in parts]
        self.rest = self._tensor(figure.rest)
        self.faces = torch.from_numpy(figure.faces.reshape(-1)).to(device)
        self.face_part = torch.from_numpy(figure.face_part).to(device)
        self.kinds = torch.tensor([part.kind for part in parts], dtype=torch.int32, device=device)
        self.colors = self._tensor([part.colors for part in parts])
        self.frequencies = self._tensor([part.frequency for part in parts])
        self.light_direction = torch.nn.functional.normalize(self._tensor([LIGHT]), dim=1)

    def _tensor(self, values) -> Tensor:
        return torch.as_tensor(np.asarray(values, np.float32)).to(self.device)

    def part_transforms(self, time: float) -> np.ndarray:
        """Return bone-to-world [parts, 4, 4] of each part."""
        transforms = bone_transforms(time)
        return np.stack([transforms[bone] for bone in self.bones])

    def pose(self, time: float) -> PosedFigure:
        """Pose and light the figure at ``time`` in [0, 1]."""
        transforms = self.part_transforms(time)[self.figure.vertex_part]
        vertices = np.einsum("pij,pj->pi", transforms[:, :3, :3], self.figure.local) + transforms[:, :3, 3]
        normals = np.einsum("pij,pj->pi", transforms[:, :3, :3], self.figure.normals)
        points, directions = self._tensor(vertices), self._tensor(normals)
        mesh = mesh_over(points, self.faces)
        light = torch.empty_like(points)
        launch(
            kernels.light_vertices, len(points), mesh.id, points, directions, self.light_direction, LIGHT_SPREAD,
            SKY_RAYS, KEY_RAYS, OCCLUSION_REACH, light, grain=64,
        )  # fmt: skip
        return PosedFigure(mesh, points, light)

    def render(self, posed: PosedFigure, camera: Camera, samples: int = 4) -> Tensor:
        """Render [H, W, 4] premultiplied colour and coverage with ``samples`` x ``samples`` rays per pixel."""
        image = torch.zeros(camera.height, camera.width, 4, device=self.device)
        left, top, columns, rows = pixel_window(posed.vertices, camera)
        camera_to_world = torch.linalg.inv(camera.viewmat.double())[:3].float().contiguous().to(self.device)
        launch(
            kernels.raycast, columns * rows, posed.mesh.id, self.faces, self.rest, posed.light, self.face_part,
            self.kinds, self.colors, self.frequencies, camera_to_world, camera.K.to(self.device), left, top, columns,
            samples, image, grain=64,
        )  # fmt: skip
        return image

    def visible(self, posed: PosedFigure, camera: Camera, points: Tensor) -> Tensor:
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
    with wp.ScopedStream(warp_stream(vertices.device)):
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
