"""What each of the other subjects promises: turns, contact, opening, folds, and standing almost still."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from scgs_warp.data.synthetic.joints import rotation
from scgs_warp.data.synthetic.orbit_cameras import FilmingSettings, camera_at, camera_of, plan_pictures
from scgs_warp.data.synthetic.shading import Shading
from scgs_warp.data.synthetic.surface import PartMesh, placed
from scgs_warp.data.synthetic.zoo.cloth import HALF_THICKNESS, HEIGHT, WIDTH, Cloth
from scgs_warp.data.synthetic.zoo.fan import BLADES, blade_angle, fan_transforms, make_fan
from scgs_warp.data.synthetic.zoo.opening import make_opening
from scgs_warp.data.synthetic.zoo.still import make_still
from scgs_warp.data.synthetic.zoo.touch import CONTACT, GAP, make_touch, squashed


def of_bone(mesh: PartMesh, *bones: str) -> np.ndarray:
    """Return [P] bool: vertices on one of the bones."""
    return np.array([bone in bones for bone in mesh.bones])[mesh.vertex_part]


def test_fan_turns_slowly_enough_to_follow():
    angles = np.array([blade_angle(time) for time in np.linspace(0, 1, 100)])
    steps = np.diff(angles)
    assert steps.min() > 10.0 and steps.max() < 25.0 and angles[-1] - angles[0] == pytest.approx(5 * 360)
    # The transforms turn by the same angles.
    for time in (0.2, 0.7):
        pair = [np.linalg.inv(fan_transforms(t)["head"]) @ fan_transforms(t)["blades"] for t in (time, time + 0.01)]
        turn = pair[0][:3, :3].T @ pair[1][:3, :3]
        expected = blade_angle(time + 0.01) - blade_angle(time)
        assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) == pytest.approx(expected, abs=1e-6)


def test_blades_can_be_told_apart():
    """Turned by a fifth, the fan looks different."""
    subject = make_fan("cpu", Shading(unlit=True))
    view = camera_of(camera_at(-np.pi / 2, 0.1, 4.03), 0.69, 100, 100)
    pictures = []
    for fifth in range(len(BLADES)):
        turn = placed(turn=rotation(0.0, 72.0 * fifth, 0.0))
        subject.surface.bone_transforms = lambda time, turn=turn: {
            **fan_transforms(time), "blades": fan_transforms(time)["blades"] @ turn
        }  # fmt: skip
        pictures.append(subject.render(subject.pose(0.0), view, 2))
    for other in pictures[1:]:
        assert (other[..., 3] - pictures[0][..., 3]).abs().mean() < 0.002  # the same outline
        assert (other - pictures[0])[..., :3].abs().mean() > 0.01


def test_bodies_touch_and_part():
    subject = make_touch("cpu", Shading())
    first = len(subject.surface.surfaces[0].rest)

    def distance(time: float) -> float:
        vertices = subject.surface.posed(time)[0]
        return float(cKDTree(vertices[:first]).query(vertices[first:])[0].min())

    assert distance(0.0) > 0.5 and distance(1.0) > 0.5
    start, end = CONTACT
    for time in np.linspace(start, end, 7):
        assert 0.0 < distance(float(time)) < 0.01
    vertices = subject.surface.posed(0.5)[0]
    near = cKDTree(vertices[:first]).query(vertices[first:])[0] < 0.02
    assert near.sum() > 40  # an area, not a point


def test_squashed_bodies_do_not_pass_through_each_other():
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (500, 3))
    for limit in (0.25, 0.4, 0.8):
        moved = squashed(points, limit)
        assert moved[:, 0].max() < limit - GAP
        behind = points[:, 0] < limit - 0.2
        assert np.abs(moved[behind, 0] - points[behind, 0]).max() < 1e-4


def test_chest_hides_its_inside_until_it_opens():
    subject = make_opening("cpu", Shading())
    mesh = subject.surface.mesh
    gem = np.zeros(len(mesh.bones), bool)
    gem[-26:] = True
    inside = torch.from_numpy(of_bone(mesh, "upper", "lower", "yolk") | gem[mesh.vertex_part])
    filming = FilmingSettings(width=100, height=100, train=12)
    pictures = plan_pictures(filming, np.random.default_rng(0))["train"]
    seen = {}
    for time in (0.0, 0.6, 1.0):
        posed = subject.pose(time)
        everything = torch.zeros(len(mesh.rest), dtype=torch.bool)
        for picture in pictures:
            camera = camera_of(picture.camera_to_world, np.radians(filming.fov), 100, 100)
            everything |= subject.visible(posed, camera, posed.vertices)
        seen[time] = everything
    assert not (seen[0.0] & inside).any() and seen[0.0].sum() > 2000
    assert (seen[0.6] & inside).sum() > 500
    yolk = torch.from_numpy(of_bone(mesh, "yolk"))
    assert not (seen[0.6] & yolk).any() and (seen[1.0] & yolk).sum() > 30  # the egg is closed, then halved


def test_cloth_keeps_its_length_and_bends():
    cloth = Cloth()
    flat = cloth.rest.reshape(-1, 3)
    assert flat[:, 0].max() == pytest.approx(WIDTH) and flat[:, 2].max() == pytest.approx(HEIGHT)
    reach = []
    for time in np.linspace(0, 1, 21):
        middle = cloth.middle(float(time))
        level = middle.copy()
        level[..., 2] = 0.0
        lengths = np.linalg.norm(np.diff(level, axis=0), axis=-1).sum(0)
        assert np.abs(lengths - WIDTH).max() < 1e-9  # along each horizontal line
        sag = np.linalg.norm(np.diff(middle, axis=0), axis=-1).sum(0)
        assert sag.max() < 1.01 * WIDTH
        reach.append(np.ptp(middle[..., 1]))
        vertices, normals = cloth.posed(float(time))
        count = cloth.u.size
        assert np.allclose(np.linalg.norm(vertices[:count] - vertices[count : 2 * count], axis=1), 2 * HALF_THICKNESS)
        assert (normals[:count] * normals[count : 2 * count]).sum(1).max() < -0.95
    assert min(reach) > 0.2 and max(reach) > 0.5


def test_cloth_does_not_pass_through_itself():
    """Points far apart on the cloth stay more than its thickness apart."""
    cloth = Cloth()
    for time in np.linspace(0, 1, 41):
        middle = cloth.middle(float(time))[::3, ::3].reshape(-1, 3)
        flat = np.stack([cloth.u[::3, ::3], cloth.v[::3, ::3]], -1).reshape(-1, 2)
        pairs = cKDTree(middle).query_pairs(0.03, output_type="ndarray")
        if len(pairs):
            assert np.linalg.norm(flat[pairs[:, 0]] - flat[pairs[:, 1]], axis=1).max() < 0.1


def test_plant_moves_by_a_few_per_cent():
    surface = make_still("cpu", Shading()).surface
    poses = np.stack([surface.posed(time)[0] for time in np.linspace(0, 1, 41)])
    size = np.ptp(poses[0], axis=0).max()
    moved = np.linalg.norm(poses - poses[0], axis=-1).max(0)
    assert 0.01 < moved.max() / size < 0.06
    assert (moved > 0.005 * size).mean() > 0.25
