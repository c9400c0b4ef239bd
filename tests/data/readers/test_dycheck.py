"""DyCheck's iPhone data: cameras, depth and times by projection, splits, alpha that masks, covisible masks, faults."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from helpers.data_faults import change, gone, message, noise, put
from helpers.dycheck_files import (
    COVISIBLE_FROM,
    HEIGHT,
    HELD,
    RADIUS,
    TIMES,
    UNSEEN,
    WALL,
    WIDTH,
    ball_at,
    shown,
    viewmat,
    write_dycheck,
)
from helpers.layouts import save_image
from scgs_warp.data import load
from scgs_warp.data.dataset import Dataset
from scgs_warp.evaluation.evaluate import evaluate


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("dycheck")
    write_dycheck(path)
    return path


def landed(train: Dataset, index: int, test: Dataset, other: int) -> tuple[np.ndarray, np.ndarray]:
    """Project the depth of a training frame into a held-out one: errors of colours [P] where neither the edge of the
    image nor anything else hides the point, and [P] bool, whether it is on the ball."""
    depth, frame, seen = train.depth(index), train[index], test[other]
    assert depth is not None
    rows, columns = np.nonzero(depth.numpy() > 0)
    x, y = (columns + 0.5) * WIDTH / depth.shape[1], (rows + 0.5) * HEIGHT / depth.shape[0]
    local = np.stack([x, y, np.ones(len(x))], 1) @ np.linalg.inv(frame.camera.K.numpy()).T
    local *= depth.numpy()[rows, columns][:, None]
    points = (local - frame.camera.viewmat[:3, 3].numpy()) @ frame.camera.viewmat[:3, :3].numpy()
    moved = points @ seen.camera.viewmat[:3, :3].numpy().T + seen.camera.viewmat[:3, 3].numpy()
    flat = moved @ seen.camera.K.numpy().T
    pixels = np.floor(flat[:, :2] / flat[:, 2:]).astype(int)
    camera, time = (int(part) for part in seen.name.split("_"))
    inside = ((pixels >= 1) & (pixels < [WIDTH - 1, HEIGHT - 1])).all(1)
    at = tuple(pixels[inside].T[::-1])
    visible = np.abs(shown(camera, time)[1][at] - moved[inside, 2]) < 0.05
    own = frame.image.numpy()[np.floor(y).astype(int), np.floor(x).astype(int)][inside][visible]
    errors = np.abs(seen.image.numpy()[at][visible] - own).max(1)
    return errors, points[inside][visible][:, 2] < WALL - 0.1


@pytest.mark.parametrize("other", [0, 5, 12, 17])
def test_depth_of_the_moving_camera_lands_where_the_others_see_it(folder, other):
    train, test = load(folder), load(folder, "test")
    time = int(test.entries[other].name.split("_")[1])
    errors, on_ball = landed(train, time, test, other)
    assert len(errors) > 2000 and on_ball.sum() > 50
    assert np.median(errors) < 0.02 and (errors < 0.1).mean() > 0.97 and (errors[on_ball] < 0.15).mean() > 0.9
    assert abs(float(test.times[other] - train.times[time])) < 1e-6, "at the same time"


def test_cameras_times_and_splits(folder):
    train, test = load(folder), load(folder, "test")
    assert [frame.name for frame in train] == [f"0_{time:05d}" for time in range(TIMES)]
    assert [frame.name for frame in test] == [f"{cam}_{time:05d}" for cam, times in HELD.items() for time in times]
    np.testing.assert_allclose(train.times, np.arange(TIMES) / (TIMES - 1), atol=1e-6)
    np.testing.assert_allclose(test.times, np.array([*HELD[1], *HELD[2]]) / (TIMES - 1), atol=1e-6)
    np.testing.assert_allclose(train[4].camera.viewmat, viewmat(0, 4), atol=1e-5)
    np.testing.assert_allclose(test[-1].camera.viewmat, viewmat(2, 9), atol=1e-5)
    assert torch.equal(load(folder, "val").times, test.times) and not train.notes and not test.notes
    assert train.bounds == (0.5, 4.0)


def test_only_one_camera(folder):
    assert {frame.name[0] for frame in load(folder, "test", only_cameras="0,2")} == {"2"}
    train, test = load(folder, only_cameras="0"), load(folder, "test", only_cameras="0")
    assert [frame.name for frame in test] == ["0_00004"] and len(train) == TIMES - 1


def test_the_initial_points_lie_on_what_the_depth_shows(folder):
    data = load(folder)
    assert data.points is not None and data.colors is not None and len(data.points) > 20_000
    points = data.points.numpy()
    on_wall = np.abs(points[:, 2] - WALL) < 1e-3
    balls = np.stack([ball_at(time) for time in range(TIMES)])
    on_ball = np.abs(np.linalg.norm(points[:, None] - balls, axis=2) - RADIUS).min(1) < 1e-3
    assert (on_wall | on_ball).all() and on_ball.sum() > 100
    assert float(data.colors.min()) >= 0.04, "none is of a pixel without a colour"


def test_alpha_masks_pixels_and_cuts_nothing_out(folder):
    train, test = load(folder), load(folder, "test")
    assert not train.with_alpha and train[0].alpha is None and test[0].mask is None
    mask = train[3].mask
    assert mask is not None and not mask[:, :UNSEEN].any() and mask[:, UNSEEN:].all()
    np.testing.assert_allclose(train[3].image.numpy()[:, UNSEEN:], shown(0, 3)[0][:, UNSEEN:], atol=0.5 / 255 + 1e-6)


def test_the_smaller_images_have_smaller_maps(folder):
    train, test = load(folder, downscale=2), load(folder, "test", downscale=2)
    depth, mask = train.depth(2), test.covisible(0)
    assert (train[0].camera.width, train[0].camera.height) == (WIDTH // 2, HEIGHT // 2)
    assert depth is not None and depth.shape == (HEIGHT // 2, WIDTH // 2)
    np.testing.assert_allclose(depth[:, 4:], shown(0, 2)[1][::2, ::2][:, 4:], rtol=1e-5)
    assert mask is not None and mask.shape == (HEIGHT // 2, WIDTH // 2)
    assert not mask[:, : COVISIBLE_FROM // 2].any() and mask[:, COVISIBLE_FROM // 2 :].all()


def test_a_mask_of_smaller_images_serves_for_full_ones(folder):
    train, test = load(folder), load(folder, "test")
    mask = test.covisible(0)
    assert mask is not None and mask.shape == (HEIGHT, WIDTH) and train.covisible(0) is None
    assert not mask[:, :COVISIBLE_FROM].any() and mask[:, COVISIBLE_FROM:].all()


def test_masks_of_shape_of_motion_are_found(tmp_path):
    write_dycheck(tmp_path, covisible=False)
    assert load(tmp_path, "test").covisible(0) is None
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[: HEIGHT // 2] = 255
    for name in ("1_00000", "1_00001"):
        save_image(tmp_path / f"flow3d_preprocessed/covisible/1x/val/{name}.png", mask)
    test = load(tmp_path, "test")
    found = test.covisible(1)
    assert found is not None and torch.equal(found, torch.from_numpy(mask > 0)) and test.covisible(2) is None
    assert test.notes == (f"{tmp_path}/covisible: 16 of 18 test frames have no mask; mpsnr leaves them out",)


class Painter:
    """A scene that shows held-out images with an error of 0.1 where they are covisible, and of 0.5 elsewhere."""

    def __init__(self, data: Dataset) -> None:
        self._frames = iter(data)

    def render(self, camera, time, background):
        image = next(self._frames).image.clone()
        image[:, COVISIBLE_FROM:] += torch.where(image[:, COVISIBLE_FROM:] > 0.5, -0.1, 0.1)
        image[:, :COVISIBLE_FROM] += torch.where(image[:, :COVISIBLE_FROM] > 0.5, -0.5, 0.5)
        return SimpleNamespace(rgb=image, alpha=torch.ones(image.shape[:2]))


def test_mpsnr_is_of_the_covisible_pixels(folder):
    data = load(folder, "test")
    found = evaluate(Painter(data), data)  # type: ignore[arg-type]
    assert found["mpsnr"] == pytest.approx(20.0, abs=1e-3)
    share = COVISIBLE_FROM / WIDTH
    assert found["psnr"] == pytest.approx(-10 * np.log10(0.01 * (1 - share) + 0.25 * share), abs=1e-3)
    assert all(row["mpsnr"] == pytest.approx(20.0, abs=1e-3) for row in found["per_image"])


def test_frames_of_which_nothing_is_covisible_have_no_mpsnr(tmp_path):
    write_dycheck(tmp_path)
    for file in (tmp_path / "covisible/2x/val").iterdir():
        save_image(file, np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8))
    data = load(tmp_path, "test")
    found = evaluate(Painter(data), data)  # type: ignore[arg-type]
    assert "mpsnr" not in found and "mpsnr" not in found["per_image"][0]


def test_without_masks_there_is_no_mpsnr(tmp_path):
    write_dycheck(tmp_path, covisible=False)
    data = load(tmp_path, "test")
    assert not data.notes and "mpsnr" not in evaluate(Painter(data), data)  # type: ignore[arg-type]


def test_without_lists_of_splits_those_of_nerfies_count(folder, tmp_path):
    """DyCheck's own programs write ``splits`` when they first run."""
    write_dycheck(tmp_path)
    for name in ("train", "val"):
        (tmp_path / f"splits/{name}.json").unlink()
    for split in ("train", "test"):
        before, after = load(folder, split), load(tmp_path, split)
        assert before.fingerprint == after.fingerprint and after.with_depth == before.with_depth


