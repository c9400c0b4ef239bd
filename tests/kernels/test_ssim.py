"""The photometric loss against its float64 twin: values, gradients, masks, odd sizes, every form."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from reference.ssim import photometric_loss as reference_loss
from scgs_warp.kernels.types import SSIM_BAND, SSIM_BLOCK, SSIM_TILE_COLUMNS, SSIM_TILE_ROWS
from scgs_warp.ops.ssim import LEAST_ERROR, photometric_loss, ssim
from scgs_warp.runtime import environment

SHAPES = [
    (3, 37, 53),
    (1, 1, 1),
    (2, 5, 16),
    (3, 11, 17),
    (1, SSIM_BAND + 1, 7),
    (3, SSIM_BAND, 2 * SSIM_BLOCK + 3),
    (4, 90, 31),
    (2, SSIM_TILE_ROWS, SSIM_TILE_COLUMNS),
    (1, 2 * SSIM_TILE_ROWS + 1, 2 * SSIM_TILE_COLUMNS + 1),
]


def _pair(shape: tuple[int, ...], seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A noisy and a clean image with edges, flat parts and texture."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, shape[0], 4, 4, generator=generator)
    truth = torch.nn.functional.interpolate(coarse, shape[1:], mode="nearest")[0]
    truth = truth * (0.7 + 0.3 * torch.rand(shape, generator=generator))
    return (truth + 0.1 * torch.randn(shape, generator=generator)).clamp(0, 1), truth


def _forms(device: str) -> list[str]:
    return ["plain", "cpu" if device == "cpu" else "cuda"]


def _compare(image, truth, mask, weight, device, form, log_weight=0.0):
    """Values and gradients of all three outputs together against the twin."""
    mix = torch.tensor([1.0, 0.3, -0.7])
    ours = image.to(device).requires_grad_()
    values = torch.stack(
        photometric_loss(
            ours, truth.to(device), None if mask is None else mask.to(device), weight, log_weight, form=form
        )
    )
    (gradient,) = torch.autograd.grad(values @ mix.to(device), ours)
    theirs = image.double().requires_grad_()
    expected = torch.stack(reference_loss(theirs, truth, mask, weight, log_weight))
    (expected_gradient,) = torch.autograd.grad(expected @ mix.double(), theirs)
    torch.testing.assert_close(values.cpu().double(), expected, rtol=2e-5, atol=2e-6)
    scale = expected_gradient.abs().max()
    torch.testing.assert_close(gradient.cpu().double(), expected_gradient, rtol=1e-3, atol=float(1e-4 * scale))


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_value_and_gradient(shape, seed, device):
    image, truth = _pair(shape, seed)
    for form in _forms(device):
        _compare(image, truth, None, 0.2, device, form)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_value_and_gradient_with_mask(shape, seed, device):
    image, truth = _pair(shape, seed)
    mask = torch.rand(shape[1:], generator=torch.Generator().manual_seed(seed + 100)) > 0.3
    mask[0, 0] = True
    for form in _forms(device):
        _compare(image, truth, mask, 0.5, device, form)


def _on_black(shape: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
    """A pair of images with two limbs, black between and below them, and a speck above, which differ in place."""
    pair = _pair(shape, 12)
    rows, columns = torch.arange(shape[1])[:, None], torch.arange(shape[2])
    for picture, shift in zip(pair, (0, 3)):
        limbs = ((columns + shift) % 130 < 17) & (rows > 20 + shift) & (rows < shape[1] - 30)
        picture *= limbs | ((rows == 9) & (columns == shape[2] - 19 - shift))
    return pair


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", [(3, 90, 150), (2, SSIM_BAND + 60, 2 * SSIM_BLOCK + 21)], ids=str)
def test_subjects_on_black(shape, masked, device):
    image, truth = _on_black(shape)
    mask = torch.rand(shape[1:], generator=torch.Generator().manual_seed(12)) > 0.3 if masked else None
    for form in _forms(device):
        _compare(image, truth, mask, 0.2, device, form, log_weight=0.002)


@pytest.mark.parametrize("shape", [(3, 90, 150), (2, SSIM_BAND + 60, 2 * SSIM_BLOCK + 21)], ids=str)
def test_skipped_windows_change_no_bit(shape):
    """Without a mask, the cpu form skips windows that are black in image and truth. With one, it computes
    their pixels."""
    image, truth = _on_black(shape)
    results = []
    for mask in (None, torch.ones(shape[1:], dtype=torch.bool)):
        leaf = image.clone().requires_grad_()
        values = photometric_loss(leaf, truth, mask, 0.2, 0.002, form="cpu")
        values[0].backward()
        results.append((torch.stack(values).detach(), leaf.grad))
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])


def test_black_images_are_alike(device):
    black = torch.zeros(3, 40, 70, device=device)
    for form in _forms(device):
        leaf = black.clone().requires_grad_()
        loss, l1, similarity = photometric_loss(leaf, black, form=form)
        loss.backward()
        assert abs(float(loss.detach())) < 1e-6 and float(l1.detach()) == 0.0
        assert abs(float(similarity.detach()) - 1.0) < 1e-6
        assert not leaf.grad.any()


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_logarithm_of_the_squared_error(shape, masked, device):
    image, truth = _pair(shape, 9)
    mask = torch.rand(shape[1:], generator=torch.Generator().manual_seed(9)) > 0.3
    mask[0, 0] = True
    for form in _forms(device):
        _compare(image, truth, mask if masked else None, 0.2, device, form, log_weight=0.3)


def test_logarithm_is_constant_below_its_least_error(device):
    """An image that is right has no gradient from it, and no infinite loss."""
    _, truth = _pair((3, 20, 30), 10)
    for form in _forms(device):
        for image in (truth, truth + 2e-4):
            with_log, without = (image.to(device).clone().requires_grad_() for _ in range(2))
            loss = photometric_loss(with_log, truth.to(device), None, 0.2, 1.0, form=form)[0]
            plain = photometric_loss(without, truth.to(device), None, 0.2, form=form)[0]
            loss.backward()
            plain.backward()
            torch.testing.assert_close(loss - plain, torch.tensor(LEAST_ERROR, device=device).log())
            assert torch.equal(with_log.grad, without.grad)


def test_equal_pixels_have_no_slope(device):
    _, truth = _pair((3, 20, 40), 11)
    for form in _forms(device):
        leaf = truth.to(device).clone().requires_grad_()
        photometric_loss(leaf, truth.to(device), None, 0.0, form=form)[0].backward()
        assert not leaf.grad.any()


def test_what_lies_under_the_mask_does_not_matter(device):
    image, truth = _pair((3, 40, 50), 3)
    mask = torch.ones(40, 50, dtype=torch.bool)
    mask[10:20, 15:40] = False
    spoiled = torch.where(mask, image, torch.tensor(float("nan")))
    for form in _forms(device):
        results = []
        for start in (image, spoiled):
            leaf = start.to(device).requires_grad_()
            values = photometric_loss(leaf, truth.to(device), mask.to(device), form=form)
            values[0].backward()
            results.append((torch.stack(values).detach(), leaf.grad))
        torch.testing.assert_close(results[0], results[1], rtol=0, atol=0)
        assert (results[0][1][:, ~mask.to(device)] == 0).all()


def test_no_valid_pixel_is_no_loss(device):
    image, truth = _pair((3, 20, 20), 4)
    for form in _forms(device):
        leaf = image.to(device).requires_grad_()
        mask = torch.zeros(20, 20, dtype=torch.bool, device=device)
        loss, l1, similarity = photometric_loss(leaf, truth.to(device), mask, form=form)
        loss.backward()
        assert (loss.item(), l1.item(), similarity.item()) == (0.0, 0.0, 1.0)
        assert (leaf.grad == 0).all()


@pytest.mark.parametrize("shape", [(3, 0, 5), (3, 5, 0), (0, 5, 5)], ids=str)
def test_empty_images(shape, device):
    for form in _forms(device):
        leaf = torch.zeros(shape, device=device, requires_grad=True)
        loss, _, similarity = photometric_loss(leaf, torch.zeros(shape, device=device), form=form)
        loss.backward()
        assert (loss.item(), similarity.item()) == (0.0, 1.0)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_not_finite_is_seen_in_the_loss(value, device):
    image, truth = _pair((3, 30, 30), 5)
    image[1, 12, 13] = value
    for form in _forms(device):
        leaf = image.to(device).requires_grad_()
        loss = photometric_loss(leaf, truth.to(device), form=form)[0]
        loss.backward()
        assert not torch.isfinite(loss)


def test_the_mask_of_all_pixels_is_no_mask(device):
    image, truth = (t.to(device) for t in _pair((3, 45, 70), 6))
    everything = torch.ones(45, 70, dtype=torch.bool, device=device)
    for form in _forms(device):
        assert photometric_loss(image, truth, form=form) == photometric_loss(image, truth, everything, form=form)


def test_same_bits_for_any_thread_count(all_threads):
    image, truth = _pair((3, 3 * SSIM_BAND + 7, 2 * SSIM_BLOCK + 5), 7)
    for form in _forms("cpu"):
        results = []
        for threads in (1, 2):
            environment.configure(threads=threads)
            leaf = image.clone().requires_grad_()
            values = photometric_loss(leaf, truth, form=form)
            values[0].backward()
            results.append((torch.stack(values).detach(), leaf.grad))
        torch.testing.assert_close(results[0], results[1], rtol=0, atol=0)


def test_views_that_are_not_contiguous(device):
    image, truth = _pair((3, 20, 30), 8)
    turned = image.permute(1, 2, 0).contiguous().permute(2, 0, 1).to(device)
    a = photometric_loss(turned, truth.to(device))
    b = photometric_loss(image.to(device), truth.to(device))
    assert a == b


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ((torch.zeros(5, 5), torch.zeros(5, 5)), "image"),
        ((torch.zeros(3, 5, 5).double(), torch.zeros(3, 5, 5)), "image"),
        ((torch.zeros(3, 5, 5), torch.zeros(3, 5, 6)), "truth"),
        ((torch.zeros(3, 5, 5), torch.zeros(3, 5, 5), torch.zeros(5, 6, dtype=torch.bool)), "mask"),
        ((torch.zeros(3, 5, 5), torch.zeros(3, 5, 5), torch.zeros(5, 5)), "mask"),
    ],
)
def test_bad_arguments_are_named(arguments, name):
    with pytest.raises(ValueError, match=f"^{name} must be"):
        photometric_loss(*arguments)


@settings(deadline=None, max_examples=25)
@given(st.integers(1, 60), st.integers(1, 60), st.integers(0, 2**31))
def test_ssim_is_a_similarity(height, width, seed):
    """One for equal images, at most one, the same under mirroring and transposition and when the images swap."""
    image, truth = _pair((3, height, width), seed)
    value = ssim(image, truth)
    torch.testing.assert_close(ssim(image, image), torch.tensor(1.0), rtol=0, atol=2e-5)
    assert value <= 1.0 + 1e-5
    for other in (
        ssim(truth, image),
        ssim(image.flip(2), truth.flip(2)),
        ssim(image.flip(1), truth.flip(1)),
        ssim(image.mT, truth.mT),
    ):
        torch.testing.assert_close(other, value, rtol=1e-4, atol=1e-5)
