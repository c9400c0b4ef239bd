"""Dense flow: a known shift is found, hidden and bare places are told, and threads change nothing."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from scgs_warp.geometry.optical_flow import at_targets, dense_flow, returns, targets_of, textured

HEIGHT, WIDTH = 96, 128


def texture(shift: tuple[float, float] = (0.0, 0.0), seed: int = 0) -> np.ndarray:
    """Return smooth noise [H, W] uint8 that is moved by ``shift`` (x, y) pixels."""
    noise = np.random.default_rng(seed).random((HEIGHT + 40, WIDTH + 40)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 2.0)
    noise = (noise - noise.min()) / (noise.max() - noise.min()) * 255
    move = np.array([[1.0, 0.0, shift[0] - 20], [0.0, 1.0, shift[1] - 20]], np.float32)
    return cv2.warpAffine(noise, move, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


def test_a_shift_is_found():
    flow = dense_flow(texture(), texture((3.4, -2.2)))
    assert flow.shape == (HEIGHT, WIDTH, 2) and flow.dtype == np.float32
    inner = flow[12:-12, 12:-12].reshape(-1, 2)
    np.testing.assert_allclose(np.median(inner, 0), [3.4, -2.2], atol=0.1)
    assert np.quantile(np.abs(inner - [3.4, -2.2]), 0.95) < 0.3


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_threads_change_nothing(threads):
    expected = dense_flow(texture(), texture((2.0, 1.0)))
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        assert np.array_equal(dense_flow(texture(), texture((2.0, 1.0))), expected)
        assert cv2.getNumThreads() == threads, "the setting of others is left as it was"
    finally:
        cv2.setNumThreads(before)


def test_pixels_that_leave_the_image_or_are_hidden_do_not_return():
    forth = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    back = np.zeros_like(forth)
    forth[:, -5:, 0] = 10.0  # leaves on the right
    forth[10:20, 30:40, 0] = 4.0  # its way back is another's: hidden
    stays = returns(forth, back, 1.0)
    assert not stays[:, -5:].any() and not stays[10:20, 30:40].any()
    stays[:, -5:], stays[10:20, 30:40] = True, True
    assert stays.all()
    forth[10:20, 30:40] = 0.9
    assert not returns(forth, back, 1.0)[10:20, 30:40].any() and returns(forth, back, 1.3)[10:20, 30:40].all()


def test_targets_and_samples():
    flow = np.full((4, 6, 2), (1.0, 0.5), np.float32)
    targets = targets_of(flow)
    assert targets[0, 0].tolist() == [1.0, 0.5] and targets[3, 5].tolist() == [6.0, 3.5]
    ramp = np.tile(np.arange(6, dtype=np.float32), (4, 1))
    np.testing.assert_allclose(at_targets(ramp, targets)[:, :5], ramp[:, :5] + 1.0, atol=0.05)
    assert at_targets(ramp, targets)[0, 5] == 5.0, "beyond the border, its value counts"


def test_bare_places_have_no_texture():
    image = texture()
    image[:, :64] = 120
    found = textured(image)
    assert not found[:, :58].any() and found[:, 70:].mean() > 0.9