def test_splits_alone_suffice(folder, tmp_path):
    write_dycheck(tmp_path)
    for name in ("dataset.json", "metadata.json", "extra.json", "points.npy"):
        (tmp_path / name).unlink()
    assert load(tmp_path).fingerprint == load(folder).fingerprint


def test_splits_choose_among_the_frames(tmp_path):
    write_dycheck(tmp_path)
    for name in ("train", "val"):
        keep = slice(2, 9) if name == "train" else slice(0, 3)
        change(tmp_path / f"splits/{name}.json", lambda c, keep=keep: c.update({k: v[keep] for k, v in c.items()}))
    train, test = load(tmp_path), load(tmp_path, "test")
    assert [frame.name for frame in train] == [f"0_{time:05d}" for time in range(2, 9)]
    assert [frame.name for frame in test] == ["1_00000", "1_00001", "1_00002"]
    np.testing.assert_allclose(train.times, np.arange(2, 9) / 8, atol=1e-6)


def test_splits_without_times_take_those_of_the_metadata(folder, tmp_path):
    write_dycheck(tmp_path)
    for name in ("train", "val"):
        change(tmp_path / f"splits/{name}.json", lambda content: content.pop("time_ids"))
    assert load(tmp_path, "test").fingerprint == load(folder, "test").fingerprint


