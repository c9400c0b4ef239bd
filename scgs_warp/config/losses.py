"""The terms of the loss and their weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from .bounds import bounded, chosen, milestone, newer


@dataclass(frozen=True)
class LossConfig:
    """Settings of the losses: L1 + D-SSIM and terms beside them, and ARAP on the control points' trajectories (paper
    Eq. 10)."""

    ssim: float = bounded(0.2, 0, 1)
    """Weight of D-SSIM; L1 has the rest."""
    random_background: float = newer(0.1, before=0.0, least=0, most=1)
    """Share of the main stage's steps, evenly spaced, that use a random background if the data has alpha (not in the
    paper). On one background alone, Gaussians of its colour beside the subject would change no image. 0: off."""
    log_error: float = newer(0.002, before=0.0, least=0, most=1e3)
    """Weight of the logarithm of each view's mean squared error (not in the paper), which weighs views by their
    relative error, as PSNR does."""
    log_error_from: float = newer(0.58, before=0.5, least=0, most=1)
    """Share of the main stage after which ``log_error`` applies."""
    pooled: Literal["auto", "always", "never"] = newer("auto", before="never")
    """Add the residual averaged over squares of 2, 4 and 8 % of the width in the main stage (not in the paper): a part
    beside its true place then costs less than a missing one, so it is moved instead of turned transparent. auto: only
    for thin subjects; it lowers the scores of others."""
    arap: float = bounded(1e-2, 0, 1e6)
    """Weight of ARAP at the first main step."""
    arap_end: float = bounded(1e-2, 0, 1e6)
    """Weight of ARAP at ``arap_until``."""
    arap_until: int = milestone(40_000)
    """Main step until which the ARAP weight changes exponentially from ``arap`` to ``arap_end``; afterwards the term is
    off."""
    arap_every: int = bounded(5, 1)
    """Apply the ARAP term in every n-th step only, with n times the weight."""
    arap_pair: Literal["frame", "random"] = "frame"
    """Pair of instants that ARAP compares. frame: the step's own and a random one, so that the network is evaluated at
    only one additional instant. random: two random ones."""
    arap_times: int = bounded(8, 1, 10_000)
    """Number of sampled times, N_t; the trajectories over them define the neighbours."""
    arap_neighbors: int = chosen(8, 1, 15)
    """Number of neighbours of each control point for ARAP."""
    arap_refresh: int = bounded(200, 1)
    """Number of steps between two computations of the neighbours."""
    arap_slack: float = newer(0.5, before=0.0, least=0, most=1e3)
    """Residual of an edge of ARAP, in spacings of the control points, at which it counts a quarter (not in the paper):
    edges that the learnt motion bends or stretches count little. 0: all edges count fully."""
    flow: float = newer(0.0, before=0.0, least=0, most=1e6)
    """Weight of the distance between rendered and measured optical flow, as a share of the image (not in the paper). It
    fades linearly until ``flow_until``. The term is off if the frames are not consecutive frames of a film."""
    flow_until: float = newer(0.8, before=0.8, least=0, most=1)
    """Share of the main stage until which the term applies."""
    flow_every: int = newer(2, before=2, least=1)
    """Apply the term in every n-th step only, with n times the weight."""
    depth: float = newer(0.2, before=0.0, least=0, most=1e6)
    """Weight of the relative error of inverse depth where the data has depth maps (not in the paper)."""
    depth_until: float = newer(0.8, before=0.8, least=0, most=1)
    """Share of the main stage until which ``depth`` fades linearly."""
    stereo: bool = newer(True, before=False)
    """Compare depth by stereo where the data is of a rig without depth maps (not in the paper)."""
    frame_colors: float = newer(1e-3, before=1e-3, least=0, most=1e6)
    """Weight of the squared distance between a frame's affine colour (``optim.frame_colors``) and the identity."""
    frame_colors_smooth: float = newer(1e-3, before=1e-3, least=0, most=1e6)
    """Weight of the squared distance between a frame's affine colour and the mean of those before and after it."""
    hexplane_tv: float = bounded(1e-4, 0, 1e6)
    """Weight of the differences in space (feature planes, 4D-GS)."""
    hexplane_smooth: float = bounded(1e-2, 0, 1e6)
    """Weight of the second differences in time (feature planes, 4D-GS)."""
    hexplane_rest: float = bounded(1e-4, 0, 1e6)
    """Weight of the term that keeps the time planes near 1, the value at rest (feature planes, 4D-GS)."""
