"""PSNR, SSIM and LPIPS of one image; the caller averages over images."""

from __future__ import annotations

import re
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, normalize

from ..errors import UserError
from ..ops.ssim import ssim as planar_ssim

# VGG16 (Simonyan and Zisserman 2015) up to relu5_3: the index of each convolution in torchvision's ``features``, and
# its channels; LPIPS compares the last activation of each of the five blocks.
_BLOCKS: tuple[tuple[tuple[int, int, int], ...], ...] = (
    ((0, 3, 64), (2, 64, 64)),
    ((5, 64, 128), (7, 128, 128)),
    ((10, 128, 256), (12, 256, 256), (14, 256, 256)),
    ((17, 256, 512), (19, 512, 512), (21, 512, 512)),
    ((24, 512, 512), (26, 512, 512), (28, 512, 512)),
)
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_SMALLEST = 16
_REMEDY = (
    "give one file (.safetensors or a torch state dict) with torchvision's VGG16 'features.N.weight', "
    "'features.N.bias' and LPIPS's heads 'linK.model.1.weight'"
)


def psnr(image: Tensor, truth: Tensor) -> Tensor:
    """Compute the peak signal-to-noise ratio in decibels, -10 log10(mean squared error) of values clamped to [0, 1].

    Args:
        image: any shape, typically [H, W, 3], or [P, 3] of the valid pixels.
        truth: the same shape.

    Returns:
        A float64 scalar; infinite for equal images, NaN where an input is NaN or there are no pixels.

    Raises:
        ValueError: the shapes differ.
    """
    if image.shape != truth.shape:
        raise ValueError(f"truth must be {list(image.shape)} like image, got {list(truth.shape)}")
    error = image.detach().double().clamp(0.0, 1.0) - truth.detach().double().clamp(0.0, 1.0)
    return -10.0 * torch.log10(error.square().mean())


def ssim(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Compute the structural similarity of two images [H, W, 3], with the window of the loss (see ``ops.ssim``).

    Args:
        image: [H, W, 3] float32 in [0, 1].
        truth: [H, W, 3] float32 in [0, 1].
        mask: [H, W] bool, True where a pixel is valid.

    Returns:
        A scalar, 1 for equal images.

    Raises:
        ValueError: a shape or dtype does not fit.
    """
    with torch.no_grad():
        return planar_ssim(image.permute(2, 0, 1), truth.permute(2, 0, 1), mask)


class LPIPS:
    """Learned perceptual distance with VGG16 (Zhang et al. 2018, equation 1; weights of version 0.1).

    Nothing is downloaded: the user provides a file of weights.
    """

    def __init__(self, path: str | Path, device: torch.device | str = "cpu") -> None:
        """Read the weights.

        Args:
            path: a .safetensors file or a torch state dict (read with ``weights_only``) that holds VGG16's
                convolutions as ``features.N.weight`` and ``.bias`` (or ``net.sliceK.N...``, as the lpips package
                saves them) and the heads as ``linK.model.1.weight`` (or ``lins.K...``), K = 0 .. 4.
            device: device of the images.

        Raises:
            UserError: the file is missing, cannot be read, or lacks a tensor of the right shape.
        """
        path = Path(path)
        weights = _by_role(_read(path))
        self._convolutions: list[list[tuple[Tensor, Tensor]]] = []
        self._heads: list[Tensor] = []
        for k, block in enumerate(_BLOCKS):
            pairs = []
            for index, inputs, outputs in block:
                kernel = _take(weights, path, f"features.{index}.weight", (outputs, inputs, 3, 3), device)
                pairs.append((kernel, _take(weights, path, f"features.{index}.bias", (outputs,), device)))
            self._convolutions.append(pairs)
            self._heads.append(_take(weights, path, f"lin{k}.model.1.weight", (1, block[-1][2], 1, 1), device))
        self._shift = torch.tensor(_SHIFT, device=device).view(1, 3, 1, 1)
        self._scale = torch.tensor(_SCALE, device=device).view(1, 3, 1, 1)

    @torch.no_grad()
    def __call__(self, image: Tensor, truth: Tensor) -> Tensor:
        """Measure the distance of two images.

        Args:
            image: [H, W, 3] float32 in [0, 1], at least 16 pixels a side.
            truth: [H, W, 3] float32 in [0, 1].

        Returns:
            A scalar, 0 for equal images.

        Raises:
            ValueError: a shape does not fit.
        """
        if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < _SMALLEST:
            raise ValueError(f"image must be [H, W, 3] with H, W >= {_SMALLEST}, got {list(image.shape)}")
        if truth.shape != image.shape:
            raise ValueError(f"truth must be {list(image.shape)} like image, got {list(truth.shape)}")
        with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            return self._distance(image, truth)

    def _distance(self, image: Tensor, truth: Tensor) -> Tensor:
        pair = torch.stack([image, truth]).permute(0, 3, 1, 2).contiguous()
        activation = (2.0 * pair - 1.0 - self._shift) / self._scale
        distance = pair.new_zeros(())
        for k, (convolutions, head) in enumerate(zip(self._convolutions, self._heads)):
            if k > 0:
                activation = max_pool2d(activation, 2)
            for kernel, bias in convolutions:
                activation = conv2d(activation, kernel, bias, padding=1).relu_()
            unit = normalize(activation, dim=1, eps=1e-10)
            difference = (unit[:1] - unit[1:]).square()
            distance = distance + conv2d(difference, head).mean()
        return distance


def _read(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise UserError(f"{path}: no such file of LPIPS weights; {_REMEDY}")
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path)
        loaded = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the readers raise various exception types
        reason = (str(error) or type(error).__name__).splitlines()[0][:120]
        raise UserError(f"{path}: not readable as LPIPS weights ({reason}); {_REMEDY}") from error
    if not isinstance(loaded, dict):
        raise UserError(f"{path}: holds a {type(loaded).__name__}, not a state dict; {_REMEDY}")
    return {str(key): value for key, value in loaded.items() if isinstance(value, Tensor)}


def _by_role(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Rename the tensors to a single naming scheme."""
    renamed = {}
    for key, tensor in tensors.items():
        if match := re.fullmatch(r"(?:.*\.)?(?:features|slice[1-5])\.(\d+)\.(weight|bias)", key):
            renamed[f"features.{match[1]}.{match[2]}"] = tensor
        elif match := re.fullmatch(r"(?:.*\.)?(?:lin|lins\.)([0-4])\.(?:model\.)?(?:[01]\.)?weight", key):
            renamed[f"lin{match[1]}.model.1.weight"] = tensor
    return renamed


def _take(
    weights: dict[str, Tensor], path: Path, key: str, shape: tuple[int, ...], device: torch.device | str
) -> Tensor:
    if key not in weights:
        raise UserError(f"{path}: '{key}' is missing; {_REMEDY}")
    tensor = weights[key]
    if tuple(tensor.shape) != shape:
        raise UserError(f"{path}: '{key}' is {list(tensor.shape)} instead of {list(shape)}; {_REMEDY}")
    return tensor.to(device, torch.float32)
