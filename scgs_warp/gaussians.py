"""The trained Gaussians: raw parameters, activations, and initial values."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .ops.activations import exponential, sigmoid
from .ops.correctives import COLUMNS as CORRECTIVE_COLUMNS
from .ops.shading import COLUMNS as SHADING_COLUMNS
from .runtime.environment import one_piece
from .runtime.search_tree import search_tree
from .types import Gaussians

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic: colour = 0.5 + SH_C0 * sh_dc."""


class GaussianParameters(nn.Module):
    """Raw parameters of N Gaussians in the normalised scene; :meth:`activate` makes renderable ones.

    Attributes: ``means`` [N, 3], ``quats`` [N, 4] wxyz, ``log_scales`` [N, 3], ``opacity_logits`` [N],
    ``sh_dc`` [N, 3], ``sh_rest`` [N, K - 1, 3], ``hyper`` [N, H] (H may be 0), ``shading`` [N, 10] or [N, 0],
    ``correctives`` [N, 27] or [N, 0]; ``sharpness``, the same for all (:class:`Gaussians`).
    """

    left_out = 0
    """Number of non-finite Gaussians of a file that were left out when it was read."""
    NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh_dc", "sh_rest", "hyper", "shading", "correctives")

    def __init__(
        self,
        means: Tensor,
        log_scales: Tensor,
        sh_dc: Tensor,
        *,
        opacity: float = 0.1,
        sh_degree: int = 3,
        hyper_columns: int = 0,
        shaded: bool = False,
        corrected: bool = False,
        sharpness: float = 0.0,
    ) -> None:
        super().__init__()
        self.sharpness = sharpness
        count, device = means.shape[0], means.device
        quats = torch.zeros(count, 4, device=device)
        quats[:, 0] = 1.0
        self.means = nn.Parameter(means.clone())
        self.quats = nn.Parameter(quats)
        self.log_scales = nn.Parameter(log_scales.clone())
        self.opacity_logits = nn.Parameter(torch.full((count,), opacity, device=device).logit())
        self.sh_dc = nn.Parameter(sh_dc.clone())
        self.sh_rest = nn.Parameter(torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3, device=device))
        # As in the official code, this differs from the control points' +1e-2, so that the distance has a gradient.
        self.hyper = nn.Parameter(torch.full((count, hyper_columns), -1e-2, device=device))
        self.shading = nn.Parameter(torch.zeros(count, SHADING_COLUMNS if shaded else 0, device=device))
        self.correctives = nn.Parameter(torch.zeros(count, CORRECTIVE_COLUMNS if corrected else 0, device=device))

    @staticmethod
    def empty(
        count: int,
        sh_count: int,
        hyper_columns: int,
        shaded: bool,
        corrected: bool,
        device: torch.device | str,
        sharpness: float = 0.0,
    ) -> GaussianParameters:
        """Allocate ``count`` Gaussians to be filled from a checkpoint."""
        zeros = torch.zeros(count, 3, device=device)
        options = {"hyper_columns": hyper_columns, "shaded": shaded, "corrected": corrected, "sharpness": sharpness}
        made = GaussianParameters(zeros, zeros, zeros, sh_degree=0, **options)
        made.sh_rest = nn.Parameter(torch.zeros(count, sh_count, 3, device=device))
        return made

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Highest degree of spherical harmonics that ``sh_rest`` can hold."""
        return round((self.sh_rest.shape[1] + 1) ** 0.5) - 1

    def scales(self) -> Tensor:
        """Return the standard deviations, [N, 3]."""
        return exponential(self.log_scales)

    def opacities(self) -> Tensor:
        """Return the opacities, [N] in (0, 1)."""
        return sigmoid(self.opacity_logits)

    def rest(self) -> tuple[Tensor, ...]:
        """Return the raw parameters that posing reads, in the order of ``ops.posing.pose_gaussians``."""
        shape = self.means, self.quats, self.log_scales, self.opacity_logits
        return *shape, self.sh_dc, self.correctives, self.shading

    def activate(self) -> Gaussians:
        """Return the Gaussians at rest, activated. Motion models activate the Gaussians that they move."""
        return Gaussians(
            self.means, self.quats, self.scales(), self.opacities(), self.sh_dc, self.sh_rest, self.sharpness
        )


def neighbor_distance(points: Tensor) -> Tensor:
    """Return the root mean squared distance of each point to its three nearest neighbours, [N].

    The result is at least 1e-3, and 1e-2 for a single point.
    """
    total = points.shape[0]
    if total <= 1:
        return torch.full((total,), 1e-2, device=points.device)
    count = min(3, total - 1)
    array = points.detach().cpu().double().numpy()
    distances, _ = search_tree(array).query(array, k=count + 1)
    mean = torch.from_numpy((distances[:, 1:] ** 2).mean(axis=1) ** 0.5)
    return mean.float().clamp_(min=1e-3).to(points.device)


def gaussians_from_points(
    points: Tensor,
    colors: Tensor | None,
    *,
    sh_degree: int,
    hyper_columns: int,
    scale: float = 1.0,
    shaded: bool = False,
    corrected: bool = False,
    sharpness: float = 0.0,
) -> GaussianParameters:
    """Make isotropic Gaussians at points.

    Args:
        points: [N, 3] centres.
        colors: [N, 3] in [0, 1]. None: grey.
        scale: standard deviation in units of the distance to the neighbours (:func:`neighbor_distance`).
        shaded: whether the Gaussians have shading parameters.
        corrected: whether the Gaussians have correctives.
        sharpness: see :class:`Gaussians`.
    """
    with one_piece():
        log_scales = (neighbor_distance(points) * scale).log()[:, None].repeat(1, 3)
    sh_dc = torch.zeros_like(points) if colors is None else (colors - 0.5) / SH_C0
    options = {"sh_degree": sh_degree, "hyper_columns": hyper_columns, "shaded": shaded, "corrected": corrected}
    return GaussianParameters(points, log_scales, sh_dc, sharpness=sharpness, **options)
