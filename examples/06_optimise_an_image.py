"""Fit Gaussians to one image: the rasteriser in a custom loop, with torch's Adam and the squared error.

python examples/06_optimise_an_image.py --image photo.jpg
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image

from scgs_warp import rasterization

RATES = {"means": 5e-3, "quats": 1e-2, "log_scales": 2e-2, "logits": 5e-2, "colors": 2e-2}


def target_image(path: Path | None, size: int) -> torch.Tensor:
    """Load the image, or make rings of changing colour: [size, size, 3] in [0, 1]."""
    if path is not None:
        return torch.from_numpy(np.array(Image.open(path).convert("RGB").resize((size, size))) / np.float32(255.0))
    y, x = torch.meshgrid(*(2 * [torch.linspace(-1.0, 1.0, size)]), indexing="ij")
    ring = 0.5 + 0.5 * torch.cos(12.0 * torch.hypot(x, y))
    return torch.stack([ring, 0.5 + 0.5 * x, 0.5 - 0.5 * y * ring], dim=2)


def main(
    image: Path | None = None, output: Path = Path("fitted.png"), count: int = 1500, steps: int = 400, size: int = 128
) -> None:
    """Fit Gaussians to an image.

    Args:
        image: image to fit; by default a generated pattern.
        output: image of the truth beside its Gaussians.
        count: number of Gaussians.
        steps: optimisation steps.
        size: width and height in pixels.
    """
    truth = target_image(image, size)
    random = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=random) * torch.tensor([2.0, 2.0, 0.1]) - torch.tensor([1.0, 1.0, 0.0])
    start = {
        "means": means,
        "quats": torch.randn(count, 4, generator=random),
        "log_scales": torch.full((count, 3), -3.0),
        "logits": torch.zeros(count),
        "colors": torch.full((count, 3), 0.5),
    }
    p = {name: value.requires_grad_() for name, value in start.items()}
    optimizer = torch.optim.Adam([{"params": [p[name]], "lr": rate} for name, rate in RATES.items()], eps=1e-15)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 2.0  # the Gaussians are two units before the camera, which sees x and y from -1 to 1
    K = torch.tensor([[float(size), 0.0, size / 2], [0.0, float(size), size / 2], [0.0, 0.0, 1.0]])

    for step in range(steps):
        render, _, _ = rasterization(
            p["means"], p["quats"], p["log_scales"].exp(), p["logits"].sigmoid(), p["colors"],
            viewmat[None], K[None], size, size,
        )  # fmt: skip
        loss = (render[0] - truth).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 100 == 0 or step == steps - 1:
            print(f"step {step:4}: PSNR {-10.0 * loss.detach().log10():.2f} dB")
    pair = torch.cat([truth, render[0].detach()], dim=1)
    Image.fromarray((pair.clamp(0.0, 1.0) * 255.0).byte().numpy()).save(output)


if __name__ == "__main__":
    tyro.cli(main)
