"""Every ray against every triangle, and the light of a surface, float64 (Moeller and Trumbore 1997; Blinn 1977)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

GOLDEN = math.pi * (3.0 - math.sqrt(5.0))
HORIZON, ZENITH = (0.47, 0.43, 0.42), (0.66, 0.69, 0.74)
KEY = (0.50, 0.47, 0.41)
OFFSET = 2.0e-3


def intersections(vertices: Tensor, faces: Tensor, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return t, u and v [F] of one ray with every triangle, t infinite where it misses."""
    a, b, c = vertices[faces].unbind(1)
    first, second = b - a, c - a
    p = torch.linalg.cross(direction.expand_as(second), second)
    determinant = (first * p).sum(1)
    safe = torch.where(determinant.abs() > 1e-14, determinant, torch.full_like(determinant, float("nan")))
    offset = origin - a
    u = (offset * p).sum(1) / safe
    q = torch.linalg.cross(offset, first)
    v = (q * direction).sum(1) / safe
    t = (second * q).sum(1) / safe
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return torch.where(inside, t, torch.full_like(t, float("inf"))), u, v


def first_hit(vertices: Tensor, faces: Tensor, origin: Tensor, directions: Tensor) -> Tensor:
    """[R] smallest t > 0 at which ``origin + t * direction`` meets a triangle, infinity where none.

    Args:
        vertices: [P, 3]
        faces: [F, 3]
        origin: [3]
        directions: [R, 3], any length.
    """
    return torch.stack([intersections(vertices, faces, origin, direction)[0].min() for direction in directions])


def blocked(vertices: Tensor, faces: Tensor, origin: Tensor, direction: Tensor, reach: float) -> bool:
    """Return whether the first triangle on a ray is within ``reach`` and shows its front."""
    t, _, _ = intersections(vertices, faces, origin, direction)
    hit = int(t.argmin())
    a, b, c = vertices[faces[hit]]
    return bool(t[hit] < reach) and float(torch.linalg.cross(b - a, c - a) @ direction) < 0


def lattice(count: int, rotation: float) -> Tensor:
    """[count, 3] directions of a spherical Fibonacci lattice."""
    index = torch.arange(count, dtype=torch.float64)
    z = 1.0 - (2.0 * index + 1.0) / count
    radius, angle = (1.0 - z * z).clamp(min=0).sqrt(), GOLDEN * index + rotation
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], 1)


def light_of(
    vertices: Tensor, faces: Tensor, point: Tensor, normal: Tensor, key: Tensor, spread: float, sky_rays: int,
    key_rays: int, reach: float, ambient: float, diffuse: float,
) -> tuple[Tensor, float]:  # fmt: skip
    """Return the irradiance [3] of a surface point, and the strength of the key light times its visible share."""
    origin = point + normal * OFFSET
    dome = [(d, float(d @ normal)) for d in lattice(sky_rays, 0.0) if float(d @ normal) > 0.05]
    sky = sum(cosine for d, cosine in dome if not blocked(vertices, faces, origin, d, reach))
    openness = sky / sum(cosine for _, cosine in dome)
    toward = torch.nn.functional.normalize(key + lattice(key_rays, 1.0) * spread, dim=1)
    lit = [d for d in toward if float(d @ normal) > 0 and not blocked(vertices, faces, origin, d, math.inf)]
    sun = sum(float(d @ normal) for d in lit) / key_rays
    up = 0.5 + 0.5 * float(normal[2])
    tint = torch.tensor(HORIZON).double().lerp(torch.tensor(ZENITH).double(), up)
    light = tint * (0.45 + 0.55 * openness) * ambient + torch.tensor(KEY).double() * sun * diffuse
    return light, len(lit) / key_rays * diffuse


def highlight(normal: Tensor, toward_light: Tensor, toward_eye: Tensor, exponent: float) -> float:
    """Return the highlight of Blinn and Phong for unit vectors [3]."""
    half = torch.nn.functional.normalize(toward_light + toward_eye, dim=0)
    return max(float(normal @ half), 0.0) ** exponent


def first_hit_on(
    vertices: Tensor, faces: Tensor, camera_to_world: Tensor, K: Tensor, x: float, y: float
) -> tuple[int, Tensor, float]:
    """Return the face that the ray through pixel position (x, y) hits first (-1: none), the barycentric coordinates [3]
    of the hit, and its depth along the optical axis.

    Args:
        camera_to_world: [3, 4], OpenCV.
    """
    local = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones((), dtype=K.dtype)])
    t, u, v = intersections(vertices, faces, camera_to_world[:, 3], camera_to_world[:, :3] @ local)
    face = int(t.argmin())
    if not math.isfinite(float(t[face])):
        return -1, torch.zeros(3, dtype=K.dtype), 0.0
    return face, torch.stack([1.0 - u[face] - v[face], u[face], v[face]]), float(t[face])
