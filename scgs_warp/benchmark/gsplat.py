"""Other renderers beside this project: they must draw the same picture before they are timed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..errors import UserError
from ..rendering import rasterize
from .plan import MIDDLE, Place, Plan, posed
from .workloads import Leaves

TOLERANCE = 1e-4
LARGEST = 8e-3
AGREEING = 0.999
"""The rule by which two renderers agree: this share of pixels within TOLERANCE, none beyond LARGEST."""


class Peers:
    """gsplat beside this project: the same Gaussians and camera through the same entry point."""

    def __init__(self, rasterization: Callable[..., Any]) -> None:
        self.rasterization = rasterization

    @staticmethod
    def find(plan: Plan) -> Peers:
        """
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

    def rows(self, place: Place) -> list[dict[str, Any]]:
        """Images are compared first; what disagrees is not timed."""
        leaves = Leaves(*posed(place.scene, place.plan.size, MIDDLE))
        renderers = {"scgs_warp": rasterize.rasterization, "gsplat": self.rasterization}
        with torch.no_grad():
            agree(leaves.rasterize(rasterize.rasterization), leaves.rasterize(self.rasterization))
        rows = []
        for renderer, function in renderers.items():

            def forward(index: int, function: Callable[..., Any] = function) -> None:
                with torch.no_grad():
                    leaves.rasterize(function)

            def both(index: int, function: Callable[..., Any] = function) -> None:
                torch.autograd.grad(leaves.rasterize(function), (*leaves.geometry, leaves.harmonics), leaves.v_image)

            rows += place.rows("raster/forward", forward, {}, renderer)
            rows += place.rows("raster/both", both, {}, renderer)
        return rows


def agree(ours: Tensor, theirs: Tensor, name: str = "--against gsplat") -> None:
    """
    Args:
        ours, theirs: [C, H, W].
        name: what the message begins with.

    Raises:
        UserError: by the rule of agreement they are not the same picture.
    """
    difference = (ours - theirs).abs().amax(0)
    within, largest = float((difference <= TOLERANCE).double().mean()), float(difference.max())
    if not (within >= AGREEING and largest <= LARGEST):  # NaN disagrees
        raise UserError(
            f"{name}: the images differ ({100 * within:.3f} % of pixels within {TOLERANCE:g}, largest "
            f"difference {largest:.2g}), so times would compare nothing; try --gaussians instead of --run, or report it"
        )
