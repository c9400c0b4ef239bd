"""The built-in scene: geometry, rays against float64, written files against their own ground truth."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from reference.raycast import first_hit
from scgs_warp.data import load
from scgs_warp.data.synthetic import builtin
from scgs_warp.data.synthetic.builtin import FIELD_OF_VIEW, make_synthetic, random_camera, sample_surface
from scgs_warp.data.synthetic.figure import PARTS, build_figure
from scgs_warp.data.synthetic.figure_motion import BONES, bone_transforms
from scgs_warp.data.synthetic.orbit_cameras import PlannedPicture, camera_of
from scgs_warp.data.synthetic.raycast import Raycaster
from scgs_warp.data.synthetic.renderer import write_rgba
from scgs_warp.data.synthetic.surface import RigidParts
from scgs_warp.errors import UserError
from scgs_warp.evaluation.motion_metrics import load_ground_truth, score_motion
from scgs_warp.runtime import environment

SIZE = 48


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("synthetic") / "robot"
    return make_synthetic(folder, size=SIZE, train=5, test=2)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_motion_is_rigid_smooth_and_large():
    times = np.linspace(0, 1, 101)
    poses = np.stack([np.stack(list(bone_transforms(float(time)).values())) for time in times])
    rotations = poses[..., :3, :3]
    assert np.abs(rotations @ rotations.swapaxes(-1, -2) - np.eye(3)).max() < 1e-12
    assert np.abs(np.diff(poses, axis=0)).max() < 0.1
    assert np.abs(np.diff(poses, 2, axis=0)).max() < 0.01
    down = poses[:, list(BONES).index("shoulder_right"), :3, 2]
    assert np.degrees(np.arccos(down[0] @ down[-1])) > 90


def test_every_part_has_a_bone_and_fits():
    figure = build_figure()
    assert {part.bone for part in PARTS} <= set(BONES)
    caster = Raycaster(RigidParts(figure, bone_transforms))
    for time in (0.0, 0.3, 0.7, 1.0):
        vertices = caster.pose(time).vertices
        assert vertices.norm(dim=1).max() < 1.36  # the sphere that every camera sees whole
    assert len(figure.faces) == len(figure.face_part) and figure.faces.max() == len(figure.rest) - 1


@pytest.mark.parametrize("seed", range(2))
def test_rays_match_float64(device, seed):
    figure = build_figure()
    surface = RigidParts(figure, bone_transforms)
    caster = Raycaster(surface, device)
    posed = caster.pose(0.2 + 0.5 * seed)
    camera = camera_of(random_camera(np.random.default_rng(seed)), FIELD_OF_VIEW, 20, 20)
    image = caster.render(posed, camera, samples=1).cpu()
    position = camera.position.double()
    ys, xs = torch.meshgrid(torch.arange(20) + 0.5, torch.arange(20) + 0.5, indexing="ij")
    pixels = torch.stack([xs, ys, torch.ones_like(xs)], -1).double().reshape(-1, 3)
    directions = pixels @ torch.linalg.inv(camera.K.double()).T @ camera.viewmat[:3, :3].double()
    vertices = posed.vertices.cpu().double()
    depth = first_hit(vertices, torch.from_numpy(figure.faces).long(), position, directions)
    hit = depth.isfinite().reshape(20, 20)
    assert 20 < int(hit.sum()) < 200
    # A ray through a silhouette's very edge may fall either way.
    assert int(((image[..., 3] > 0.5) != hit).sum()) <= 1
    assert bool((image[..., :3][hit].amax(-1) > 0.02).all())


def test_visibility_matches_float64(device):
    figure = build_figure()
    surface = RigidParts(figure, bone_transforms)
    caster = Raycaster(surface, device)
    posed = caster.pose(0.4)
    camera = camera_of(random_camera(np.random.default_rng(3)), FIELD_OF_VIEW, 64, 64)
    part, local = sample_surface(figure, 200, np.random.default_rng(0))
    transforms = surface.part_transforms(0.4)[part]
    points = np.einsum("pij,pj->pi", transforms[:, :3, :3], local) + transforms[:, :3, 3]
    tensor = torch.from_numpy(points.astype(np.float32)).to(device)
    seen = caster.visible(posed, camera, tensor).cpu()
    position = camera.position.double()
    directions = torch.from_numpy(points) - position
    faces = torch.from_numpy(figure.faces).long()
    depth = first_hit(posed.vertices.cpu().double(), faces, position, directions)
    behind = (1.0 - depth) * directions.norm(dim=1)  # world units between the first hit and the point
    assert bool((behind < 1e-4).any()) and bool((behind > 1e-2).any())
    assert bool(seen[behind < 1e-3].all()) and not bool(seen[behind > 3e-3].any())


def test_written_png_is_not_premultiplied(tmp_path):
    image = np.zeros((2, 2, 4), np.float32)
    image[0, 0] = [0.2, 0.1, 0.05, 0.25]
    image[1, 1] = [0.6, 0.4, 0.2, 1.0]
    write_rgba(tmp_path / "x.png", image)
    pixels = cv2.imread(str(tmp_path / "x.png"), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]]
    assert pixels[0, 0].tolist() == [204, 102, 51, 64]
    assert pixels[1, 1].tolist() == [153, 102, 51, 255]
    assert pixels[0, 1].tolist() == [0, 0, 0, 0]


def test_scene_is_a_data_set(scene):
    train, test = load(scene, "train"), load(scene, "test")
    assert len(train) == 5 and len(test) == 2
    assert train.times.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
    for frame in train:
        assert frame.image.shape == (SIZE, SIZE, 3) and frame.alpha is not None
        assert 0.08 < frame.alpha.mean() < 0.3
        border = torch.cat([frame.alpha[0], frame.alpha[-1], frame.alpha[:, 0], frame.alpha[:, -1]])
        assert border.max() == 0  # nothing is cut off
        assert frame.image[frame.alpha > 0.99].std(0).min() > 0.06  # textured, even at this size
        edge = (frame.alpha > 0.05) & (frame.alpha < 0.95)
        assert edge.sum() > 20  # anti-aliased
        assert frame.camera.position.norm() == pytest.approx(4.0311, rel=1e-4) and frame.camera.position[2] > 0
    positions = torch.stack([frame.camera.position for frame in [*train, *test]])
    assert torch.pdist(positions).min() > 1e-3


def test_every_instant_has_a_view_of_the_front(tmp_path, monkeypatch):
    """Within 60 degrees of where the face and the chest look, among the nine nearest frames."""
    planned: dict[str, list[PlannedPicture]] = {}
    monkeypatch.setattr(builtin, "write_pictures", lambda *given: planned.update(given[3]))
    make_synthetic(tmp_path / "robot", size=8, train=100, test=1)
    views = np.array([picture.camera_to_world for picture in planned["train"]])[:, :3, 3]
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    assert len(views) == 100
    for index, picture in enumerate(planned["train"]):
        near = views[max(0, index - 4) : index + 5]
        for bone in ("head", "torso"):
            front = bone_transforms(picture.time)[bone][:3, :3] @ [0.0, -1.0, 0.0]
            assert np.degrees(np.arccos((near @ front).max())) < 60, (index, bone)


def test_ground_truth_lies_on_the_pictures(scene):
    truth = load_ground_truth(scene)
    assert truth is not None and truth.points.shape[1:] == (2000, 3)
    assert truth.times[0] == 0 and truth.times[-1] == 1 and len(truth.times) == 51
    assert truth.visible.shape == (5, 2000) and 1.8 < truth.height < 2.4
    assert 0.1 < truth.visible.float().mean() < 0.6 and truth.visible.any(0).float().mean() > 0.5
    train = load(scene, "train")
    for view, index in ((0, 0), (2, 25), (4, 50)):
        camera, alpha = train[view].camera, train[view].alpha
        points = truth.points[index][truth.visible[view]] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = points @ camera.K.T
        x, y = (pixels[:, :2] / pixels[:, 2:]).long().T
        # A point may lie in a pixel so little covered that no ray met it.
        assert alpha is not None and (alpha[y, x] > 0).float().mean() > 0.98
    swing = (truth.points[-1] - truth.points[0]).norm(dim=1)
    assert swing.max() > 0.8 and swing.median() > 0.02


def test_ground_truth_scores_itself(scene):
    truth = load_ground_truth(scene)
    assert truth is not None
    score = score_motion(truth, lambda time: truth.points[round(time * 50)])
    assert score.epe == 0 and score.jitter == 0
    static = score_motion(truth, lambda time: truth.points[0])
    assert static.epe > 3 and static.jitter < 0.5


def test_same_bytes_for_any_number_of_threads(tmp_path, all_threads):
    made = []
    for threads in (1, 2):
        environment.configure(threads=threads)
        made.append(contents(make_synthetic(tmp_path / str(threads), size=32, train=2, test=1)))
    assert made[0] == made[1] and len(made[0]) == 7


def test_made_once_and_again_when_asked_for_another(tmp_path):
    folder = tmp_path / "robot"
    make_synthetic(folder, size=16, train=2, test=1)
    calls = []
    make_synthetic(folder, size=16, train=2, test=1, progress=lambda *done: calls.append(done))
    assert not calls
    make_synthetic(folder, size=16, train=2, test=1, seed=1, progress=lambda *done: calls.append(done))
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert json.loads((folder / "synthetic.json").read_text())["seed"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["robot"]


def test_interrupted_leaves_nothing(tmp_path):
    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_synthetic(tmp_path / "robot", size=16, train=2, test=1, progress=interrupt)
    assert not list(tmp_path.iterdir())


def test_other_peoples_folders_stay(tmp_path):
    (tmp_path / "holiday").mkdir()
    (tmp_path / "holiday/photo.jpg").write_bytes(b"x")
    with pytest.raises(UserError, match="holds no synthetic scene") as caught:
        make_synthetic(tmp_path / "holiday", size=16, train=2, test=1)
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="size 0"):
        make_synthetic(tmp_path / "new", size=0)
    assert [path.name for path in tmp_path.iterdir()] == ["holiday"]
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="cannot be made"):
        make_synthetic(tmp_path / "file/scene", size=16, train=2, test=1)
