"""PSNR and SSIM by known values; LPIPS by its properties, with random weights that the test writes."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from reference.ssim import ssim_map
from scgs_warp.errors import UserError
from scgs_warp.evaluation import image_metrics
from scgs_warp.evaluation.image_metrics import LPIPS, psnr, ssim

CONVOLUTIONS = {
    0: (3, 64), 2: (64, 64), 5: (64, 128), 7: (128, 128), 10: (128, 256), 12: (256, 256), 14: (256, 256),
    17: (256, 512), 19: (512, 512), 21: (512, 512), 24: (512, 512), 26: (512, 512), 28: (512, 512),
}  # fmt: skip
HEADS = (64, 128, 256, 512, 512)


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    made = {}
    for index, (inputs, outputs) in CONVOLUTIONS.items():
        made[f"features.{index}.weight"] = torch.randn(outputs, inputs, 3, 3, generator=generator) / (3 * inputs**0.5)
        made[f"features.{index}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
    for k, channels in enumerate(HEADS):
        made[f"lin{k}.model.1.weight"] = torch.rand(1, channels, 1, 1, generator=generator)
    return made


@pytest.fixture(scope="module")
def weights_file(weights, tmp_path_factory):
    path = tmp_path_factory.mktemp("lpips") / "vgg.safetensors"
    save_file(weights, path)
    return path


def _images(seed: int, height: int = 33, width: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(height, width, 3, generator=generator)
    return (truth + 0.1 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1), truth


def _reference_lpips(weights: dict[str, torch.Tensor], image: torch.Tensor, truth: torch.Tensor) -> float:
    """Layer by layer as torchvision numbers them, in float64."""
    layers: dict[int, str] = {i: "relu" for i in (1, 3, 6, 8, 11, 13, 15, 18, 20, 22, 25, 27, 29)}
    layers.update({i: "pool" for i in (4, 9, 16, 23)})
    taps, total = {3: 0, 8: 1, 15: 2, 22: 3, 29: 4}, 0.0
    a, b = (2 * t.double().permute(2, 0, 1)[None] - 1 for t in (image, truth))
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    a, b = ((t - shift.double()[:, None, None]) / scale.double()[:, None, None] for t in (a, b))
    for index in range(30):
        kind = layers.get(index, "conv")
        if kind == "relu":
            a, b = a.relu(), b.relu()
        elif kind == "pool":
            a, b = (torch.nn.functional.max_pool2d(t, 2) for t in (a, b))
        else:
            kernel, bias = (weights[f"features.{index}.{n}"].double() for n in ("weight", "bias"))
            a, b = (torch.nn.functional.conv2d(t, kernel, bias, padding=1) for t in (a, b))
        if index in taps:
            unit_a, unit_b = (t / (t.square().sum(1, keepdim=True).sqrt() + 1e-10) for t in (a, b))
            head = weights[f"lin{taps[index]}.model.1.weight"].double()
            total += float(((unit_a - unit_b) ** 2 * head[0]).sum(1).mean())
    return total


def test_psnr_of_a_known_error(device):
    truth = torch.full((4, 5, 3), 0.5, device=device)
    assert float(psnr(truth + 0.1, truth)) == pytest.approx(20.0, abs=1e-5)
    assert math.isinf(float(psnr(truth, truth)))
    assert float(psnr(truth + 7.0, truth)) == pytest.approx(-10 * math.log10(0.25), abs=1e-5)  # clamped to 1
    with pytest.raises(ValueError, match="truth must be"):
        psnr(truth, truth[:2])


@pytest.mark.parametrize("seed", [0, 1])
def test_ssim_of_an_image(seed, device):
    image, truth = _images(seed)
    expected = ssim_map(image.double().permute(2, 0, 1), truth.double().permute(2, 0, 1)).mean()
    assert float(ssim(image.to(device), truth.to(device))) == pytest.approx(float(expected), abs=1e-5)


@pytest.mark.parametrize("seed", [0, 1])
def test_lpips_is_the_published_formula(seed, weights, weights_file, device):
    image, truth = _images(seed)
    lpips = LPIPS(weights_file, device)
    assert float(lpips(image.to(device), truth.to(device))) == pytest.approx(
        _reference_lpips(weights, image, truth), rel=1e-3
    )


def test_lpips_is_a_distance(weights_file, device):
    lpips = LPIPS(weights_file, device)
    image, truth = (t.to(device) for t in _images(2))
    assert float(lpips(image, image)) == 0.0
    assert float(lpips(image, truth)) > 0.0
    assert float(lpips(image, truth)) == pytest.approx(float(lpips(truth, image)), rel=1e-6)
    half = 0.5 * (image + truth)
    assert float(lpips(half, truth)) < float(lpips(image, truth))


def test_lpips_never_computes_in_tf32(weights_file, device, monkeypatch):
    seen = []

    def convolve(*args, **kwargs):
        seen.append(torch.backends.cudnn.allow_tf32)
        return torch.nn.functional.conv2d(*args, **kwargs)

    monkeypatch.setattr(image_metrics, "conv2d", convolve)
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", True)
    LPIPS(weights_file, device)(*(t.to(device) for t in _images(2)))
    assert len(seen) == len(CONVOLUTIONS) + len(HEADS) and not any(seen)
    assert torch.backends.cudnn.allow_tf32, "the process keeps its setting"


def test_every_accepted_spelling(weights, weights_file, tmp_path):
    """A torch state dict in the lpips package's names gives the same distance."""
    spelled = {}
    for key, tensor in weights.items():
        if key.startswith("features."):
            index = int(key.split(".")[1])
            block = 1 + sum(index > last for last in (3, 8, 15, 22))
            key = key.replace("features.", f"net.slice{block}.")
        else:
            key = key.replace("lin", "lins.")
        spelled[key] = tensor
    torch.save(spelled, tmp_path / "vgg.pth")
    image, truth = _images(3)
    assert LPIPS(tmp_path / "vgg.pth")(image, truth) == LPIPS(weights_file)(image, truth)


