"""Lenses against OpenCV's own models: where rays land, images made straight, and where a model turns back."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import torch

from helpers.warped import landing, picture, pixel_centres, straight
from scgs_warp.capture.source import read_rgb
from scgs_warp.data import load
from scgs_warp.data.lens import (
    BROWN4,
    Lens,
    make_lens,
    project,
    rescaled,
    undistort,
    undistortion_maps,
    valid_pixels,
    valid_radius,
)
from scgs_warp.errors import UserError

WIDTH, HEIGHT = 96, 72
K = np.array([[70.0, 0.0, 46.0], [0.0, 74.0, 37.5], [0.0, 0.0, 1.0]])
INTRINSICS = (70.0, 74.0, 46.0, 37.5)
BROWN = {"k1": -0.18, "k2": 0.05, "p1": 0.004, "p2": -0.006, "k3": -0.01}
BULGE = {"k1": 0.2, "k2": 0.02, "p1": -0.003, "p2": 0.005}
RATIONAL = {"k1": 0.3, "k2": 0.1, "p1": 0.001, "p2": -0.002, "k3": 0.02, "k4": 0.25, "k5": 0.05, "k6": 0.01}
FISHEYE = {"k1": 0.05, "k2": -0.01, "k3": 0.003, "k4": -0.001}
CASES = {"barrel": ("OPENCV", BROWN), "bulge": (None, BULGE), "rational": ("FULL_OPENCV", RATIONAL)}
CASES["fisheye"] = ("OPENCV_FISHEYE", FISHEYE)


def opencv(values: dict[str, float], fisheye: bool) -> np.ndarray:
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    return np.array([values.get(name, 0.0) for name in names])


@pytest.mark.parametrize("case", CASES)
def test_rays_land_where_opencv_says(case):
    values = CASES[case][1]
    rays = np.random.default_rng(0).uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 2.0), (200, 3))
    distortion, still = opencv(values, case == "fisheye"), np.zeros(3)
    if case == "fisheye":
        expected, _ = cv2.fisheye.projectPoints(rays[:, None], still, still, K, distortion)
        lens = make_lens("OPENCV_FISHEYE", (*INTRINSICS, *distortion))
    else:
        expected, _ = cv2.projectPoints(rays, still, still, K, distortion)
        lens = make_lens("FULL_OPENCV", (*INTRINSICS, *distortion))
    np.testing.assert_allclose(project(lens, rays), expected.reshape(-1, 2), atol=1e-9)
    assert lens.distorted


@pytest.mark.parametrize("case", ["rational", "fisheye"])
def test_lenses_of_spectacular_ai(tmp_path, case):
    """It writes the model under another key, and OpenCV's eight parameters under OPENCV."""
    model, values = CASES[case]
    write(tmp_path, model, values)
    path = tmp_path / "transforms.json"
    content, expected = json.loads(path.read_text()), load(tmp_path)[0].image
    name = content.pop("camera_model")
    path.write_text(json.dumps({**content, "model": name.replace("FULL_", ""), "fx": 70.0}))
    assert torch.equal(load(tmp_path)[0].image, expected)
    path.write_text(json.dumps({**content, "model": "iPhone15,2", "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.5}))
    with pytest.raises(UserError, match=r"k4 is 0\.5, a lens distortion that camera_model None"):
        load(tmp_path)


def test_lenses_of_project_aria(tmp_path):
    """Without tangential and prism parameters, they are OpenCV's fisheyes with two more terms; straight lines stay."""
    lists = [*FISHEYE.values(), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    write(tmp_path, "OPENCV_FISHEYE", FISHEYE)
    path = tmp_path / "transforms.json"
    content, expected = json.loads(path.read_text()), load(tmp_path)[0]
    content = {key: value for key, value in content.items() if key not in FISHEYE}
    content |= {"camera_model": "FISHEYE624", "distortion_params": lists, "fisheye_crop_radius": 40.0}
    path.write_text(json.dumps(content))
    found = load(tmp_path)[0]
    assert expected.mask is not None and found.mask is not None
    both = expected.mask & found.mask
    assert both.float().mean() > 0.7 and torch.allclose(expected.image[both], found.image[both], atol=0.01)
    prism = [*lists[:6], 0.004, -0.003, 0.01, 0.0, -0.02, 0.0]
    path.write_text(json.dumps({**content, "distortion_params": prism}))
    assert not torch.allclose(load(tmp_path)[0].image, found.image, atol=0.005), "they are read"
    for wrong in (lists[:6], None, [*lists[:11], "wide"]):
        path.write_text(json.dumps({**content, "distortion_params": wrong}))
        with pytest.raises(UserError, match=r"distortion_params is .*12 numbers of FISHEYE624|distortion_params\[11\]"):
            load(tmp_path)


@pytest.mark.parametrize("listed", [False, True])
def test_the_fourth_radial_parameter_of_nerfstudio(tmp_path, listed):
    """Metashape and RealityCapture calibrate it. Without it the lens is OpenCV's; with it, rays move by k4 r^8."""
    polynomial = {**BROWN, "k4": 0.03}
    rays = np.random.default_rng(0).uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 2.0), (200, 3))
    rays[0, 2] = -1.0
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, opencv(BROWN, False))
    plane = rays[:, :2] / rays[:, 2:]
    further = 0.03 * (plane**2).sum(1, keepdims=True) ** 4 * plane * INTRINSICS[:2]
    lens = make_lens(BROWN4, (*INTRINSICS, *(polynomial[key] for key in ("k1", "k2", "p1", "p2", "k3", "k4"))))
    landed = project(lens, rays)
    np.testing.assert_allclose(landed[1:], expected.reshape(-1, 2)[1:] + further[1:], atol=1e-9)
    assert lens.distorted and np.isnan(landed[0]).all(), "behind the camera"
    half = rescaled(lens, (WIDTH, HEIGHT), (WIDTH // 2, HEIGHT // 2))
    np.testing.assert_allclose(project(half, rays[1:]), landed[1:] / 2, atol=1e-9)
    write(tmp_path, None if listed else "OPENCV", BROWN)
    content = json.loads((tmp_path / "transforms.json").read_text())
    if listed:
        named = ("k1", "k2", "k3", "k4", "p1", "p2")
        content = {key: value for key, value in content.items() if key not in named}
        content["distortion_params"] = [polynomial[key] for key in named]
    else:
        content |= polynomial
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    frame = load(tmp_path)[0]
    with_it, _, valid = undistortion_maps(lens, WIDTH, HEIGHT)
    shown = read_rgb(tmp_path / "0.png").astype(np.float32) / 255.0
    wanted = cv2.remap(shown, *undistortion_maps(lens, WIDTH, HEIGHT)[:2], cv2.INTER_LINEAR)
    assert np.abs(frame.image.numpy() - wanted)[valid].max() < 0.01
    plain = undistortion_maps(make_lens("FULL_OPENCV", (*INTRINSICS, *opencv(BROWN, False))), WIDTH, HEIGHT)[0]
    assert np.abs(with_it - plain)[valid].max() > 0.01, "the parameter matters"
    content |= {"k5": 0.1}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"k5 is 0\.1, a lens distortion that camera_model"):
        load(tmp_path)


def write(folder, model, values, mode="RGB", **changes) -> np.ndarray:
    """A one-camera video of the pattern through this lens; returns the image."""
    fisheye = model == "OPENCV_FISHEYE"
    image = picture(WIDTH, HEIGHT, K, opencv(values, fisheye), fisheye)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    entries = []
    for index in range(6):
        pixels = image[..., ::-1]
        if mode == "RGBA":
            alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
            alpha[:, :30] = 0
            pixels = np.concatenate([pixels, alpha], axis=2)
        cv2.imwrite(str(folder / f"{index}.png"), pixels)
        pose[0, 3] = 0.1 * index
        entries.append({"file_path": f"{index}.png", "transform_matrix": pose.tolist()})
    content = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": WIDTH, "h": HEIGHT, **values}
    content |= {"frames": entries, **({"camera_model": model} if model else {}), **changes}
    (folder / "transforms.json").write_text(json.dumps(content))
    return image


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_images_become_what_a_pinhole_sees(tmp_path, case, listed):
    model, values = CASES[case]
    write(tmp_path, model, values)
    if listed:
        if case == "rational":
            pytest.skip("distortion_params has no k5")
        content = json.loads((tmp_path / "transforms.json").read_text())
        for key in values:
            del content[key]
        content["distortion_params"] = [values.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")]
        (tmp_path / "transforms.json").write_text(json.dumps(content))
    frame = load(tmp_path)[0]
    torch.testing.assert_close(frame.camera.K, torch.from_numpy(K).float())
    assert frame.mask is not None and frame.mask.float().mean() > 0.7
    expected = straight(WIDTH, HEIGHT, K)
    valid = frame.mask.numpy()
    assert np.abs(frame.image.numpy() - expected)[valid].max() < 0.012  # 8 bits, and bilinear
    distortion = opencv(values, case == "fisheye")
    rays = ((pixel_centres(WIDTH, HEIGHT) - K[[0, 1], 2]) / K[[0, 1], [0, 1]]).reshape(-1, 2)
    there = landing(rays, K, distortion, case == "fisheye").reshape(HEIGHT, WIDTH, 2)
    inside = ((there > 0.52) & (there < (WIDTH - 0.52, HEIGHT - 0.52))).all(2)
    outside = ((there < 0.48) | (there > (WIDTH - 0.48, HEIGHT - 0.48))).any(2)
    assert valid[inside].all() and not valid[outside].any(), "valid is what the file has"
    assert (frame.image.numpy()[~valid] == 0).all()


def test_undistorted_and_reduced(tmp_path):
    write(tmp_path, "OPENCV", BROWN)
    for resample, tolerance in (("area", 0.012), ("bicubic", 0.03)):
        frame = load(tmp_path, downscale=2, resample=resample)[0]
        assert (frame.camera.width, frame.camera.height, float(frame.camera.K[0, 2])) == (48, 36, 23.0)
        expected = straight(WIDTH, HEIGHT, K).reshape(36, 2, 48, 2, 3).mean((1, 3))
        inner = torch.zeros(36, 48, dtype=torch.bool)
        inner[3:-3, 3:-3] = True
        valid = (frame.mask & inner).numpy()
        assert np.abs(frame.image.numpy() - expected)[valid].max() < tolerance


def test_alpha_and_masks_are_undistorted_too(tmp_path):
    write(tmp_path, "OPENCV", BULGE, mode="RGBA")
    frame = load(tmp_path, background="white")[0]
    assert frame.alpha is not None and (frame.alpha[30:40, :20] == 0).all() and (frame.alpha[30:40, 50:80] == 1).all()
    assert (frame.image[30:40, 20] == 1).all()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, 60:] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    write(tmp_path, "OPENCV", BULGE, mask_path="nothing: a field of the frames")
    content = json.loads((tmp_path / "transforms.json").read_text())
    content["frames"][0]["mask_path"] = "mask.png"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    data = load(tmp_path)
    columns = undistortion_maps(make_lens("FULL_OPENCV", (*INTRINSICS, *opencv(BULGE, False))), WIDTH, HEIGHT)[0]
    own, other = data[0].mask, data[1].mask
    assert not (own & ~other).any() and not own[torch.from_numpy(columns > 59.01)].any()
    assert own[torch.from_numpy((columns < 58.9) & other.numpy())].all()


def test_a_polynomial_that_turns_back_shows_nothing_there():
    """Beyond r = 1 / sqrt(-3 k1) the model comes back to the middle: the file has no such ray."""
    lens = make_lens("SIMPLE_RADIAL", (40.0, 48.0, 36.0, -0.4))
    limit = valid_radius(lens, WIDTH, HEIGHT)
    assert limit == pytest.approx(1 / np.sqrt(1.2), rel=5e-3)
    radius = np.hypot(*(pixel_centres(WIDTH, HEIGHT) - [48.0, 36.0]).transpose(2, 0, 1)) / 40.0
    valid = valid_pixels(lens, WIDTH, HEIGHT)
    assert not valid[radius > 1.001 * limit].any() and valid[radius < 0.99 * limit].all()
    assert (undistort(np.ones((HEIGHT, WIDTH), np.float32), lens) == valid).all()


@pytest.mark.parametrize("skew", [0.0, 3.0])
def test_skew_shears(skew):
    lens = Lens(70.0, 74.0, 46.0, 37.5, skew=skew)
    assert lens.distorted == (skew != 0)
    sheared = np.array([[70.0, skew, 46.0], [0.0, 74.0, 37.5], [0.0, 0.0, 1.0]])
    rays = np.random.default_rng(1).uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 2.0), (50, 3))
    expected = rays @ sheared.T
    np.testing.assert_allclose(project(lens, rays), expected[:, :2] / expected[:, 2:], atol=1e-9)


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [
        ("NONE", (1.0, 1.0, 1.0), "not known"),
        ("OPENCV", (1.0, 1.0, 1.0), "does not take 3"),
        ("PINHOLE", (1.0, np.nan, 1.0, 1.0), "not finite"),
        ("PINHOLE", (-1.0, 1.0, 1.0, 1.0), "focal length"),
        ("EQUIRECTANGULAR", (10.0, 10.0), "all around"),
    ],
)
def test_no_such_lens(model, params, expected):
    with pytest.raises(ValueError, match=expected):
        make_lens(model, params)


def test_zero_is_a_pinhole_except_for_fisheyes():
    import pycolmap

    for model in pycolmap.CameraModelId.__members__:
        if model not in ("INVALID", "EQUIRECTANGULAR"):
            camera = pycolmap.Camera.create_from_model_name(1, model, 50.0, WIDTH, HEIGHT)
            lens = make_lens(model, tuple(camera.params))
            rays = np.random.default_rng(2).uniform((-0.4, -0.4, 1.0), (0.4, 0.4, 2.0), (20, 3))
            pinhole = rays[:, :2] / rays[:, 2:] * 50 + (WIDTH / 2, HEIGHT / 2)
            straight_on = np.abs(project(lens, rays) - pinhole).max() < 1e-9
            assert (lens.fx, lens.fy, lens.cx, lens.cy) == (50.0, 50.0, WIDTH / 2, HEIGHT / 2), model
            assert straight_on or lens.distorted, model
