"""Pictures of cameras that record in different sizes, or are held in different ways."""

from __future__ import annotations

import pytest

from helpers.films import pan
from scgs_warp.capture.rig.common_size import CommonSize, common_size, common_size_of
from scgs_warp.capture.rig.request import videos_of
from scgs_warp.capture.source import Video
from scgs_warp.errors import UserError
from scgs_warp.visualization.video import film


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
    assert common_size(videos(tmp_path, *sizes), 1000) == expected
    assert common_size(videos(tmp_path, *sizes), 48) == expected._replace(longest=48, limited_by=None)


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
    for broken in (None, [], {}, {**whole, "turns": [0]}, {**whole, "turns": [0, "x"]}, {**whole, "limited_by": 2}):
        assert common_size_of(broken, 2) is None, broken


def test_films_of_camcorders_and_old_phones_are_films(tmp_path):
    names = {"00001.MTS", "b.3gp", "c.mp4", "d.MXF", "e.ts", "f.dv", "MOV001.MOD"}
    for name in (*names, "d.txt"):
        (tmp_path / name).write_bytes(b"x")
    assert {file.name for file in videos_of(tmp_path)} == names
    for name in names - {"00001.MTS"}:
        (tmp_path / name).unlink()
    with pytest.raises(UserError, match="holds 1 videos"):
        videos_of(tmp_path)
    for name in ("cam1", "cam10", "cam2"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "0000.png").write_bytes(b"x")
    with pytest.raises(UserError, match=r"folders of images \(cam1 to cam10\); make a video of each"):
        videos_of(tmp_path)
