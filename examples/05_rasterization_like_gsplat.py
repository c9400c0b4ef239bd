"""The rasteriser alone: gsplat's entry point, differentiable, with or without a GPU.

`scgs_warp.rasterization` has the argument names, order and defaults of gsplat 1.5.3. The script renders colour and
expected depth of a ball of random Gaussians from two cameras, and computes the gradient of every input.

    python examples/05_rasterization_like_gsplat.py
"""

from __future__ import annotations

from pathlib import Path

import torch
import tyro
from PIL import Image

from scgs_warp import rasterization
from scgs_warp.geometry.cameras import look_at


def main(output: Path = Path("ball.png"), count: int = 3000, size: int = 256) -> None:
    """Render a ball of Gaussians.

    Args:
        output: image of two views side by side.
        count: number of Gaussians.
        size: width and height of each view in pixels.
    """
    random = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=1)
    means = directions.clone().requires_grad_()  # [N, 3] world
    quats = torch.randn(count, 4, generator=random).requires_grad_()  # [N, 4] wxyz, need not be unit
    scales = torch.tensor([0.06, 0.04, 0.02]).repeat(count, 1).requires_grad_()  # [N, 3] standard deviations
    opacities = torch.full((count,), 0.8).requires_grad_()  # [N]
    colors = (0.5 + 0.5 * directions).requires_grad_()  # [N, 3]

    eyes = ([3.0, 0.0, 1.0], [0.0, 3.0, 1.0])
    viewmats = torch.stack([look_at(eye, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]) for eye in eyes])  # [C, 4, 4]
    K = torch.tensor([[1.2 * size, 0.0, size / 2], [0.0, 1.2 * size, size / 2], [0.0, 0.0, 1.0]])
    renders, alphas, meta = rasterization(
        means, quats, scales, opacities, colors, viewmats, K.expand(2, 3, 3), size, size, render_mode="RGB+ED"
    )  # renders [C, H, W, 3 + 1], alphas [C, H, W, 1]
    renders[..., :3].mean().backward()

    for name, tensor in [("means", means), ("quats", quats), ("scales", scales), ("opacities", opacities)]:
        assert tensor.grad is not None
        print(f"gradient of {name:9} {list(tensor.shape)}: norm {tensor.grad.norm():.2e}")
    depth = renders[..., 3][alphas[..., 0] > 0.5]
    print(f"{int((meta['radii'] > 0).all(-1).sum())} splats drawn; depth {depth.min():.2f} to {depth.max():.2f}")
    views = torch.cat([*renders[..., :3].detach()], dim=1)
    Image.fromarray((views.clamp(0.0, 1.0) * 255.0).byte().numpy()).save(output)


if __name__ == "__main__":
    tyro.cli(main)
