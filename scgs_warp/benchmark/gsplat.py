"""Comparison with gsplat: both renderers must draw the same image before they are timed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..errors import UserError
from ..rendering import rasterize
from .plan import MIDDLE, BenchCase, BenchPlan, posed
from .workloads import Leaves

TOLERANCE = 1e-4
LARGEST_DIFFERENCE = 8e-3
AGREEING = 0.999
"""Share of pixels that must agree within TOLERANCE; no pixel may differ by more than LARGEST_DIFFERENCE."""


class Peers:
    """gsplat and this project, given the same Gaussians and camera through the same entry point."""

    def __init__(self, rasterization: Callable[..., Any]) -> None:
        self.rasterization = rasterization

    @staticmethod
    def find(plan: BenchPlan) -> Peers:
        """Import gsplat.

        Raises:
            UserError: gsplat is not installed, or there is no GPU, without which it does not composite.
        """
        if plan.device != "cuda":
            raise UserError(
                "--against gsplat: gsplat composites on CUDA only; use a machine with a GPU, or leave it out"
            )
        try:
            import gsplat
        except ImportError as error:
            raise UserError(f"--against gsplat: it cannot be imported ({error}); pip install gsplat==1.5.3") from error
        return Peers(gsplat.rasterization)

    def rows(self, case: BenchCase) -> list[dict[str, Any]]:
        """Compare the images, then time both renderers."""
        leaves = Leaves(*posed(case.scene, case.plan.size, MIDDLE))
        renderers = {"scgs_warp": rasterize.rasterization, "gsplat": self.rasterization}
        with torch.no_grad():
            check_agreement(leaves.rasterize(rasterize.rasterization), leaves.rasterize(self.rasterization))
        rows = []
        for renderer, function in renderers.items():

            def forward(index: int, function: Callable[..., Any] = function) -> None:
                with torch.no_grad():
                    leaves.rasterize(function)

            def both(index: int, function: Callable[..., Any] = function) -> None:
                torch.autograd.grad(leaves.rasterize(function), (*leaves.geometry, leaves.harmonics), leaves.v_image)

            rows += case.rows("raster/forward", forward, {}, renderer)
            rows += case.rows("raster/both", both, {}, renderer)
        return rows


def check_agreement(ours: Tensor, theirs: Tensor, name: str = "--against gsplat") -> None:
    """Check that two images agree.

    Args:
        ours, theirs: [C, H, W].
        name: Beginning of the message.

    Raises:
        UserError: the images differ by more than ``AGREEING`` and ``LARGEST_DIFFERENCE`` allow.
    """
    difference = (ours - theirs).abs().amax(0)
    within, largest = float((difference <= TOLERANCE).double().mean()), float(difference.max())
    if not (within >= AGREEING and largest <= LARGEST_DIFFERENCE):  # The comparison is false for NaN, too.
        raise UserError(
            f"{name}: the images differ ({100 * within:.3f} % of pixels within {TOLERANCE:g}, largest "
            f"difference {largest:.2g}), so times would compare nothing; try --gaussians instead of --run, or report it"
        )
