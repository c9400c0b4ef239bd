"""Random scenes shared by the tests. Everything is drawn on the CPU, so that all devices see the same numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from scgs_warp.types import Camera, Gaussians


def random_gaussians(
    seed: int,
    n: int,
    device: torch.device | str = "cpu",
    *,
    degree: int = 3,
    spread: float = 1.0,
    scale: tuple[float, float] = (0.02, 0.15),
) -> Gaussians:
    """``n`` Gaussians around the origin.

    Args:
        seed: of the generator.
        n: how many.
        device: where they go.
        degree: of the spherical harmonics; ``sh_rest`` is [n, (degree + 1)^2 - 1, 3].
        spread: standard deviation of the means; some lie outside the view of ``random_camera``.
        scale: range of the standard deviations.
    """
    generator = torch.Generator().manual_seed(seed)
    low, high = scale
    quats = torch.randn(n, 4, generator=generator)
    quats *= 0.5 + torch.rand(n, 1, generator=generator)  # not unit, on purpose
    return Gaussians(
        means=(spread * torch.randn(n, 3, generator=generator)).to(device),
        quats=quats.to(device),
        scales=(low + (high - low) * torch.rand(n, 3, generator=generator)).to(device),
        opacities=torch.rand(n, generator=generator).to(device),
        sh_dc=torch.randn(n, 3, generator=generator).to(device),
        sh_rest=(0.3 * torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=generator)).to(device),
    )


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """[4, 4] world-to-camera of an OpenCV camera at ``eye`` that sees ``target`` at the image centre."""
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward])
    viewmat = torch.eye(4, dtype=eye.dtype)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ eye
    return viewmat


def random_camera(
    seed: int, width: int, height: int, device: torch.device | str = "cpu", *, distance: float = 4.0
) -> Camera:
    """A camera that looks at the origin from ``distance``; focal lengths differ, the principal point is off centre."""
    generator = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
    up = torch.randn(3, generator=generator, dtype=torch.float64)
    viewmat = look_at(distance * direction, torch.zeros(3, dtype=torch.float64), up)
    jitter = torch.rand(4, generator=generator, dtype=torch.float64) - 0.5
    K = torch.eye(3, dtype=torch.float64)
    K[0, 0] = max(width, height) * (1.2 + 0.2 * jitter[0])
    K[1, 1] = max(width, height) * (1.2 + 0.2 * jitter[1])
    K[0, 2] = width * (0.5 + 0.1 * jitter[2])
    K[1, 2] = height * (0.5 + 0.1 * jitter[3])
    return Camera(viewmat.float().to(device), K.float().to(device), width, height)


def garden(
    data_root: Path, device: torch.device | str = "cpu", *, count: int | None = None, seed: int = 42
) -> tuple[Gaussians, list[Camera]]:
    """Real points and colours of the garden scene, and its three cameras at 648 x 420.

    The file holds no shapes: scales are U(0, 0.02), quaternions normal, opacities U(0, 1), with a fixed seed.
    ``count`` takes that many points, evenly spread over the file.
    """
    with np.load(data_root / "splats" / "test_garden.npz") as data:
        means = torch.from_numpy(data["means3d"]).float()
        colors = torch.from_numpy(data["colors"]).float() / 255.0
        viewmats = torch.from_numpy(data["viewmats"]).float()
        Ks = torch.from_numpy(data["Ks"]).float()
        width, height = int(data["width"].item()), int(data["height"].item())
    if count is not None:
        picked = torch.linspace(0, len(means) - 1, count, dtype=torch.float64).long()
        means, colors = means[picked], colors[picked]
    n = len(means)
    generator = torch.Generator().manual_seed(seed)
    gaussians = Gaussians(
        means=means.to(device),
        quats=torch.randn(n, 4, generator=generator).to(device),
        scales=(0.02 * torch.rand(n, 3, generator=generator)).to(device),
        opacities=torch.rand(n, generator=generator).to(device),
        sh_dc=((colors - 0.5) / 0.28209479177387814).to(device),
        sh_rest=torch.zeros(n, 0, 3, device=device),
    )
    cameras = [
        Camera(v.contiguous().to(device), K.contiguous().to(device), width, height) for v, K in zip(viewmats, Ks)
    ]
    return gaussians, cameras
