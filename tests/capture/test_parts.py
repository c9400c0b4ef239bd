"""Parts of capture by themselves: which frames are picked, what moves, transforms, what is written, what is refused."""

from __future__ import annotations

import json
from fractions import Fraction

import cv2
import numpy as np
import pytest
import torch

from helpers.layouts import HEIGHT, POINTS, WIDTH, dots, share_found, viewmat
from scgs_warp.capture import features, moving, picking, writing
from scgs_warp.capture.diagnosis import Outcome, likely_reason, notes, too_few
from scgs_warp.capture.features import FrameFiles, Links
from scgs_warp.capture.journal import Journal
from scgs_warp.capture.mapping import CameraSolution
from scgs_warp.capture.similarity import Similarity, align, centres, upright
from scgs_warp.capture.source import Folder, SourceFrame, Video, open_source
from scgs_warp.capture.source import upright as turned
from scgs_warp.data import load
from scgs_warp.errors import UserError
from scgs_warp.visualization.video import film, write_png


def wall(seed: int = 0, height: int = 200, width: int = 700) -> np.ndarray:
    """[height, width, 3] uint8, patterned at several scales."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width, 3), np.float32)
    for size in (4, 12, 40):
        coarse = rng.uniform(-1, 1, (height // size + 2, width // size + 2, 3)).astype(np.float32)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.rint(128 + 60 * total).clip(0, 255).astype(np.uint8)


def pan(shifts, height: int = 120, width: int = 160) -> list[np.ndarray]:
    """Cut-outs of the wall; ``shifts`` in pixels."""
    background = wall(height=height)
    return [background[:, shift : shift + width].copy() for shift in shifts]


def measured(frames: list[np.ndarray]) -> picking.FrameMeasures:
    return picking.measure(SourceFrame(index, index / 30, frame, "") for index, frame in enumerate(frames))


def blur(frame: np.ndarray) -> np.ndarray:
    return cv2.blur(frame, (7, 1))


# Which frames are picked


def test_blurred_frames_are_left_out():
    frames = pan(range(0, 120, 3))
    smeared = {5, 6, 7, 19, 30}
    for index in smeared:
        frames[index] = blur(frames[index])
    found = measured(frames)
    everything = picking.pick(found, 1000)
    assert set(range(40)) - set(everything.places) == smeared and everything.blurred == 5
    few = picking.pick(found, 12)
    assert len(few.places) == 12 and not smeared & set(few.places)


def test_the_sharper_of_neighbours_is_picked():
    frames = pan(range(0, 120, 3))
    for index in range(1, 40, 2):
        frames[index] = cv2.GaussianBlur(frames[index], (3, 3), 0.5)
    assert all(place % 2 == 0 for place in picking.pick(measured(frames), 15).places)


def test_frames_that_show_the_same_again_are_left_out():
    shifts = [3 * (index // 4) for index in range(80)]
    picked = picking.pick(measured(pan(shifts)), 1000)
    assert [shifts[place] for place in picked.places] == sorted(set(shifts)) and picked.alike == 60
    assert picking.pick(measured(pan([0] * 30)), 10).places == [0]


def test_a_small_thing_that_moves_before_a_camera_at_rest_is_no_repetition():
    frames = pan([0] * 20)
    for index, frame in enumerate(frames):
        frame[40:70, 10 + 5 * index : 40 + 5 * index] = wall(9)[:30, :30]
    assert len(picking.pick(measured(frames), 1000).places) == 20


def test_picks_follow_time_and_motion():
    """Half of the film nearly rests: it gets about a quarter of the frames, and gaps stay bounded."""
    shifts = [*(round(0.7 * index) for index in range(100)), *(70 + 4 * index for index in range(100))]
    picked = picking.pick(measured(pan(shifts)), 40).places
    resting = sum(place < 100 for place in picked)
    assert 34 <= len(picked) <= 40 and 8 <= resting <= 18
    assert max(np.diff(picked)) <= 16
    assert picked == picking.pick(measured(pan(shifts)), 40).places


# What moves


def planes(index: int) -> tuple[np.ndarray, np.ndarray]:
    """Two textured planes at rest, one nearer, before a camera that goes sideways; a square that goes up: picture, its
    pixels."""
    picture = pan([40 + 4 * index], 240, 320)[0]
    near = wall(5, 90)
    picture[150:] = near[:, 60 + 11 * index : 380 + 11 * index]
    mask = np.zeros(picture.shape[:2], bool)
    mask[120 - 8 * index : 180 - 8 * index, 140:200] = True
    picture[mask] = wall(8)[:60, :60].reshape(-1, 3)
    return picture, mask


def test_what_leaves_its_epipolar_line_moves():
    scenes = [planes(index) for index in range(6)]
    masks = moving.find_moving(lambda k: scenes[k][0], 6, lambda: None)
    for mask, (_, truth) in zip(masks, scenes):
        assert (mask & truth).sum() > 0.8 * truth.sum()
        assert (mask & ~truth).sum() < 0.04 * truth.size


def test_nothing_moves_in_a_scene_at_rest_or_without_texture():
    rest = pan(range(0, 24, 4), 240, 320)
    assert max(mask.mean() for mask in moving.find_moving(lambda k: rest[k], 6, lambda: None)) < 0.01
    grey = np.full((240, 320, 3), 90, np.uint8)
    assert not any(mask.any() for mask in moving.find_moving(lambda k: grey, 3, lambda: None))


def images(folder, count: int, size=(160, 120), name="{:03d}.png"):
    """Masks, each with a black square in a place of its own."""
    folder.mkdir()
    for index in range(count):
        picture = np.full((size[1], size[0], 3), 255, np.uint8)
        picture[10:30, 5 * index : 5 * index + 20] = 0
        write_png(folder / name.format(index), picture)
    return folder


def test_masks_that_are_given(tmp_path):
    frames = images(tmp_path / "frames", 12, (320, 240))
    masks = images(tmp_path / "masks", 12)
    names = [f"{index:03d}.png" for index in (2, 7)]
    by_name = moving.read_masks(masks, Folder(frames), [2, 7], names, (320, 240))
    assert by_name[0][20:60, 20:60].all() and by_name[1][20:60, 70:110].all()
    assert [mask.sum() for mask in by_name] == [1600, 1600]
    with film(tmp_path / "frames.mp4") as out:
        for file in sorted(frames.iterdir()):
            out.write(cv2.imread(str(file)))
    video = Video(tmp_path / "frames.mp4")
    by_order = moving.read_masks(masks, video, [2, 7], ["", ""], (320, 240))
    by_film = moving.read_masks(tmp_path / "frames.mp4", video, [2, 7], ["", ""], (320, 240))
    few = images(tmp_path / "few", 8, name="frame_{:05d}.png")
    by_number = moving.read_masks(few, video, [2, 7], ["", ""], (320, 240))
    for found in (by_order, by_number):
        assert all(np.array_equal(a, b) for a, b in zip(by_name, found))
    for index, mask in zip((2, 7), by_film):
        assert mask[11:29, 5 * index + 1 : 5 * index + 19].all() and mask.sum() < 500


def test_masks_that_do_not_fit(tmp_path):
    frames, masks = Folder(images(tmp_path / "frames", 12)), images(tmp_path / "masks", 6)
    with pytest.raises(UserError, match=r"masks: no mask for 007 \(1 of 2"):
        moving.read_masks(masks, frames, [2, 7], ["002.png", "007.png"], (160, 120))
    with pytest.raises(UserError, match="proportions"):
        moving.read_masks(masks, frames, [2], ["002.png"], (160, 160))
    with film(tmp_path / "short.mp4") as out:
        for _ in range(4):
            out.write(np.zeros((120, 160, 3), np.uint8))
    with pytest.raises(UserError, match="ends before frame 7"):
        moving.read_masks(tmp_path / "short.mp4", frames, [2, 7], ["", ""], (160, 120))


# What is read


def test_a_video_keeps_its_moments(tmp_path):
    with film(tmp_path / "film.mp4", 12.5) as out:
        for frame in pan(range(0, 30, 3)):
            out.write(frame)
    video = open_source(tmp_path / "film.mp4")
    stills = list(video.frames(80))
    assert video.count == 10 and [still.index for still in stills] == list(range(10))
    np.testing.assert_allclose([still.seconds for still in stills], np.arange(10) / 12.5, atol=1e-3)
    assert stills[0].image.shape == (60, 80, 3)


def test_pixels_are_made_square(tmp_path):
    import av

    with av.open(str(tmp_path / "film.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 144, 120, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        for frame in pan([0, 3], 120, 144):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    assert {still.image.shape for still in Video(tmp_path / "film.mp4").frames(1000)} == {(120, 192, 3)}


def test_pictures_are_turned_as_they_were_held():
    image = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    assert np.array_equal(turned(image, 0), image)
    assert np.array_equal(turned(image, 90), np.rot90(image)), "counter-clockwise"
    assert np.array_equal(turned(image, -90.0), np.rot90(image, 3))


def test_what_is_no_film_is_refused(tmp_path):
    (tmp_path / "film.mp4").write_bytes(b"not a film" * 1000)
    (tmp_path / "empty").mkdir()
    with film(tmp_path / "cut.mp4") as out:
        for frame in pan(range(0, 60, 3)):
            out.write(frame)
    (tmp_path / "cut.mp4").write_bytes((tmp_path / "cut.mp4").read_bytes()[:300])
    for name, said in (("film.mp4", "is no video"), ("empty", "holds no images"), ("nowhere", "no such file")):
        with pytest.raises(UserError, match=said):
            open_source(tmp_path / name)
    with pytest.raises(UserError, match=r"cut\.mp4"):
        list(open_source(tmp_path / "cut.mp4").frames(64))
    mixed = images(tmp_path / "mixed", 3)
    write_png(mixed / "010.png", np.zeros((50, 50, 3), np.uint8))
    with pytest.raises(UserError, match=r"010\.png.*one size"):
        list(open_source(mixed).frames(64))
    (mixed / "010.png").write_bytes(b"x")
    with pytest.raises(UserError, match=r"010\.png: is no image"):
        list(open_source(mixed).frames(64))


# Matching


def test_pairs_reach_as_far_as_they_should():
    assert features.pairs(5, "auto", True) == [(i, j) for i in range(5) for j in range(i + 1, 5)]
    many = features.pairs(200, "auto", True)
    assert len(many) < 4000 and {(i, i + 1) for i in range(199)} <= set(many) and (0, 190) in many
    assert len(features.pairs(100, "auto", False)) == 4950, "images of a folder need not be in order"
    assert many == sorted(set(many)) and len(features.pairs(200, "exhaustive", True)) == 19900


def test_matches_are_mutual_and_clear():
    rng = np.random.default_rng(0)
    rows = rng.uniform(0, 1, (60, 128)) ** 4
    one = np.rint(rows / np.linalg.norm(rows, axis=1, keepdims=True) * 512).clip(0, 255).astype(np.uint8)
    order = rng.permutation(60)
    two = one[order]
    two[-1] = two[-2]  # two that look the same: neither is a match
    found = features.nearest_mutual(torch.from_numpy(one), torch.from_numpy(two))
    assert len(found) == 58 and np.array_equal(order[found[:, 1]], found[:, 0])
    assert found.dtype == np.uint32 and len(features.nearest_mutual(torch.from_numpy(one), torch.zeros(0, 128))) == 0


# Transforms


def random_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Similarity(float(rng.uniform(0.1, 9)), q * np.sign(np.linalg.det(q)), rng.normal(size=3) * 5)


@pytest.mark.parametrize("seed", range(3))
def test_alignment_finds_the_similarity(seed):
    truth = random_similarity(seed)
    points = np.random.default_rng(seed).normal(size=(20, 3))
    found = align(points, truth.points(points))
    assert found.scale == pytest.approx(truth.scale)
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-8)
    mirrored = align(points, points * [1, 1, -1])
    assert np.linalg.det(mirrored.rotation) == pytest.approx(1), "a mirror image is not aligned by mirroring"


def test_moved_cameras_see_moved_points_where_they_were():
    moved, views = random_similarity(4), np.stack([viewmat(index) for index in range(6)])
    after = moved.viewmats(views)
    np.testing.assert_allclose(centres(after), moved.points(centres(views)), atol=1e-9)
    for old, new in zip(views, after):
        seen = POINTS @ old[:3, :3].T + old[:3, 3]
        again = moved.points(POINTS) @ new[:3, :3].T + new[:3, 3]
        np.testing.assert_allclose(again, moved.scale * seen, atol=1e-9)
        np.testing.assert_allclose(new[:3, :3] @ new[:3, :3].T, np.eye(3), atol=1e-12)


def test_scenes_are_put_upright():
    views = random_similarity(2).viewmats(np.stack([viewmat(index, 0.3) for index in range(8)]))
    points = random_similarity(2).points(POINTS)
    placed = upright(views, points)
    np.testing.assert_allclose(np.median(placed.points(points), axis=0), 0, atol=0.5)
    after = placed.viewmats(views)
    assert (after[:, 1, 2] < -0.7).all(), "the images' down is the world's down"
    assert np.abs(after[:, 0, 2]).max() < 1e-6, "cameras were level"
    assert np.median(np.linalg.norm(centres(after), axis=1)) == pytest.approx(4, rel=0.2)


# What is written


def solved(params: tuple[float, ...], count: int = 10) -> CameraSolution:
    views = np.stack([viewmat(index) for index in range(count)])
    colors = np.full((len(POINTS), 3), 200, np.uint8)
    places = [index for index in range(count) if index != 3]
    return CameraSolution("SIMPLE_RADIAL", params, WIDTH, HEIGHT, places, views[places], POINTS, colors, 0.2, 9.0)


@pytest.mark.parametrize("bend", [0.0, -0.08, 0.05])
def test_the_written_folder_is_read_back_with_identical_cameras(tmp_path, bend):
    """Dots drawn through a lens are found where the written cameras, points and images say."""
    focal, cx, cy = 90.0, 40.0, 30.0

    def lens(rays: np.ndarray) -> np.ndarray:
        return focal * rays * (1 + bend * np.square(rays).sum(1, keepdims=True)) + (cx, cy)

    found = solved((focal, cx, cy, bend))
    names = [f"frame_{index:05d}.png" for index in range(10)]
    (tmp_path / "frames").mkdir()
    (tmp_path / "out").mkdir()
    for index, name in enumerate(names):
        cv2.imwrite(str(tmp_path / "frames" / name), dots(viewmat(index), lens=lens))
    shots = FrameFiles(tmp_path / "frames", names, tmp_path / "frames")
    pinhole = writing.undistort(shots, found, tmp_path / "out", lambda: None)
    seconds = [2.0 + 0.5 * index for index in range(10)]
    scene = writing.scene_of(shots, found, pinhole, seconds, (2.0, 7.0))
    writing.write_scene(tmp_path / "out", scene)
    train, test = load(tmp_path / "out"), load(tmp_path / "out", "test")
    assert len(train) == 8 and [frame.name for frame in test] == ["frame_00005"], "frame 3 has no camera"
    for data in (train, test):
        for frame in data:
            k = scene.names.index(f"{frame.name}.png")
            np.testing.assert_allclose(frame.camera.viewmat, scene.viewmats[k], atol=1e-5)
            K = [[pinhole.fx, 0, pinhole.cx], [0, pinhole.fy, pinhole.cy], [0, 0, 1]]
            np.testing.assert_allclose(frame.camera.K, K, atol=1e-4)
            assert (frame.camera.width, frame.camera.height) == (pinhole.width, pinhole.height)
            assert frame.mask is None and float(frame.time) == pytest.approx((seconds[found.places[k]] - 2) / 5)
    np.testing.assert_allclose(train.points, scene.points, atol=1e-6)
    assert (tmp_path / "out/masks" / names[0]).is_file() and not (tmp_path / "out/masks" / names[3]).exists()
    to_dots = align(scene.points, POINTS)
    for entry in train.entries:
        entry.camera.viewmat[:] = torch.from_numpy(to_dots.viewmats(entry.camera.viewmat.double().numpy()[None])[0])
    assert share_found(train, 0.1) > 0.75


# What is said


LINKS = Links(2000, 300, 1.0, 0.3)


def test_the_likeliest_reason_is_given():
    assert "texture" in likely_reason(Outcome(50, 0, 0, Links(30, 0, 0.0, 0.0), 0.1))
    assert "--frames 100" in likely_reason(Outcome(50, 4, 9, Links(2000, 12, 0.5, 0.2), 0.1))
    assert "--masks none" in likely_reason(Outcome(50, 4, 9, Links(2000, 12, 0.5, 0.2), 0.4))
    assert "walking" in likely_reason(Outcome(50, 0, 0, Links(2000, 300, 1.0, 1.0), 0.1))
    assert "walking" in likely_reason(Outcome(50, 50, 0.4, LINKS, 0.1))
    assert "--matching" in likely_reason(Outcome(50, 20, 9, LINKS, 0.1))
    line = too_few("out", Outcome(50, 20, 9, LINKS, 0.1))
    assert line.startswith("out: 20 of 50 frames registered") and "--least 0.4 " in line
    assert "--least" not in too_few("out", Outcome(50, 0, 0, LINKS, 0.1))
    assert not notes(Outcome(50, 50, 9, LINKS, 0.1)) and len(notes(Outcome(50, 40, 9, LINKS, 0.1))) == 1
    assert "uncertain" in notes(Outcome(50, 50, 1.0, LINKS, 0.1))[0]


def test_the_journal_does_work_once(tmp_path):
    made: list[str] = []

    def run(folder, source="film", **settings):
        journal = Journal(folder, source)
        journal.start()
        for name in ("a", "b"):
            value = settings.get(name, 0)
            journal.stage(name, value, lambda n=name, v=value: made.append(f"{n}{v}") or {"v": v}, lambda: None)
        return journal

    run(tmp_path / "x")
    run(tmp_path / "x")
    assert made == ["a0", "b0"]
    run(tmp_path / "x", b=1)
    assert made[2:] == ["b1"]
    assert run(tmp_path / "x", a=1, b=1).result("a") == {"v": 1} and made[3:] == ["a1", "b1"]
    with pytest.raises(UserError, match="another video"):
        run(tmp_path / "x", "other")
    (tmp_path / "x/transforms.json").write_text("{}")
    run(tmp_path / "x", a=1, b=1)
    with pytest.raises(UserError, match="finished"):
        run(tmp_path / "x", a=2, b=1)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/letter.txt").write_text("dear")
    with pytest.raises(UserError, match="something else"):
        run(tmp_path / "mine")
    assert json.loads((tmp_path / "x/work/journal.json").read_text())["stages"]["a"]["result"] == {"v": 1}
