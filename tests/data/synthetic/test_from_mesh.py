"""Filming: rays against analytic squares, tracks on their pixels, cameras, the written folder, the app's mistakes."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from helpers.gltf_files import Glb, bar, box, quad
from reference.raycast import first_hit

pytest.importorskip("pygltflib")

from helpers.paths import ROOT
from scgs_warp.data import load
from scgs_warp.data.gltf.scene import read_scene
from scgs_warp.data.synthetic.contact_sheet import project
from scgs_warp.data.synthetic.from_mesh import SynthesisRequest, check, plan_synthesis, synthesize
from scgs_warp.data.synthetic.mesh import MeshSubject, srgb_to_linear
from scgs_warp.data.synthetic.orbit_cameras import FilmingSettings, camera_at, camera_distance, camera_of
from scgs_warp.data.synthetic.renderer import ROOM_RADIUS, subject_height
from scgs_warp.data.synthetic.shading import Shading
from scgs_warp.errors import UserError
from scgs_warp.evaluation.motion_metrics import load_ground_truth, score_motion
from scgs_warp.runtime import environment
from scgs_warp.types import Camera

HALF = ROOM_RADIUS / math.sqrt(0.5) / 2
"""Half the side of the unit square after it was fitted into the room."""
UNLIT = Shading(unlit=True)


def subject_of(glb: Glb, folder: Path, shading: Shading = UNLIT, device: str = "cpu") -> MeshSubject:
    scene = read_scene(glb.save(folder / "x.glb"))
    clip = scene.clip
    return MeshSubject(scene, (clip.start, clip.end) if clip else (0.0, 0.0), shading, device)


def front(size: int = 40, azimuth: float = -90.0, sine: float = 0.0) -> Camera:
    """In front of what faces -y, so far away that the room fills the picture."""
    return camera_of(camera_at(math.radians(azimuth), sine, 4.0311), 0.6911, size, size)


def picture(subject: MeshSubject, camera: Camera, samples: int = 1, time: float = 0.0) -> np.ndarray:
    return subject.render(subject.pose(time), camera, samples).cpu().numpy()


def on_square(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(u, v) in texture coordinates of the pixels' middle rays on the square in the plane y = 0; analytic."""
    n = camera.width
    ys, xs = np.meshgrid(np.arange(n) + 0.5, np.arange(n) + 0.5, indexing="ij")
    focal, depth = float(camera.K[0, 0]), 4.0311
    x, z = (xs - n / 2) / focal * depth, -(ys - n / 2) / focal * depth
    return x / (2 * HALF) + 0.5, 0.5 - z / (2 * HALF)


def checker(rows: int = 4, columns: int = 3) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (rows, columns, 3), np.uint8)


def test_silhouette_and_nearest_texels_are_where_they_must_be(tmp_path, device):
    """An orientation error of the world, of the texture or of the camera shows here."""
    pixels = checker()
    subject = subject_of(quad(pixels, {"magFilter": 9728}), tmp_path, device=device)
    image = picture(subject, front())
    u, v = on_square(front())
    inside = (abs(u - 0.5) < 0.5) & (abs(v - 0.5) < 0.5)
    assert np.array_equal(image[..., 3] > 0.5, inside) and 300 < inside.sum() < 1000
    rows, columns = (v[inside] * 4).astype(int), (u[inside] * 3).astype(int)
    assert np.abs(image[inside][:, :3] - pixels[rows, columns] / 255.0).max() < 1e-5
    assert (image[~inside] == 0).all()


@pytest.mark.parametrize("wrap", [10497, 33071, 33648])
def test_bilinear_texture_in_linear_light(tmp_path, device, wrap):
    pixels = checker()
    subject = subject_of(quad(pixels, {"wrapS": wrap, "wrapT": wrap}), tmp_path, device=device)
    image = picture(subject, front())
    u, v = on_square(front())
    inside = (abs(u - 0.5) < 0.499) & (abs(v - 0.5) < 0.499)
    linear = srgb_to_linear().astype(np.float64)[pixels]

    def at(row: np.ndarray, column: np.ndarray) -> np.ndarray:
        if wrap == 10497:
            return linear[row % 4, column % 3]
        return linear[row.clip(0, 3), column.clip(0, 2)]  # half a texel out, a mirror shows the same texel

    x, y = u[inside] * 3 - 0.5, v[inside] * 4 - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    mixed = (at(top, left) * (1 - fx) + at(top, left + 1) * fx) * (1 - fy) + (
        at(top + 1, left) * (1 - fx) + at(top + 1, left + 1) * fx
    ) * fy
    expected = np.where(mixed <= 0.0031308, 12.92 * mixed, 1.055 * mixed ** (1 / 2.4) - 0.055)
    assert np.abs(image[inside][:, :3] - expected).max() < 2e-4


