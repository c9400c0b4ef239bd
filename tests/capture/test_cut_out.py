"""Pictures that are cut out by alpha."""

from __future__ import annotations

import cv2
import numpy as np

from scgs_warp.capture import cut_out
from scgs_warp.capture.source import Folder, is_hidden, read_cut_out
from scgs_warp.storage.png_files import write_png


def disc(color=(200, 100, 50), hidden=(0, 255, 0)) -> np.ndarray:
    """[64, 64, 4]: a disc of one colour, and another one where it is transparent."""
    y, x = np.mgrid[:64, :64]
    inside = np.hypot(x - 31.5, y - 31.5) < 20
    return np.dstack([np.where(inside[..., None], color, hidden), 255 * inside]).astype(np.uint8)


def test_hidden_colours_do_not_bleed():
    image, alpha = cut_out.split(disc())
    assert alpha is not None and not image[alpha == 0].any()
    for size in ((64, 64), (31, 23), (10, 10)):
        small, opacity = cut_out.resized(image, alpha, size)
        assert opacity is not None and small.shape == (*size[::-1], 3) and 0 < (opacity > 0).mean() < 0.5
        assert np.abs(small[opacity > 0].astype(int) - (200, 100, 50)).max() <= 2, size
    assert cut_out.split(np.full((4, 4, 4), 255, np.uint8))[1] is None


def test_single_pixels_do_not_make_a_picture_cut_out():
    alpha = np.full((64, 64), 255, np.uint8)
    assert not cut_out.is_cut_out(alpha) and not cut_out.is_cut_out(None)
    alpha[0, :3] = 0
    assert not cut_out.is_cut_out(alpha)
    alpha[:8] = 0
    assert cut_out.is_cut_out(alpha)


def test_images_of_a_folder_keep_their_alpha(tmp_path):
    write_png(tmp_path / "1.png", disc())
    cv2.imwrite(str(tmp_path / "2.png"), disc()[..., [2, 1, 0, 3]].astype(np.uint16) * 257)
    cv2.imwrite(str(tmp_path / "3.webp"), disc()[..., [2, 1, 0, 3]], [cv2.IMWRITE_WEBP_QUALITY, 101])
    write_png(tmp_path / "4.png", disc()[..., :3])
    stills = list(Folder(tmp_path).frames(32))
    for still in stills[:3]:
        assert still.alpha is not None and cut_out.is_cut_out(still.alpha), still.name
        assert np.abs(still.image[still.alpha == 255].astype(int) - (200, 100, 50)).max() <= 2, still.name
        assert not still.image[still.alpha == 0].any(), still.name
    assert stills[3].alpha is None and stills[3].image[0, 0].tolist() == [0, 255, 0]
    assert is_hidden(tmp_path / "1.png").mean() > 0.5 and not is_hidden(tmp_path / "4.png").any()
    assert read_cut_out(tmp_path / "4.png")[1] is None