def test_a_single_camera_holds_out_every_eighth_frame(tmp_path):
    write_dycheck(tmp_path)
    change(tmp_path / "splits/val.json", lambda content: content.update(frame_names=[], time_ids=[], camera_ids=[]))
    train, test = load(tmp_path), load(tmp_path, "test")
    assert [frame.name for frame in test] == ["0_00004"] and len(train) == TIMES - 1
    (tmp_path / "splits/val.json").unlink()
    assert [frame.name for frame in load(tmp_path, "test")] == ["0_00004"]


def test_without_depth_the_points_are_those_of_the_background(tmp_path):
    write_dycheck(tmp_path, depth=False)
    data = load(tmp_path)
    assert not data.with_depth and data.points is not None and not data.notes
    np.testing.assert_allclose(data.points, [[0.0, 0.0, WALL], [0.5, 0.5, WALL]], atol=1e-5)


def test_missing_depth_maps_are_counted(tmp_path):
    write_dycheck(tmp_path)
    for size in ("1x", "2x"):
        (tmp_path / f"depth/{size}/0_00003.npy").unlink()
    data = load(tmp_path)
    assert 3 not in data.with_depth and len(data.with_depth) == TIMES - 1
    assert data.notes == (
        f"{tmp_path}/depth: 1 of 12 train frames have no depth map; they count as frames without one",
    )


