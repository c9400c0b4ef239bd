"""Learning rates of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from .bounds import bounded, milestone, newer, rate


@dataclass(frozen=True)
class OptimConfig:
    """Learning rates. ``NAME_end`` is the final rate of a log-linear decay (official values, normalised scene)."""

    means: float = rate(8e-4)
    """Learning rate of the Gaussians' positions at the start."""
    means_end: float = rate(8e-6)
    """Learning rate of the Gaussians' positions from ``means_until`` on."""
    means_until: int = milestone(33_000, 1)
    """Number of steps over which the rate of the positions decays."""
    sh_dc: float = rate(2.5e-3)
    """Learning rate of the colours: harmonics of degree 0."""
    sh_rest: float = rate(1.25e-4)
    """Learning rate of the harmonics of higher degrees."""
    opacity: float = rate(0.05)
    """Learning rate of the opacities."""
    scales: float = rate(5e-3)
    """Learning rate of the logarithms of the scales."""
    quats: float = rate(1e-3)
    """Learning rate of the rotations."""
    hyper: float = rate(2.5e-3)
    """Learning rate of the hyper-coordinates."""
    shading: float = rate(2.5e-3)
    """Learning rate of the shading."""
    correctives: float = rate(8e-4, before=2.5e-3)
    """Learning rate of the correctives. At this rate, a step moves a mean about as far as a step of the mean itself, at
    any rotation; at three times the rate, bodies that spin were lost."""
    network: float = rate(8e-4)
    """Learning rate of the network at the start."""
    network_end: float = rate(1.6e-6)
    """Learning rate of the network from ``network_until`` on."""
    network_until: int = milestone(33_000, 1)
    """Number of steps over which the rate of the network decays."""
    network_from: Literal["motion", "stage"] = newer("motion", before="motion")
    """Step from which ``network_until`` counts. motion: the first that trains the network. stage: the first of each
    stage (official code)."""
    network_scale: float = newer(0.0, before=1.0, least=0, most=1)
    """Factor on the network's rates. 0: computed from the distance at which the cameras see the data's initial points.
    It is 1 unless the points are close: a step of the network must not move the scene past the cameras
    (``near_bound.network_scale``)."""
    nodes: float = rate(8e-4)
    """Learning rate of the radii, weights and hyper-coordinates of the control points."""
    node_positions: float = rate(8e-5)
    """Learning rate of the rest positions of the control points."""
    nodes_decay: bool = newer(True, before=True)
    """Let ``nodes`` decay like the network's rate; otherwise ``nodes`` is constant (official code). ``node_positions``
    always decays like the network's rate."""
    settle: float = bounded(0.15, 0, 1)
    """Share of the main stage, at its end, over which the otherwise constant rates of the Gaussians decay to a
    twentieth."""
    cameras: float = rate(0.0)
    """Learning rate of the corrections to the training cameras' poses (radians, normalised units) after ``freeze``; 0:
    no corrections."""
    planes: float = rate(8e-3)
    """Learning rate of the feature planes of the hexplane model."""
    frame_colors: float = newer(0.0, before=0.0, least=0, most=1)
    """Learning rate of an affine colour for each training frame, for films whose exposure or white balance changes (not
    in the paper); 2e-3 suits most films. 0: off."""
