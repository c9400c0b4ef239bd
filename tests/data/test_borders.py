"""Black borders of a video, and masks reduced with the images."""

from __future__ import annotations

import numpy as np

from scgs_warp.data.borders import border_mask, reduce_mask


def test_a_black_ground_is_no_border():
    images = [np.zeros((30, 40, 3), np.uint8) for _ in range(6)]
    for image in images:
        image[10:20, 10:30] = 100
    assert border_mask(images) is None
    assert border_mask(images[:2]) is None


def test_a_reduced_pixel_is_valid_only_if_all_beneath_are():
    mask = np.ones((4, 4), bool)
    mask[0, 3] = False
    assert reduce_mask(mask, (2, 2)).tolist() == [[True, False], [True, True]]
