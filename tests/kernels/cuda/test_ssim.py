"""The native CUDA form of the photometric loss, run on the CPU by a shim, against the plain form; its bits and sums."""

from __future__ import annotations

import ctypes

import pytest
import torch

from helpers.cuda_emulation import COMPILER, build, launcher
from scgs_warp.kernels.cuda import ssim as kernels
from scgs_warp.kernels.types import SSIM_TILE_COLUMNS, SSIM_TILE_ROWS
from scgs_warp.ops import cuda_blocks
from scgs_warp.ops.ssim import photometric_loss

emulated = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler, or not Linux, whose fibres the shim uses")


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return build(tmp_path_factory.mktemp("shim"))


def pair(*shape: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return an image, a truth that resembles it, and a mask."""
    generator = torch.Generator().manual_seed(sum(shape))
    truth = torch.rand(shape, generator=generator)
    image = (truth + 0.1 * torch.randn(shape, generator=generator)).clamp(0, 1)
    return image, truth, torch.rand(shape[1:], generator=generator) > 0.3


def run(form: str, image: torch.Tensor, truth: torch.Tensor, mask: torch.Tensor | None) -> list[torch.Tensor]:
    """Return loss, l1, ssim, and the gradient of each and of their sum with a logarithm."""
    leaf = image.clone().requires_grad_()
    values = photometric_loss(leaf, truth, mask, 0.3, form=form)
    gradients = [torch.autograd.grad(value, leaf, retain_graph=True)[0] for value in values]
    logarithmic = photometric_loss(leaf, truth, mask, 0.3, 0.5, form=form)
    sums = torch.autograd.grad(torch.stack(logarithmic).sum(), leaf)[0]
    return [*(value.detach() for value in (*values, logarithmic[0])), *gradients, sums]


@emulated
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("height", [1, 5, SSIM_TILE_ROWS, SSIM_TILE_ROWS + 1, 2 * SSIM_TILE_ROWS + 6])
@pytest.mark.parametrize("width", [1, SSIM_TILE_COLUMNS, 2 * SSIM_TILE_COLUMNS + 3])
def test_same_as_the_pixel_form(width: int, height: int, masked: bool, library: ctypes.CDLL, monkeypatch):
    """Also where a tile ends: its windows reach five pixels into the neighbours."""
    monkeypatch.setattr(cuda_blocks, "launch_native", launcher(library))
    image, truth, mask = pair(2, height, width)
    arguments = image, truth, mask if masked else None
    for got, expected in zip(run("cuda", *arguments), run("plain", *arguments)):
        scale = float(expected.abs().max())
        torch.testing.assert_close(got, expected, rtol=1e-4, atol=2e-5 * scale + 1e-9)


@emulated
def test_bits_do_not_depend_on_who_runs_first(library: ctypes.CDLL, monkeypatch):
    arguments = pair(3, 2 * SSIM_TILE_ROWS - 3, SSIM_TILE_COLUMNS + 9)
    runs = []
    for seed in (1, 2, 3):
        monkeypatch.setattr(cuda_blocks, "launch_native", launcher(library, seed))
        runs.append(run("cuda", *arguments))
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other))


@emulated
def test_sums_of_more_tiles_than_threads(library: ctypes.CDLL, monkeypatch):
    """A thread of the last sum adds several tiles; float32 alone would lose the small ones beside the large one."""
    monkeypatch.setattr(cuda_blocks, "launch_native", launcher(library))
    truth = torch.zeros(300, 3, 2)
    image = truth + 1e-4
    image[7] = 1e4
    _, l1, _ = photometric_loss(image, truth, form="cuda")
    expected = (299 * 1e-4 + 1e4) / 300
    assert abs(float(l1) - expected) < 2e-7 * expected
    image[7] = 0.0
    _, l1, _ = photometric_loss(image, truth, form="cuda")
    torch.testing.assert_close(l1, torch.tensor(299 * 1e-4 / 300), rtol=1e-6, atol=0.0)


@emulated
def test_the_last_sum_is_in_double_precision(library: ctypes.CDLL):
    """Each thread adds small sums to a large one, which hides them in float32."""
    tiles = torch.full((256 * 200, 4), 0.03)
    tiles[:256] = 1e6
    results, slopes = torch.empty(3), torch.empty(2)
    launcher(library)(kernels.photometric_total, 1, tiles, 0.0, 0.0, results, slopes)
    valid = float(tiles[:, 3].double().sum())
    torch.testing.assert_close(results, torch.tensor([1.0, 1.0, 1.0]), rtol=1e-7, atol=0.0)
    torch.testing.assert_close(slopes, torch.tensor([1.0 / valid, 0.0]), rtol=1e-7, atol=0.0)


@emulated
def test_an_image_without_gradient_stores_none(library: ctypes.CDLL, monkeypatch):
    launched = []
    inner = launcher(library)

    def noting(kernel, blocks, *args, begin=0):
        launched.append((kernel.key, [value is None for value in args]))
        inner(kernel, blocks, *args, begin=begin)

    monkeypatch.setattr(cuda_blocks, "launch_native", noting)
    image, truth, _ = pair(1, 20, 20)
    with_gradient = photometric_loss(image.requires_grad_(), truth, form="cuda")
    with torch.no_grad():
        without = photometric_loss(image, truth, form="cuda")
    assert torch.equal(torch.stack(with_gradient), torch.stack(without))
    assert [name for name, _ in launched] == 2 * ["photometric", "photometric_total"]
    assert launched[0][1][4] is False and launched[2][1][4] is True, "partial derivatives"


def test_the_form_needs_a_gpu():
    image, truth, _ = pair(1, 20, 20)
    with pytest.raises(RuntimeError, match="needs a GPU"):
        photometric_loss(image, truth, form="cuda")
    with pytest.raises(ValueError, match="form must be auto, plain, cpu or cuda, got 'tiles'"):
        photometric_loss(image, truth, form="tiles")  # type: ignore[arg-type]
