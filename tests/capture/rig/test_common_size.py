"""Pictures of cameras that record in different sizes, or are held in different ways."""

from __future__ import annotations

import json
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.films import pan
from scgs_warp.capture.bars import Bars
from scgs_warp.capture.rig.common_size import CommonSize, common_size, common_size_of
from scgs_warp.capture.rig.request import videos_of
from scgs_warp.capture.source import Video
from scgs_warp.errors import UserError
from scgs_warp.visualization.video import film


def silent(total: int, text: str):
    return nullcontext(SimpleNamespace(advance=lambda: None))


def videos(folder, *sizes: tuple[int, int]) -> list[Video]:
    made = []
    for index, (width, height) in enumerate(sizes):
        with film(folder / f"cam{index}.mp4") as out:
            for picture in pan([0, 2], height, width):
                out.write(picture)
        made.append(Video(folder / f"cam{index}.mp4"))
    return made


@pytest.mark.parametrize(
    ("sizes", "expected"),
    [
        ([(160, 90)] * 3, CommonSize(160, [0, 0, 0], None)),
        ([(160, 90), (90, 160), (160, 90)], CommonSize(160, [0, 1, 0], None)),
        ([(90, 160), (160, 90), (90, 160)], CommonSize(160, [0, 3, 0], None)),
        ([(90, 160), (160, 90)], CommonSize(160, [0, 3], None)),
        ([(640, 90), (600, 90), (640, 90)], CommonSize(600, [0, 0, 0], None)),
        ([(640, 90), (640, 90), (560, 48)], CommonSize(560, [0, 0, 0], None)),
        ([(690, 90), (690, 90), (490, 48)], CommonSize(490, [0, 0, 0], 2)),
        ([(690, 90), (690, 90), (64, 48)], CommonSize(480, [0, 0, 0], 2)),
        ([(160, 90), (160, 90), (64, 48)], CommonSize(160, [0, 0, 0], 2)),
    ],
)
def test_the_smallest_and_the_most_decide(tmp_path, sizes, expected):
    made, frames = videos(tmp_path, *sizes), np.zeros((len(sizes), 1), int)
    assert common_size(made, frames, 1000, silent) == expected
    assert common_size(made, frames, 48, silent) == expected._replace(longest=48, limited_by=None)


def barred(path, width: int, height: int, bars: Bars, dark: int = 0) -> Video:
    """Film a pan of this size with black bars beside it; ``dark`` pixels beside them are a dark wall."""
    with film(path, quality=12) as out:
        for picture in pan(range(0, 12, 2), height, width):
            if bars.left:
                picture[:, :dark] = picture[:, width - dark :] = np.arange(height)[:, None, None] % 50
            out.write(np.pad(picture, (bars[:2], bars[2:], (0, 0))))
    return Video(path)


def test_black_bars_of_each_camera_are_cut_off(tmp_path):
    """Bars that an editing program put beside the films became walls, and an upright film in a wide one was narrow."""
    wide, upright, letter = Bars(0, 0, 80, 80), Bars(0, 0, 90, 90), Bars(30, 30, 0, 0)
    frames = np.tile(np.arange(6), (3, 1))
    made = [barred(tmp_path / f"{k}.mp4", 240, 120, letter) for k in range(2)]
    size = common_size([*made, barred(tmp_path / "whole.mp4", 240, 180, Bars())], frames, 1000, silent)
    assert size.bars == (Bars(32, 32), Bars(32, 32), Bars()) and size.longest == 240 and size.limited_by is None
    assert size.shown(0, np.zeros((180, 240, 3))).shape == (116, 240, 3)
    assert "bars beside the pictures of a, b are cut off" in size.describe(["a", "b", "c"])[0]
    assert common_size_of(json.loads(json.dumps(size._asdict())), 3) == size == common_size_of(size._asdict(), 3)

    made = [barred(tmp_path / f"dark{k}.mp4", 160, 120, wide, dark=60 * k) for k in range(2)]
    size = common_size(made, frames[:2], 1000, silent)
    assert size.bars == (Bars(0, 0, 82, 82),) * 2 and size.wholes == (320, 320), "bars are as wide beside a dark wall"

    made = [barred(tmp_path / "upright.mp4", 100, 180, upright), barred(tmp_path / "wide.mp4", 280, 158, Bars())]
    size = common_size(made, frames[:2], 1000, silent)
    assert size.turns == [0, 3] and size.longest == 280
    assert size.shown(0, next(iter(made[0].frames(size.whole(0)))).image).shape == (180, 96, 3)


def test_what_was_changed_is_said():
    names = ["a", "b", "c"]
    assert CommonSize(160, [0, 0, 0], None).describe(names) == []
    turned, small = CommonSize(64, [0, 1, 1], 2).describe(names)
    assert "b, c are turned by a quarter" in turned and "as small as those of c; without its video" in small


def test_the_journal_keeps_it():
    for size in (CommonSize(160, [0, 1], None), CommonSize(64, [0, 0], 1)):
        assert common_size_of(size._asdict(), 2) == size
    earlier = common_size_of(True, 2)
    assert earlier is not None and earlier.turns == [0, 0] and earlier.describe(["a", "b"]) == []
    whole = CommonSize(64, [0, 0], 1)._asdict()
    for broken in (
        None,
        [],
        {},
        {**whole, "turns": [0]},
        {**whole, "turns": [0, "x"]},
        {**whole, "limited_by": 2},
        {**whole, "bars": [[1]]},
    ):
        assert common_size_of(broken, 2) is None, broken


def test_films_of_camcorders_and_old_phones_are_films(tmp_path):
    names = {"00001.MTS", "b.3gp", "c.mp4", "d.MXF", "e.ts", "f.dv", "MOV001.MOD"}
    for name in (*names, "d.txt"):
        (tmp_path / name).write_bytes(b"x")
    assert {file.name for file in videos_of(tmp_path).values()} == names
    for name in names - {"00001.MTS"}:
        (tmp_path / name).unlink()
    with pytest.raises(UserError, match="holds 1 videos"):
        videos_of(tmp_path)
    for name in ("cam1", "cam10", "cam2"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "0000.png").write_bytes(b"x")
    with pytest.raises(UserError, match=r"folders of images \(cam1 to cam10\); make a video of each"):
        videos_of(tmp_path)
