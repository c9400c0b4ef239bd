"""The D-NeRF layout: times of frames, also where they are not stated."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PillowImage

from helpers.dnerf_files import HEIGHT, IDENTITY, WIDTH, edit, write_scene
from scgs_warp.data import load
from scgs_warp.errors import UserError


def test_either_all_files_have_times_or_none(tmp_path):
    """Times by order within one file would not fit those of the other."""
    scene, test = tmp_path / "s", tmp_path / "s/transforms_test.json"
    write_scene(scene)
    timed = test.read_text()
    content = json.loads(timed)
    content["frames"][0].pop("time")
    test.write_text(json.dumps(content))
    for split in ("test", "val"):
        with pytest.raises(
            UserError, match=r"transforms_test\.json: its frames have no time.*or remove transforms_test"
        ):
            load(scene, split)
    assert len(load(scene, "train")) == 3
    edit(scene, lambda content: [frame.pop("time") for frame in content["frames"]])
    assert load(scene, "test").times.tolist() == [0.0]
    test.write_text(timed)
    with pytest.raises(
        UserError, match=r"transforms_train\.json: its frames have no time, but those of transforms_test"
    ):
        load(scene, "test")


@pytest.mark.parametrize("unit", [30.0, 1.5, -1.0])
def test_times_in_other_units_are_scaled_alike_in_all_files(tmp_path, unit):
    """Seconds, or numbers of frames; the held-out frame is of the middle of the film."""
    scene, test = tmp_path / "s", tmp_path / "s/transforms_test.json"
    write_scene(scene)
    edit(scene, lambda content: [frame.update(time=7 + unit * frame["time"]) for frame in content["frames"]])
    content = json.loads(test.read_text())
    content["frames"][0]["time"] = 7 + unit / 2
    test.write_text(json.dumps(content))
    train, held = load(scene), load(scene, "test")
    assert train.times.tolist() == ([0.0, 0.5, 1.0] if unit > 0 else [1.0, 0.5, 0.0]) and held.times.tolist() == [0.5]
    assert any("are scaled to go from 0 to 1" in note for note in train.notes)
    edit(scene, lambda content: [frame.update(time=2.0) for frame in content["frames"]])
    test.unlink()
    assert load(scene).times.tolist() == [0.0, 0.0]  # one of three is held out


def write_animation(folder: Path, train: range, test: range, name: str = "{}/{:04d}.png") -> None:
    """What BlenderNeRF writes of an animation: pictures numbered by its frames, without times."""
    for split, numbers in (("train", train), ("test", test)):
        entries = []
        for number in numbers:
            path = folder / name.format(split, number)
            path.parent.mkdir(parents=True, exist_ok=True)
            PillowImage.new("RGB", (WIDTH, HEIGHT), (number, 9, 9)).save(path)
            entries.append({"file_path": name.format(split, number), "transform_matrix": IDENTITY})
        content = {"camera_angle_x": 0.8, "w": float(WIDTH), "h": float(HEIGHT), "frames": entries}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))


@pytest.mark.parametrize("step", [1, 3, 5])
def test_pictures_of_an_animation_have_the_times_of_its_frames(tmp_path, step):
    """The last training picture is not of the last frame if the step does not divide their number."""
    write_animation(tmp_path, range(1, 13, step), range(1, 13))
    for split, numbers in (("train", range(1, 13, step)), ("test", range(1, 13)), ("val", range(1, 13))):
        expected = [(number - 1) / 11 for number in numbers]
        assert load(tmp_path, split).times.tolist() == pytest.approx(expected, abs=1e-6)
    assert load(tmp_path, "train", frames="::2").times.tolist()[0] == 0.0


@pytest.mark.parametrize("listed", [range(1, 13), range(0)])
def test_held_out_views_that_were_never_rendered(tmp_path, listed):
    """BlenderNeRF renders training views only: its file of test views lists a camera path, or nothing."""
    write_animation(tmp_path, range(1, 13), listed)
    if listed:
        shutil.rmtree(tmp_path / "test")
    train, test = load(tmp_path), load(tmp_path, "test")
    assert [frame.name for frame in test] == ["0005"] and len(train) == 11
    for data in (train, test):
        assert any("transforms_test.json: is not used, because none of its frames has" in note for note in data.notes)
    assert load(tmp_path, "val").times.tolist() == pytest.approx([4 / 11])
    (tmp_path / "transforms_train.json").unlink()
    with pytest.raises(UserError, match=r"images of 12 of 12 frames are missing|lists? at least one frame"):
        load(tmp_path, "test")


@pytest.mark.parametrize(
    ("train", "test", "name"),
    [
        (range(10), range(20), "{}/r_{}.png"),  # NeRF's scenes have twice as many test views
        (range(30), range(7), "{}/r_{:03d}.png"),  # D-NeRF's have fewer
        (range(1, 4), range(1, 4), "{}/{}th.png"),
    ],
)
def test_files_that_number_their_own_views_keep_the_times_of_their_order(tmp_path, train, test, name):
    write_animation(tmp_path, train, test, name)
    for split, numbers in (("train", train), ("test", test)):
        times = load(tmp_path, split).times.tolist()
        assert times == pytest.approx(np.linspace(0.0, 1.0, len(numbers)).tolist(), abs=1e-6)


def test_frames_of_one_film_have_the_times_of_their_numbers(tmp_path):
    """A film without times, split over two files, whose frames are listed in the order in which a program ended."""
    held = range(5, 40, 8)
    write_animation(tmp_path, range(40), held, "images/{1}.png")
    edit(tmp_path, lambda content: content.update(frames=[f for i, f in enumerate(content["frames"]) if i not in held]))
    edit(tmp_path, lambda content: content["frames"].reverse())
    for split in ("train", "test"):
        for frame in load(tmp_path, split):
            assert frame.time == pytest.approx(int(frame.name) / 39, abs=1e-6)
    (tmp_path / "transforms_test.json").unlink()
    ranks = {str(number): rank for rank, number in enumerate(n for n in range(40) if n not in held)}
    for frame in load(tmp_path):
        assert frame.time == pytest.approx(ranks[frame.name] / 34, abs=1e-6)


@pytest.mark.parametrize(("key", "factor"), [("timestep_index", 1), ("timestamp", 0.04)])
def test_other_fields_that_tell_the_time(tmp_path, key, factor):
    """NeRSemble's heads: 16 cameras, whose images are in one folder, share each timestep. NeRFCapture has a clock."""
    write_scene(tmp_path, frames=6)

    def change(content):
        for index, entry in enumerate(content["frames"]):
            del entry["time"]
            entry[key] = 7 + index // 2 * factor

    edit(tmp_path, change)
    test = json.loads((tmp_path / "transforms_train.json").read_text())
    test["frames"] = test["frames"][2:3]
    (tmp_path / "transforms_test.json").write_text(json.dumps(test))
    assert load(tmp_path).times.tolist() == pytest.approx([0.0, 0.0, 0.5, 0.5, 1.0, 1.0])
    assert load(tmp_path, "test").times.tolist() == pytest.approx([0.5])


def test_held_out_times_that_training_does_not_reach_are_noted(tmp_path):
    """VHAP's exports of heads hold out the end of the film as test, and a camera as val."""
    write_scene(tmp_path, frames=10)
    content = json.loads((tmp_path / "transforms_train.json").read_text())
    for split, frames in (("train", range(7)), ("test", range(7, 10)), ("val", range(2, 8))):
        listed = content | {"frames": [content["frames"][index] for index in frames]}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(listed))
    told = "2 of 3 frames are of times beyond those of transforms_train.json"
    assert any(
        told in note and note.endswith("evaluate --split val scores others") for note in load(tmp_path, "test").notes
    )
    for split in ("train", "val"):
        assert not any("beyond those" in note for note in load(tmp_path, split).notes)
