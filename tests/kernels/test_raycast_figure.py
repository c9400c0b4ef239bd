"""Light, highlights and solid textures of the ray caster, against float64."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from reference.raycast import highlight, intersections, light_of
from scgs_warp.data.synthetic.joints import rotation
from scgs_warp.data.synthetic.orbit_cameras import camera_at, camera_of
from scgs_warp.data.synthetic.raycast import Lamp, Raycaster
from scgs_warp.data.synthetic.shading import Shading
from scgs_warp.data.synthetic.solids import rounded_box, slab, torus
from scgs_warp.data.synthetic.surface import Material, Piece, RigidParts, merge, placed
from scgs_warp.kernels import solid_textures as patterns
from scgs_warp.types import Camera

COLORS = ((0.5, 0.3, 0.2), (0.9, 0.8, 0.4), (0.1, 0.4, 0.6))
LAMP = Lamp(spread=0.2, sky_rays=24, key_rays=16, reach=0.6)


def table_and_ball(shine: float = 0.0, kind: int = int(patterns.CLOUDS)) -> RigidParts:
    """A ball and a ring over a slab."""
    look = Material(kind, COLORS, (5.0, 5.0, 5.0), shine, 18.0)
    pieces = [
        Piece(*slab((0.8, 0.8, 0.05), 0.2), look, "world", placed(0.0, 0.0, -0.4)),
        Piece(*rounded_box((0.3, 0.3, 0.3), 0.3, 6), look, "world", placed(0.1, 0.0, 0.0)),
        Piece(*torus(0.2, 0.06, 6), look, "world", placed(-0.4, 0.3, -0.2, rotation(40, 20, 0))),
    ]
    return RigidParts(merge(pieces), lambda time: {"world": np.eye(4)})


def camera(size: int = 40, azimuth: float = -60.0, sine: float = 0.5) -> Camera:
    return camera_of(camera_at(math.radians(azimuth), sine, 4.0), 0.5, size, size)


def geometry(surface: RigidParts) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return vertices, normals and faces in float64, of the same rounded values as the kernel sees."""
    vertices, normals = (torch.from_numpy(values.astype(np.float32)).double() for values in surface.posed(0.0))
    return vertices, normals, torch.from_numpy(surface.faces).long()


@pytest.mark.parametrize("shading", [Shading(), Shading((0.7, 0.2, 0.5), ambient=0.2, diffuse=0.9)])
def test_light_of_vertices_matches_float64(device, shading):
    surface = table_and_ball()
    caster = Raycaster(surface, device, shading, LAMP)
    posed = caster.pose(0.0)
    vertices, normals, faces = geometry(surface)
    key = torch.nn.functional.normalize(torch.tensor(shading.light).double(), dim=0)
    chosen = list(range(0, len(vertices), 17))
    expected = [
        light_of(vertices, faces, vertices[i], normals[i], key, LAMP.spread, LAMP.sky_rays, LAMP.key_rays, LAMP.reach,
                 shading.ambient / 0.5, shading.diffuse / 0.5)
        for i in chosen
    ]  # fmt: skip
    light = torch.stack([light for light, _ in expected])
    shares = torch.tensor([share for _, share in expected])
    assert len(chosen) > 30 and (shares == 0).any() and (shares == shading.diffuse / 0.5).any()
    assert ((shares > 0) & (shares < shading.diffuse / 0.5)).any()  # penumbra
    wrong = (posed.light.cpu()[chosen].double() - light).abs().amax(1)
    # A ray through a silhouette's very edge may fall either way.
    assert wrong.median() < 1e-6 and (wrong > 1e-5).sum() <= 2 and wrong.max() < 0.1
    assert ((posed.key.cpu()[chosen].double() - shares).abs() > 1e-5).sum() <= 2


def test_highlights_match_float64(device):
    """The difference between pictures with and without a highlight."""
    seen = camera()
    pictures = []
    for shine in (0.0, 0.3):
        caster = Raycaster(table_and_ball(shine), device, Shading(diffuse=0.3), LAMP)
        posed = caster.pose(0.0)
        pictures.append(caster.render(posed, seen, samples=1).cpu().double())
    added = pictures[1] - pictures[0]
    vertices, normals, faces = geometry(table_and_ball())
    key = torch.nn.functional.normalize(torch.tensor(Shading().light).double(), dim=0)
    origin, turn = seen.position.double(), seen.viewmat[:3, :3].double()
    to_pixel, compared, largest = torch.linalg.inv(seen.K.double()).T, 0, 0.0
    for y, x in np.ndindex(40, 40):
        if pictures[1][y, x, 3] < 0.5 or pictures[1][y, x, :3].max() > 0.999 or (x + y) % 3:
            continue
        direction = torch.tensor([x + 0.5, y + 0.5, 1.0]).double() @ to_pixel @ turn
        direction = direction / direction.norm()
        t, u, v = intersections(vertices, faces, origin, direction)
        hit = int(t.argmin())
        shares = torch.stack([1 - u[hit] - v[hit], u[hit], v[hit]])
        if not bool(t[hit].isfinite()) or shares.min() < 1e-3:
            continue
        normal = torch.nn.functional.normalize(shares @ normals[faces[hit]], dim=0)
        lit = float(shares @ posed.key.cpu().double()[faces[hit]])
        expected = 0.3 * lit * highlight(normal, key, -direction, 18.0)
        wanted = torch.tensor([1.0, 0.97, 0.9]).double() * expected
        assert (added[y, x, :3] - wanted).abs().max() < 2e-4, (y, x)
        compared, largest = compared + 1, max(largest, expected)
    assert compared > 100 and largest > 0.1
    assert bool((added[..., 3] == 0).all())


def test_unlit_shows_the_texture_alone(device):
    surface = table_and_ball(0.5)
    plain = Raycaster(surface, device, Shading(unlit=True), LAMP)
    dark = Raycaster(surface, device, Shading(ambient=0.0, diffuse=0.0), LAMP)
    image = plain.render(plain.pose(0.0), camera(), 1).cpu()
    assert image[..., :3].max() < 1.0 and image[..., 3].mean() > 0.2
    black = dark.render(dark.pose(0.0), camera(), 1).cpu()
    assert black[..., :3].max() == 0.0 and torch.equal(black[..., 3], image[..., 3])


@pytest.mark.parametrize("kind", range(int(patterns.LEAF) + 1))
def test_textures_have_detail_and_move_with_the_surface(device, kind):
    """A camera that moves with the body sees the same picture."""
    look = Material(kind, COLORS, (7.0, 7.0, 7.0))
    mesh = merge([Piece(*rounded_box((0.5, 0.5, 0.5), 0.3, 8), look, "body", np.eye(4))])
    moved = placed(0.2, -0.1, 0.15, rotation(30, -20, 50))
    pictures = []
    for transform in (np.eye(4), moved):
        surface = RigidParts(mesh, lambda time, transform=transform: {"body": transform})
        caster = Raycaster(surface, device, Shading(unlit=True))
        view = camera_of(transform @ camera_at(-1.0, 0.4, 4.0), 0.4, 40, 40)
        pictures.append(caster.render(caster.pose(0.0), view, 2).cpu())
    inside = (pictures[0][..., 3] > 0.999) & (pictures[1][..., 3] > 0.999)
    assert inside.sum() > 300 and pictures[0][inside][:, :3].std(0).max() > 0.03
    # A ray at the edge of a pattern may fall either way.
    assert ((pictures[0] - pictures[1])[inside].abs().amax(1) > 0.02).float().mean() < 0.05