def srgb(x: float) -> float:
    return 12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055


def test_one_light_and_lambert(tmp_path, device):
    """The square faces -y: cosine of the light with it, sky light for a level normal, factors in linear light."""
    glb = quad(pbr={"baseColorFactor": [0.5, 0.25, 0.01, 1.0]})
    shading = Shading(light=(0.0, -3.0, 4.0), ambient=0.4, diffuse=0.5)
    image = picture(subject_of(glb, tmp_path, shading, device), front())
    light = 0.4 * 0.75 + 0.5 * 0.6
    expected = [srgb(0.5 * light), srgb(0.25 * light), srgb(0.01 * light), 1.0]
    assert np.abs(image[20, 20] - expected).max() < 1e-5
    behind = picture(subject_of(glb, tmp_path, Shading(light=(0, 1, 0), ambient=0.4), device), front())
    assert behind[20, 20, 0] == pytest.approx(srgb(0.5 * 0.4 * 0.75), abs=1e-5)


@pytest.mark.parametrize("given", [True, False])
def test_both_sides_are_lit_from_where_they_look(tmp_path, device, given):
    glb = quad(doubleSided=True)
    if given:
        attributes = glb.document["meshes"][0]["primitives"][0]["attributes"]
        attributes["NORMAL"] = glb.array([[0, 0, 1]] * 4)
    subject = subject_of(glb, tmp_path, Shading((0, 1, 0), ambient=0.4, diffuse=0.3), device)
    lit, dark = picture(subject, front(azimuth=90.0))[20, 20, 0], picture(subject, front())[20, 20, 0]
    assert lit == pytest.approx(srgb(0.6), abs=1e-5) and dark == pytest.approx(srgb(0.3), abs=1e-5)


def test_backs_alpha_cutoff_and_translucency(tmp_path, device):
    pixels = np.zeros((1, 2, 4), np.uint8)
    pixels[0, 0], pixels[0, 1] = [255, 0, 0, 100], [0, 255, 0, 200]
    nearest = {"magFilter": 9728}
    back = front(azimuth=90.0)

    def made(**material) -> MeshSubject:
        return subject_of(quad(pixels, nearest, **material), tmp_path, device=device)

    assert (picture(made(), front())[20, [10, 30], 3] == 1).all() and picture(made(), back).max() == 0
    assert (picture(made(doubleSided=True), back)[20, [10, 30], 3] == 1).all()
    assert picture(made(alphaMode="MASK"), front())[20, [10, 30], 3].tolist() == [0, 1]
    assert picture(made(alphaMode="MASK", alphaCutoff=0.2), front())[20, [10, 30], 3].tolist() == [1, 1]
    blended = picture(made(alphaMode="BLEND"), front())
    assert np.abs(blended[20, [10, 30]] - [[100 / 255, 0, 0, 100 / 255], [0, 200 / 255, 0, 200 / 255]]).max() < 1e-5


def test_what_a_hole_shows_is_visible(tmp_path, device):
    """Points behind a texel under the cutoff are seen, those behind an opaque one are not."""
    pixels = np.full((1, 2, 4), 255, np.uint8)
    pixels[0, 0, 3] = 0
    glb = quad(pixels, {"magFilter": 9728}, alphaMode="MASK")
    wall = glb.document["meshes"][0]["primitives"][0]
    glb.add(
        "meshes", primitives=[{"attributes": {"POSITION": wall["attributes"]["POSITION"]}, "indices": wall["indices"]}]
    )
    glb.document["nodes"] = [{"mesh": 0, "translation": [0, 0, 0.5]}, {"mesh": 1}]
    glb.document["scenes"] = [{"nodes": [0, 1]}]
    subject = subject_of(glb, tmp_path, device=device)
    positions = subject.scene.posed(0.0).positions
    hole, wall, aside = positions[:4].mean(0), positions[4:].mean(0), np.array([0.2, 0.0, 0.0])
    points = np.stack([wall - aside, wall + aside, hole + aside, hole - aside]).astype(np.float32)
    seen = subject.visible(subject.pose(0.0), front(), torch.from_numpy(points).to(device))
    assert seen.tolist() == [True, False, True, False]