class Touch:
    """An object whose unpickling makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_file_of_weights_runs_no_code(weights, tmp_path):
    torch.save({**weights, "more": Touch(tmp_path / "touched")}, tmp_path / "vgg.pth")
    with pytest.raises(UserError, match=r"vgg\.pth: not readable as LPIPS weights"):
        LPIPS(tmp_path / "vgg.pth")
    assert not (tmp_path / "touched").exists()


def test_a_wrong_file_is_the_users_error_in_one_line(weights, tmp_path):
    lacking = {key: tensor for key, tensor in weights.items() if key != "lin3.model.1.weight"}
    save_file(lacking, tmp_path / "lacking.safetensors")
    misshapen = {**weights, "features.5.bias": torch.zeros(64)}
    save_file(misshapen, tmp_path / "misshapen.safetensors")
    (tmp_path / "garbage.safetensors").write_bytes(b"no weights\n")
    (tmp_path / "garbage.pth").write_bytes(b"no weights\n")
    torch.save([1, 2], tmp_path / "list.pth")
    expected = {
        "absent.pth": "no such file",
        "lacking.safetensors": "lin3.model.1.weight",
        "misshapen.safetensors": "features.5.bias",
        "garbage.safetensors": "not readable",
        "garbage.pth": "not readable",
        "list.pth": "list",
    }
    for name, words in expected.items():
        with pytest.raises(UserError) as caught:
            LPIPS(tmp_path / name)
        message = str(caught.value)
        assert name in message and words in message and "give one file" in message and "\n" not in message


@pytest.mark.parametrize("shape", [(8, 40, 3), (40, 40, 4), (40, 40)], ids=str)
def test_images_lpips_cannot_take(shape, weights_file):
    with pytest.raises(ValueError, match="image must be"):
        LPIPS(weights_file)(torch.zeros(shape), torch.zeros(shape))
