"""Assembly of a data set: alpha that counts, the border of the video, frames that masks leave empty."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from helpers.nerfstudio_files import HEIGHT, WIDTH, rewrite, save, write
from helpers.tiny import tiny_config
from scgs_warp.data import assemble, images, load
from scgs_warp.errors import UserError
from scgs_warp.training.state import TrainState


def with_alpha(image: np.ndarray, bits: int) -> np.ndarray:
    """RGBA that is opaque everywhere, of 8 or 16 bits."""
    most = 2**bits - 1
    image = image.astype(np.uint8 if bits == 8 else np.uint16) * (most // 255)
    return np.dstack([image, np.full_like(image[..., :1], most)])


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("background", ["black", "white", "random"])
def test_opaque_rgba_is_rgb(tmp_path, bits, background):
    """Filled images stay filled: a border is masked, bare walls get points, large Gaussians are kept."""
    write(tmp_path)

    def bordered(index: int, image: np.ndarray) -> np.ndarray:
        image[0] = 0
        return image

    rewrite(tmp_path, bordered)
    expected = load(tmp_path, background=background)
    # Some with alpha, some without, as a tool leaves them that saves what it has touched.
    rewrite(tmp_path, lambda index, image: with_alpha(image, bits) if bits == 16 or index % 2 else image)
    data = load(tmp_path, background=background)
    for plain, frame in zip(expected, data):
        assert frame.alpha is None and torch.allclose(frame.image, plain.image, rtol=0, atol=1e-6)
        assert frame.mask is not None and torch.equal(frame.mask, plain.mask)
    config = tiny_config(20, data={"background": background}, motion={"hyper_dim": 0})
    state = TrainState.begin(config, data, "cpu")
    assert (state.config.densify.prune_large, state.config.motion.hyper_dim) == ("never", 1)
    assert len(state.gaussians) == config.init_points > len(data.points)


def test_one_image_that_an_object_fills_keeps_its_alpha(tmp_path):
    write(tmp_path)

    def cut_out(index: int, image: np.ndarray) -> np.ndarray:
        image = with_alpha(image, 8)
        if index != 1:
            image[:4, :, 3] = 200
        return image

    rewrite(tmp_path, cut_out)
    data = load(tmp_path)
    assert all(frame.alpha is not None and frame.mask is None for frame in data)
    assert (data[1].alpha == 1).all() and (data[0].alpha[:4] < 0.8).all()
    kept = TrainState.begin(tiny_config(20, motion={"hyper_dim": 2}), data, "cpu").config
    assert (kept.densify.prune_large, kept.motion.hyper_dim) == ("always", 2)


@pytest.mark.parametrize("count", [47, 49])
def test_a_border_takes_few_images_to_find(tmp_path, monkeypatch, count):
    write(tmp_path, count)
    seen = []
    monkeypatch.setattr(assemble, "decode", lambda file: seen.append(file.stem) or images.decode(file))
    load(tmp_path)
    assert len(seen) == assemble.BORDER_FRAMES
    assert {"f_0", f"f_{count - 1}"} <= set(seen), "from the whole video"


@pytest.mark.parametrize("what", ["reduction", "border"])
def test_a_mask_that_leaves_nothing_is_told(tmp_path, what):
    content = write(tmp_path)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    if what == "border":
        rewrite(tmp_path, lambda index, image: cv2.rectangle(image, (0, 0), (WIDTH, 1), (0, 0, 0), -1))
        mask[0] = 255
    else:
        mask[::2, ::2] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    content["frames"][3]["mask_path"] = "mask.png"
    save(tmp_path, content)
    if what == "reduction":
        assert load(tmp_path)[3].mask.sum() == HEIGHT * WIDTH / 4
    with pytest.raises(UserError, match=r"f_3\.png: no pixel is left") as caught:
        load(tmp_path, downscale=2 if what == "reduction" else 1)
    assert "mask_path" in str(caught.value)