def test_antialiasing_is_the_share_of_rays(tmp_path, device):
    subject = subject_of(quad(), tmp_path, device=device)
    coarse, fine = picture(subject, front(20), 4), picture(subject, front(80), 1)
    assert np.abs(coarse - fine.reshape(20, 4, 20, 4, 4).mean((1, 3))).max() < 1e-5
    assert 0 < coarse[..., 3].sum() and ((coarse[..., 3] > 0) & (coarse[..., 3] < 1)).any()


@pytest.mark.parametrize("time", [0.0, 0.6])
def test_silhouette_of_a_bent_bar_matches_float64(tmp_path, device, time):
    subject = subject_of(bar()[0], tmp_path, device=device)
    camera = front(24, azimuth=-50.0, sine=0.3)
    image = picture(subject, camera, time=time)
    xs, ys = torch.meshgrid(torch.arange(24) + 0.5, torch.arange(24) + 0.5, indexing="xy")
    pixels = torch.stack([xs, ys, torch.ones_like(xs)], -1).double().reshape(-1, 3)
    directions = pixels @ torch.linalg.inv(camera.K.double()).T @ camera.viewmat[:3, :3].double()
    vertices = torch.from_numpy(subject.scene.posed(subject.seconds(time)).positions)
    faces = torch.from_numpy(subject.scene.triangles.faces).long()
    hit = first_hit(vertices, faces, camera.position.double(), directions).isfinite().reshape(24, 24).numpy()
    assert hit.sum() > 20 and ((image[..., 3] > 0.5) != hit).sum() <= 1


def test_the_whole_motion_fits_into_the_room_and_the_pictures(tmp_path):
    subject = subject_of(box(), tmp_path)
    reach = max(np.linalg.norm(subject.scene.posed(second).positions, axis=1).max() for second in np.linspace(0, 1, 31))
    assert reach == pytest.approx(ROOM_RADIUS, rel=2e-3)
    for filming in (
        FilmingSettings(),
        FilmingSettings(width=60, height=40, fov=60.0),
        FilmingSettings(width=40, height=60),
    ):
        for time in (0.0, 0.5, 1.0):
            matrix = camera_at(2.0 * time, 0.3, camera_distance(filming))
            camera = camera_of(matrix, math.radians(filming.fov), filming.width, filming.height)
            pixels = project(camera, subject.scene.posed(time).positions)
            assert (pixels > 0).all() and (pixels < [filming.width, filming.height]).all()


def test_tracks_are_exact(tmp_path):
    subject = subject_of(box(), tmp_path)
    points = subject.sample(300, np.random.default_rng(0))
    tracks = subject.track(points, [0.0, 0.5, 1.0])
    corners = subject.scene.triangles.faces[points.face]
    assert np.allclose(points.shares.sum(1), 1) and (points.shares >= 0).all()
    scale = np.linalg.norm(subject.scene.world_from_gltf[0, :3])
    to_gltf = np.linalg.inv(subject.scene.world_from_gltf)
    for time, track in zip((0.0, 0.5, 1.0), tracks):
        local = track @ to_gltf[:3, :3].T + to_gltf[:3, 3] - [3 * time, 1, 0]
        angle = -math.radians(90 * time)
        turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
        assert np.abs(np.abs(local @ turn.T).max(1) - 1).max() < 1e-6  # on the cube
    rest = subject.scene.posed(0.0).positions[corners]
    assert np.abs(np.einsum("pk,pki->pi", points.shares, rest) - tracks[0]).max() < 1e-12
    assert np.bincount(points.face, minlength=12).std() < 1  # evenly by area
    assert subject_height(subject) == pytest.approx(2 * scale, rel=1e-5)
    assert subject_height(subject_of(quad(), tmp_path)) == pytest.approx(2 * HALF, rel=1e-5)