def test_depth_may_be_flat_and_of_another_size(tmp_path):
    write_dycheck(tmp_path)
    for file in (tmp_path / "depth/1x").iterdir():
        np.save(file, np.load(file)[::3, ::3, 0].astype(np.float16))
    depth = load(tmp_path).depth(5)
    assert depth is not None and depth.shape == (HEIGHT // 3, WIDTH // 3)
    np.testing.assert_allclose(depth[:, 1:], shown(0, 5)[1][::3, ::3][:, 1:], rtol=2e-3)


def test_other_data_of_nerfies_keep_their_alpha(tmp_path):
    """Depth beside them is of any unit, and alpha cuts out."""
    write_dycheck(tmp_path)
    for name in ("extra.json", "splits/train.json", "splits/val.json"):
        (tmp_path / name).unlink()
    data = load(tmp_path)
    assert len(data.with_alpha) == TIMES and not data.with_depth and data[0].mask is None


CAMERA = "camera/0_00003.json"
FAULTS = {
    "no json": (lambda folder: (folder / "splits/train.json").write_text("{"), "splits/train.json: not valid JSON"),
    "no names": (put("splits/train.json", "frame_names", value=...), "frame_names is missing, empty or not a list"),
    "nothing": (
        put("splits/train.json", "frame_names", value=[]),
        "train.json: frame_names is missing, empty or not a list",
    ),
    "outside": (put("splits/train.json", "frame_names", 0, value="../../x"), "frame_names holds '../../x'"),
    "fewer times": (put("splits/train.json", "time_ids", value=[0, 1]), "time_ids is no list of 12 numbers"),
    "words": (put("splits/val.json", "time_ids", 0, value="late"), "time_ids is no list of 18 numbers"),
    "no camera": (gone(CAMERA), "0_00003.json: no such file"),
    "trained and held out": (
        put("splits/train.json", "frame_names", value=["1_00000"] * 12),
        "train_ids are all among val_ids",
    ),
    "depth": (noise("depth/1x/0_00000.npy"), "0_00000.npy: no sound numpy file"),
    "proportions": (
        lambda folder: np.save(folder / "depth/1x/0_00000.npy", np.ones((50, 50))),
        "0_00000.npy: is 50 x 50, but its image 72 x 96",
    ),
    "millimetres": (
        lambda folder: [np.save(file, np.load(file) * 1000) for file in (folder / "depth/1x").iterdir()],
        "give depth in the units of the cameras (metres, not millimetres)",
    ),
    "all transparent": (
        lambda folder: save_image(folder / "rgb/1x/0_00003.png", np.zeros((HEIGHT, WIDTH, 4), np.uint8)),
        "no pixel is left after its mask",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named(tmp_path, fault):
    edit, expected = FAULTS[fault]
    write_dycheck(tmp_path)
    edit(tmp_path)
    assert expected in message(tmp_path)


def test_a_damaged_mask_is_named(tmp_path):
    write_dycheck(tmp_path)
    noise("covisible/2x/val/1_00000.png")(tmp_path)
    cv2.imwrite(str(tmp_path / "covisible/2x/val/1_00001.png"), np.zeros((40, 40), np.uint8))
    data = load(tmp_path, "test")
    with pytest.raises(Exception, match=r"1_00000.png: not an image"):
        data.covisible(0)
    with pytest.raises(Exception, match=r"1_00001.png: is 40 x 40 pixels, but its image 72 x 96 pixels"):
        data.covisible(1)
