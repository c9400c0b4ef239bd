"""Forms of compositing side by side. Run as a program: the block form on the CPU, as one JSON line."""

from __future__ import annotations

import json

import torch

# name: (width, height, splats, channels, seed, how opacities are drawn)
CASES: dict[str, tuple[int, int, int, int, int, str]] = {
    "one tile": (16, 16, 12, 3, 0, "mixed"),
    "odd size": (37, 21, 60, 4, 1, "mixed"),
    "several batches and early stop": (16, 16, 700, 3, 2, "opaque"),
    "faint, several batches": (16, 9, 600, 1, 3, "faint"),
    "nine channels": (20, 18, 40, 9, 4, "mixed"),
    "one splat": (8, 8, 1, 5, 5, "opaque"),
    "clamped alpha": (16, 16, 3, 3, 7, "full"),
    "no splat": (20, 20, 0, 3, 6, "mixed"),
    "sharp": (37, 21, 60, 4, 8, "mixed"),
    "sharp, several batches": (16, 16, 700, 3, 9, "opaque"),
}
SHARPNESS = 0.5
"""Of the cases whose name begins with it."""


def random_splats(width: int, height: int, count: int, channels: int, seed: int, opacity: str):
    """Overlapping ellipses, some without area, one whose channel is not a number."""
    generator = torch.Generator().manual_seed(seed)
    means2d = torch.rand(count, 2, generator=generator) * torch.tensor([width, height]) * 1.2 - 1.5
    factors = torch.randn(count, 2, 2, generator=generator) * min(width, height) * 0.2
    covariances = factors @ factors.mT + 0.3 * torch.eye(2)
    inverse = torch.linalg.inv(covariances) if count else covariances
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
    drawn = torch.rand(count, generator=generator)
    ranges = {"mixed": (0.0, 1.0), "opaque": (0.9, 0.1), "faint": (0.0, 0.03), "full": (1.0, 0.0)}
    opacities = ranges[opacity][0] + ranges[opacity][1] * drawn
    if opacity == "full":  # on pixel centres, where alpha reaches its bound
        means2d = means2d.clamp(2.0, min(width, height) - 2.0).floor() + 0.5
    radii = (3.5 * covariances.diagonal(dim1=1, dim2=2).sqrt()).ceil().int()
    depths = torch.rand(count, generator=generator) + 1.0
    colors = torch.rand(count, channels, generator=generator)
    if count > 10:
        colors[count // 2, 0] = float("nan")
        radii[count // 3] = 0
    return means2d, conics, depths, opacities, radii, colors


def run_form(case: str, form: str, device: str) -> list[torch.Tensor]:
    """Image, alpha, all gradients and the absolute gradients."""
    from scgs_warp.ops.binning import bin_splats
    from scgs_warp.ops.compositing import composite
    from scgs_warp.types import Splats, Stats

    width, height, count, channels, seed, opacity = CASES[case]
    tensors = [t.to(device) for t in random_splats(width, height, count, channels, seed, opacity)]
    means2d, conics, depths, opacities, radii, colors = tensors
    background = torch.linspace(0.1, 0.9, channels, device=device)
    leaves = [t.requires_grad_() for t in (means2d, conics, opacities, colors, background)]
    sharpness = SHARPNESS if case.startswith("sharp") else 0.0
    splats = Splats(means2d, conics, depths, opacities, radii, width, height, sharpness)
    absgrad = torch.empty(count, 2, device=device)
    stats = Stats.zeros(count, device)
    image, alpha = composite(splats, colors, bin_splats(splats), background, stats=stats, absgrad=absgrad, form=form)
    generator = torch.Generator().manual_seed(seed + 1000)
    v_image = torch.randn(image.shape, generator=generator).to(device)
    v_alpha = torch.randn(alpha.shape, generator=generator).to(device)
    gradients = torch.autograd.grad((image, alpha), leaves, (v_image, v_alpha))
    results = [image, alpha, *gradients, absgrad, stats.grad_norm, stats.count]
    return [t.detach().cpu() for t in results]


def largest_differences(case: str, form: str, device: str) -> list[float]:
    """Per result of ``run_form``, the largest difference to the plain form, relative to the largest value."""
    theirs, ours = run_form(case, "plain", device), run_form(case, form, device)
    differences = []
    for a, b in zip(theirs, ours):
        assert a.shape == b.shape and torch.isfinite(b).all(), (case, a, b)
        scale = a.abs().max().clamp(min=1e-6) if a.numel() else torch.tensor(1.0)
        differences.append(float(((a - b).abs() / scale).max()) if a.numel() else 0.0)
    return differences


if __name__ == "__main__":
    import warp

    warp.config.enable_cpu_blocks = True
    print(json.dumps({case: largest_differences(case, "blocks", "cpu") for case in CASES}))