def request(mesh: Path | None, **fields) -> SynthesisRequest:
    filming = fields.pop("filming", FilmingSettings(width=32, height=32, train=4, test=2, val=1))
    return SynthesisRequest(mesh, filming=filming, samples=2, **fields)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("synthesis")
    mesh = bar()[0].save(folder / "bar.glb")
    return synthesize(plan_synthesis(folder / "scene", request(mesh, filming=FilmingSettings(48, 40, 6, 3, 1))))


def test_a_made_folder_is_a_data_set(made):
    splits = ["train", "test", "val"]
    files = ["ground_truth.npz", "synthesis.json", "contact_sheet.png"]
    expected = {*splits, *files, *(f"transforms_{split}.json" for split in splits)}
    assert {path.name for path in made.iterdir()} == expected
    for split, count in (("train", 6), ("test", 3), ("val", 1)):
        frames = load(made, split)
        assert len(frames) == count
        for frame in frames:
            assert frame.image.shape == (40, 48, 3) and frame.alpha is not None and 0 < frame.alpha.mean() < 0.5
            border = torch.cat([frame.alpha[0], frame.alpha[-1], frame.alpha[:, 0], frame.alpha[:, -1]])
            assert border.max() == 0
    assert load(made, "train").times.tolist() == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1])
    sheet = cv2.imread(str(made / "contact_sheet.png"))
    assert sheet is not None and sheet.shape[0] > 3 * 40 and sheet.shape[1] > 6 * 48 and sheet.std() > 10


def test_ground_truth_lies_on_the_pictures_and_scores_itself(made):
    truth = load_ground_truth(made)
    assert truth is not None and truth.points.shape == (51, 2000, 3) and truth.visible.shape == (6, 2000)
    assert 0.1 < truth.visible.float().mean() < 0.6
    train = load(made, "train")
    for view, index in ((0, 0), (3, 30), (5, 50)):
        camera, alpha = train[view].camera, train[view].alpha
        points = truth.points[index][truth.visible[view]].double().numpy()
        x, y = torch.from_numpy(project(camera, points)).long().T
        assert alpha is not None and len(points) > 200 and (alpha[y, x] > 0).float().mean() > 0.98
    score = score_motion(truth, lambda time: truth.points[round(time * 50)])
    assert score.epe == 0 and score.jitter == 0
    assert score_motion(truth, lambda time: truth.points[0]).epe > 5


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("subject", ["box", "figure"])
def test_same_bytes_for_any_number_of_threads(tmp_path, all_threads, subject):
    mesh = box().save(tmp_path / "box.glb") if subject == "box" else None
    found = []
    for threads in (1, 2):
        environment.configure(threads=threads)
        found.append(contents(synthesize(plan_synthesis(tmp_path / str(threads), request(mesh)))))
    assert found[0] == found[1] and len(found[0]) == 4 + 2 + 1 + 3 + 3
    other = contents(synthesize(plan_synthesis(tmp_path / "other", request(mesh, seed=1))))
    assert other["train/r_000.png"] != found[0]["train/r_000.png"]


def test_a_folder_is_made_once_and_never_overwritten(tmp_path):
    mesh = box().save(tmp_path / "box.glb")
    folder = synthesize(plan_synthesis(tmp_path / "scene", request(mesh)))
    before = contents(folder)
    planned = plan_synthesis(folder, request(mesh))
    assert planned.made and synthesize(planned) == folder and contents(folder) == before
    with pytest.raises(UserError, match="holds something else; give another --output"):
        plan_synthesis(folder, request(mesh, seed=2))
    box((0, 1, 0, 1)).save(mesh)
    with pytest.raises(UserError, match="holds something else"):
        plan_synthesis(folder, request(mesh))


def test_time_range_rig_background_and_still_scenes(tmp_path):
    mesh = box().save(tmp_path / "box.glb")
    filming = FilmingSettings(32, 32, 2, 1, 0, views=2)
    part = plan_synthesis(tmp_path / "part", request(mesh, start=0.25, end=0.5, background="white", filming=filming))
    assert part.subject.track(part.points, [0.0])[0].shape == (2000, 3) and part.counts == {"train": 4, "test": 1}
    folder = synthesize(part)
    pixels = cv2.imread(str(folder / "train" / "r_000.png"), cv2.IMREAD_UNCHANGED)
    assert pixels is not None and pixels.shape == (32, 32, 3) and (pixels[0, 0] == 255).all()
    truth = load_ground_truth(folder)
    assert truth is not None and truth.visible.shape == (4, 2000)
    still = synthesize(plan_synthesis(tmp_path / "still", request(quad().save(tmp_path / "quad.glb"))))
    truth = load_ground_truth(still)
    assert truth is not None and (truth.points == truth.points[0]).all()
    assert json.loads((still / "synthesis.json").read_text())["clip"] is None


