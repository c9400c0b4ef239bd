"""Times in the names of images."""

from __future__ import annotations

import pytest

from scgs_warp.data.name_times import times_from_names


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["frame_9.png", "frame_10.png", "frame_12.png"], [0.0, 1 / 3, 1.0]),  # 11 was not registered
        (["left/1.png", "left/2.png", "right/1.png"], [0.0, 1.0, 0.0]),
        (["a.png", "b.png", "c.png"], [0.0, 0.5, 1.0]),
        (["a1.png", "b.png", "c1.png"], [0.0, 0.5, 1.0]),
        (["7.png", "b7.png", "c7.png"], [0.0, 0.5, 1.0]),
        (["only 1.png"], [0.0]),
        (["8.3.png", "8.75.png", "9.031.png", "10.3.png"], [0.0, 0.225, 0.3655, 1.0]),  # seconds
        (["take 2.9.png", "take 2.10.png", "take 2.11.png"], [0.0, 0.5, 1.0]),
        (["cam1.0001.png", "cam1.0002.png", "cam2.0001.png", "cam2.0002.png"], [0.0, 1.0, 0.0, 1.0]),
        (["0000_cam1.png", "0000_cam2.png", "0003_cam1.png", "0004_cam2.png"], [0.0, 0.0, 0.75, 1.0]),
        (["Camera 1-0005.png", "Camera 2-0005.png", "Camera 2-0009.png"], [0.0, 0.0, 1.0]),
        (["cam_0001.png", "cam_0002.png", "cam_0005.png"], [0.0, 0.25, 1.0]),
        (["1403636579763555584.png", "1403636579813555584.png", "1403636579913555584.png"], [0.0, 1 / 3, 1.0]),
        (
            ["frame_20240101120000000.png", "frame_20240101120001500.png", "frame_20240101120100000.png"],
            [0.0, 0.025, 1.0],
        ),
        (["IMG_20240131_235958.jpg", "IMG_20240131_235959.jpg", "IMG_20240201_000002.jpg"], [0.0, 0.25, 1.0]),
        (
            ["20240101_120000250.jpg", "20240101_120000500.jpg", "PXL_20240101_120001250~2.jpg"],
            [0.0, 0.25, 1.0],
        ),
        (["Screenshot 2024-01-31 at 23.59.58.png", "Screenshot 2024-02-01 at 00.00.01.png"], [0.0, 1.0]),
        (["20240131_235959_1.png", "20240131_235959_2.png", "20240131_235959_11.png"], [0.0, 0.1, 1.0]),  # one film
        (["x20241399_235958.png", "x20241399_235959.png", "x20241399_240002.png"], [0.0, 1 / 4044, 1.0]),  # no date
        (["0h00m58s.jpg", "0h00m59s.jpg", "0h01m02s.jpg"], [0.0, 0.25, 1.0]),
        (["1700000000_750000000.png", "1700000001_000000000.png", "1700000001_750000000.png"], [0.0, 0.25, 1.0]),
        (
            ["1700000000_5000000.png", "1700000000_255000000.png", "1700000001_5000000.png"],
            [0.0, 0.25, 1.0],
        ),  # no zeros
        (["12_750000000.png", "13_000000000.png", "13_750000000.png"], [0.0, 0.25, 1.0]),
        (["frame_1.5s.png", "frame_2.0s.png", "frame_3.5s.png"], [0.0, 0.25, 1.0]),
        (["0001_left2.jpg", "0002_right1.jpg", "0005_left2.jpg"], [0.0, 0.25, 1.0]),
        (["GOPR0001.JPG", "GOPR0002 (1).JPG", "GOPR0005~2.JPG"], [0.0, 0.25, 1.0]),
        (["frame (1).jpg", "frame (2).jpg", "frame (5).jpg"], [0.0, 0.25, 1.0]),
        (["0007_1.png", "0007_2.png", "0008_1.png", "0011_2.png"], [0.0, 0.0, 0.25, 1.0]),
        (["12_003.png", "13_003.png", "14_003.png", "12_004.png"], [0.0, 0.0, 0.0, 1.0]),
        (["v1.2_0003.png", "v2.2_0004.png", "v3.2_0007.png"], [0.0, 0.25, 1.0]),
    ],
)
def test_times_in_names(names, expected):
    assert times_from_names(names) == pytest.approx(expected, abs=1e-6)
