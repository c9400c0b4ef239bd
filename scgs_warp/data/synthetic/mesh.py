"""A glTF scene as a ``Subject`` of the renderer: fitted into the room and uploaded for ray casting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor

from ...errors import UserError
from ...kernels import raycast_mesh as kernels
from ...runtime.launch import launch
from ...types import Camera
from ..gltf.scene import GltfScene
from .raycast import TOLERANCE, mesh_over, pixel_window
from .renderer import ROOM_RADIUS, SurfacePoints, points_on_triangles
from .shading import Shading

FIT_TIMES = 101
"""Number of instants of the clip at which the extent of the mesh is measured."""
RAY_OFFSET = 1e-5
"""Distance behind a transparent surface at which a ray continues, in room radii."""
MAX_RAY_LENGTH = 1000.0


class PosedMesh(NamedTuple):
    """The mesh at one instant, ready for queries."""

    mesh: wp.Mesh
    vertices: Tensor
    """[P, 3] world; the mesh shares this memory."""
    normals: Tensor
    """[P, 3]"""


def srgb_to_linear() -> np.ndarray:
    """Return the linear value of each sRGB byte, [256] float32 (IEC 61966-2-1)."""
    x = np.arange(256) / 255.0
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


class MeshSubject:
    """Poses, pictures and tracks of a glTF scene. ``time`` from 0 to 1 covers ``span``, in seconds of the clip."""

    def __init__(self, scene: GltfScene, span: tuple[float, float], shading: Shading, device: str = "cpu") -> None:
        """
        Raises:
            UserError: the scene has no extent.
        """
        self.scene = scene
        self.span = span
        self.shading = shading
        self.device = device
        self._fit()
        direction = np.asarray(shading.light, np.float64)
        triangles = scene.triangles
        self.faces = torch.from_numpy(triangles.faces.reshape(-1).copy()).to(device)
        self.material = torch.from_numpy(triangles.material).to(device)
        self.uv = self._tensor(triangles.uv)
        self.colors = self._tensor(triangles.colors)
        self.light = self._tensor(direction[None] / np.linalg.norm(direction))
        self.decode = self._tensor(srgb_to_linear())
        self._upload_materials()

    def _tensor(self, values) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(self.device)

    def seconds(self, time: float) -> float:
        """Convert ``time`` in [0, 1] to seconds of the clip."""
        return self.span[0] + time * (self.span[1] - self.span[0])

    def _fit(self) -> None:
        """Translate and scale the scene so that it lies in a ball of radius ``ROOM_RADIUS`` around the origin at all
        times."""
        times = np.linspace(0.0, 1.0, FIT_TIMES if self.scene.clip else 1)
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for time in times:
            positions = self.scene.posed(self.seconds(float(time))).positions
            low, high = np.minimum(low, positions.min(0)), np.maximum(high, positions.max(0))
        centre = (low + high) / 2
        radius = 0.0
        for time in times:
            positions = self.scene.posed(self.seconds(float(time))).positions
            radius = max(radius, float(np.linalg.norm(positions - centre, axis=1).max()))
        if not np.isfinite(radius) or radius <= 0.0:
            raise UserError(f"{self.scene.path}: meshes have no extent (radius {radius:g}); export a surface")
        fitted = np.eye(4)
        fitted[:3, :3] *= ROOM_RADIUS / radius
        fitted[:3, 3] = -centre * ROOM_RADIUS / radius
        self.scene.world_from_gltf = fitted @ self.scene.world_from_gltf

    def _upload_materials(self) -> None:
        materials, textures = self.scene.materials, self.scene.textures
        backs, unlit = self.shading.two_sided, self.shading.unlit
        kinds = [(m.texture, m.alpha_mode, int(m.double_sided or backs), int(m.unlit or unlit)) for m in materials]
        self.factors = self._tensor([m.factor for m in materials])
        self.cutoffs = self._tensor([m.cutoff for m in materials])
        self.kinds = torch.tensor(kinds, dtype=torch.int32, device=self.device)
        rows, texels, offset = [], [], 0
        for texture in textures:
            height, width = texture.pixels.shape[:2]
            rows.append((offset, width, height, *texture.wrap, int(texture.nearest)))
            texels.append(texture.pixels.reshape(-1, 4))
            offset += width * height
        if not textures:  # Kernels need the address of at least one element.
            rows, texels = [(0, 1, 1, 0, 0, 0)], [np.zeros((1, 4), np.uint8)]
        self.textures = torch.tensor(rows, dtype=torch.int32, device=self.device)
        self.texels = torch.from_numpy(np.concatenate(texels)).to(self.device)

    def _surface(self) -> tuple[Tensor, ...]:
        """Return the kernel arguments that describe the surface."""
        return (self.uv, self.colors, self.material, self.factors, self.kinds, self.cutoffs, self.texels,
                self.textures, self.decode)  # fmt: skip

    def pose(self, time: float) -> PosedMesh:
        """Pose the scene at ``time`` in [0, 1]."""
        vertices = self.scene.posed(self.seconds(time))
        points, normals = self._tensor(vertices.positions), self._tensor(vertices.normals)
        return PosedMesh(mesh_over(points, self.faces), points, normals)

    def render(self, posed: PosedMesh, camera: Camera, samples: int) -> Tensor:
        """Render [H, W, 4] premultiplied colour and coverage with ``samples`` x ``samples`` rays per pixel."""
        image = torch.zeros(camera.height, camera.width, 4, device=self.device)
        left, top, columns, rows = pixel_window(posed.vertices, camera)
        camera_to_world = torch.linalg.inv(camera.viewmat.double())[:3].float().contiguous().to(self.device)
        launch(
            kernels.raycast_mesh, columns * rows, posed.mesh.id, self.faces, posed.normals, *self._surface(),
            self.light, self.shading.ambient, self.shading.diffuse, camera_to_world, camera.K.to(self.device), left,
            top, columns, samples, RAY_OFFSET * ROOM_RADIUS, MAX_RAY_LENGTH, image, grain=64,
        )  # fmt: skip
        return image

    def share_of_backs(self, views: Sequence[tuple[float, Camera]]) -> float:
        """Return the share of the subject's pixels, over some times and cameras, that only the backs of surfaces cover
        which the file shows from one side."""
        shown, all_shown = self.kinds, self.kinds.clone()
        all_shown[:, 2] = 1
        if torch.equal(shown, all_shown):
            return 0.0
        covered = [0.0, 0.0]
        try:
            for time, camera in views:
                posed = self.pose(time)
                for index, kinds in enumerate((shown, all_shown)):
                    self.kinds = kinds
                    covered[index] += float(self.render(posed, camera, 1)[..., 3].sum())
        finally:
            self.kinds = shown
        return max(0.0, 1.0 - covered[0] / covered[1]) if covered[1] > 0 else 0.0

    def visible(self, posed: PosedMesh, camera: Camera, points: Tensor) -> Tensor:
        """Return [P] bool, True for surface points [P, 3] that the camera sees."""
        seen = torch.empty(len(points), dtype=torch.int32, device=self.device)
        launch(
            kernels.visible_on_mesh, len(points), posed.mesh.id, points, self.faces, *self._surface(),
            camera.viewmat.to(self.device), camera.K.to(self.device), camera.width, camera.height, TOLERANCE,
            RAY_OFFSET * ROOM_RADIUS, seen,
        )  # fmt: skip
        return seen.bool()

    def sample(self, count: int, rng: np.random.Generator) -> SurfacePoints:
        """Sample points evenly by area over the surface at time 0.

        Raises:
            UserError: the surface has no area at time 0.
        """
        positions = self.scene.posed(self.seconds(0.0)).positions
        a, b, c = positions[self.scene.triangles.faces].transpose(1, 0, 2)
        if not np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() > 0:
            second = f"{self.seconds(0.0):g}"
            raise UserError(f"{self.scene.path}: the surface has no area at second {second}; give a later --start")
        return points_on_triangles(positions, self.scene.triangles.faces, count, rng)

    def track(self, points: SurfacePoints, times) -> np.ndarray:
        """Return world positions [T, P, 3] float64 of surface points."""
        corners = self.scene.triangles.faces[points.face]
        tracks = []
        for time in times:
            positions = self.scene.posed(self.seconds(float(time))).positions
            tracks.append(np.einsum("pk,pki->pi", points.shares, positions[corners]))
        return np.stack(tracks)