def test_a_surface_that_grows_from_nothing_is_explained(tmp_path):
    glb = box()
    glb.animate(0, 1, "scale", [0.0, 1.0], [[0, 0, 0], [1, 1, 1]])
    mesh = glb.save(tmp_path / "box.glb")
    with pytest.raises(UserError, match="no area at second 0; give a later --start"):
        plan_synthesis(tmp_path / "scene", request(mesh))
    assert plan_synthesis(tmp_path / "scene", request(mesh, start=0.5)).counts["train"] == 4


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"filming": FilmingSettings(width=4)}, "--size 4 400"),
        ({"filming": FilmingSettings(train=1)}, "--train 1: give at least 2"),
        ({"filming": FilmingSettings(views=0)}, "--views 0"),
        ({"filming": FilmingSettings(fov=170)}, "--fov 170"),
        ({"filming": FilmingSettings(elevation=(50, 10))}, "--elevation 50 10"),
        ({"seed": -1}, "--seed -1"),
        ({"shading": Shading(ambient=-1)}, "--ambient -1"),
        ({"shading": Shading(light=(0, 0, 0))}, "--light"),
        ({"start": 0.5, "end": 0.2}, "lasts from 0 to 1 seconds"),
        ({"end": 3.0}, "lasts from 0 to 1 seconds"),
    ],
)
def test_wrong_requests_are_explained(tmp_path, fields, message):
    mesh = box().save(tmp_path / "box.glb")
    with pytest.raises(UserError, match=message):
        plan_synthesis(tmp_path / "scene", request(mesh, **fields))
    assert not (tmp_path / "scene").exists()


def test_options_of_files_need_a_file():
    for fields, name in (({"clip": "Walk"}, "--clip"), ({"end": 1.0}, "--end")):
        with pytest.raises(UserError, match=f"{name}.*give one with --mesh"):
            check(SynthesisRequest(**fields))


def app(*arguments: str) -> subprocess.CompletedProcess:
    command = [sys.executable, str(ROOT / "apps" / "synthesize.py"), "--device", "cpu", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


def test_the_app_films_and_explains(tmp_path):
    mesh = str(box().save(tmp_path / "box.glb"))
    few = ["--train", "3", "--test", "1", "--val", "0", "--size", "24", "16", "--samples", "1"]
    done = app("--mesh", mesh, "--output", str(tmp_path / "scene"), *few)
    assert done.returncode == 0, done.stderr
    assert "clip Slide, 0.00 to 1.00 s" in done.stdout and "it/s" in done.stdout and "train.py --data" in done.stdout
    assert len(load(tmp_path / "scene", "train")) == 3
    wrong = app("--mesh", mesh, "--clip", "Run", "--output", str(tmp_path / "other"))
    assert wrong.returncode == 2 and wrong.stdout == "" and wrong.stderr.count("\n") == 1
    assert "give one of: Slide (1.00 s)" in wrong.stderr


@pytest.mark.parametrize(
    ("name", "clip", "bones", "textures"),
    [("CesiumMan.glb", None, 19, 1), ("RobotExpressive_raylib.glb", "Robot_Walking", 43, 0)],
)
def test_real_characters(data_root, name, clip, bones, textures):
    path = data_root / "animated" / name
    if not path.is_file():
        pytest.skip(f"no {path.name} in the folder of data sets")
    scene = read_scene(path, clip)
    assert len(scene.palette) == bones and len(scene.textures) == textures and scene.clip is not None
    subject = MeshSubject(scene, (scene.clip.start, scene.clip.end), Shading())
    image = picture(subject, front(64), 2, 0.3)
    assert 0.05 < image[..., 3].mean() < 0.5 and image[image[..., 3] > 0.9][:, :3].std(0).min() > 0.05
