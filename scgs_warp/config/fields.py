"""The settings of a training run: frozen dataclasses, nested by who uses them.

Step counts that are milestones of a run are marked ``milestone``: ``presets.with_steps`` scales them all.
``config/presets.py`` makes the presets of them, reads and writes them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

MotionName = Literal["control-points", "per-gaussian", "hexplane", "static"]
PresetName = Literal["quick", "cpu", "paper"]
CACHE_MIB = 2048
"""Decoded images that are kept in memory, by default: 200 of 800 x 800 pixels with alpha."""


def milestone(steps: int) -> Any:
    """A step count that scales with the length of the run."""
    return field(default=steps, metadata={"milestone": True})


@dataclass(frozen=True)
class DataConfig:
    """What the run looks at."""

    downscale: int = 1
    """Divide the images' width and height by this."""
    resample: Literal["area", "bicubic"] = "area"
    """How they are reduced; bicubic (through Pillow, 8 bit) makes the truth as the official code does."""
    background: Literal["black", "white", "random"] = "black"
    """What lies behind transparent pixels; random: another colour every step, black for evaluation."""
    cache_mib: int = CACHE_MIB
    """Decoded images kept in memory; the rest is decoded whenever it is needed. Changes no bit of the result."""


@dataclass(frozen=True)
class MotionConfig:
    """Control points and the network that moves them (seed S4; paper section 4.1)."""

    model: MotionName = "control-points"
    nodes: int = 512
    """Control points N_p."""
    neighbors: int = 4
    """Control points that move a Gaussian, K."""
    layers: int = 8
    width: int = 256
    skip: int = 4
    """The layer whose output is concatenated with the network's input."""
    position_frequencies: int = 10
    time_frequencies: int = 6
    train_positions: bool = True
    """Control points' rest positions learn in the joint phase (paper); the official code never moves them."""
    hyper_dim: int = 0
    """Hyper-coordinates appended to the neighbour search (the official code uses 8)."""
    hyper_dim_filled: int = 4
    """At least so many where no image has alpha: they part what moves from what rests beside it."""
    node_weight: bool = False
    """A learned weight per control point in the RBF (official code)."""
    shape_rotation: bool = False
    """A second rotation head for the Gaussians' shape (official code); else one rotation does both (paper Eq. 7)."""
    scale_residual: bool = False
    """The network also changes the Gaussians' scales (official code); ours changes their logarithm."""
    shading: bool = True
    """A Gaussian's brightness follows the turn of its surface (ours): what light and normal do, to first order."""
    mask: bool = False
    """A learned share of the motion per Gaussian (an option of the official code); hyper-coordinates do it better."""
    time_noise: float = 0.0
    """Standard deviation of the noise on a step's time, in intervals between frames; it fades until ``network_until``
    (official code, for real video)."""
    bfloat16: bool = False
    """Hidden layers in bfloat16 while training."""
    plane_times: int = 0
    """Texels along t of feature planes; 0: half as many as there are training times (4D-GS)."""

    @property
    def has_shading(self) -> bool:
        """Of the rivals' models it is no part."""
        return self.shading and self.model == "control-points"


@dataclass(frozen=True)
class PretrainConfig:
    """Stage 1: control points trained alone, rendered as same-sized spheres (seed S4)."""

    steps: int = milestone(10_000)
    with_points: bool = False
    """Also where the data brings points; else control points then begin as a sample of those, and learn with the
    Gaussians from the first step."""
    densify_until: int = milestone(7_500)
    """Spheres are densified and pruned until here, then reduced to N_p by farthest-point sampling of trajectories."""
    warm_up: int = milestone(500)
    """Steps before the network starts to move the spheres."""
    densify_every: int = 100
    clone_share: float = 0.2
    """Share of the spheres that is cloned each time, those with the largest gradients, until the cap."""
    start_ratio: float = 8.0
    """Spheres per control point (or as for 256 of them) to start with; while they are at rest they cost little."""
    max_ratio: float = 2.0
    """At most so many per control point (or as for 256 of them) once they move: each one queries the network."""
    opacity_rate: float = 0.02
    """Learning rates of the spheres; with the Gaussians' own they turn transparent before they find their colour."""
    color_rate: float = 1e-2
    arap_weight: float = 1e-3
    random_background: bool = True
    """Where the data has alpha: another background every step, so that black cloth is not mistaken for nothing."""
    progressive: bool = False
    """Begin with the first 20 % of the frames and add 20 % every ``progressive_every`` steps."""
    progressive_every: int = milestone(1_000)


@dataclass(frozen=True)
class OptimConfig:
    """Learning rates; ``_end`` where they decay log-linearly (official values, normalised scene)."""

    means: float = 8e-4
    means_end: float = 8e-6
    means_until: int = milestone(66_000)
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4
    opacity: float = 0.05
    scales: float = 5e-3
    quats: float = 1e-3
    hyper: float = 2.5e-3
    shading: float = 2.5e-3
    network: float = 8e-4
    network_end: float = 1.6e-6
    network_until: int = milestone(66_000)
    nodes: float = 8e-4
    """Radii, weights and hyper-coordinates of the control points."""
    node_positions: float = 8e-5
    settle: float = 0.15
    """Last share of the main stage in which the constant rates of the Gaussians fall, too: to a twentieth."""
    cameras: float = 0.0
    """Corrections of the training cameras' poses (radians, normalised units), from the end of ``freeze``; 0: none."""
    planes: float = 8e-3
    """Feature planes of the hexplane model."""


@dataclass(frozen=True)
class DensifyConfig:
    """Growing, splitting and pruning Gaussians and control points, in main steps."""

    start: int = milestone(500)
    until: int = milestone(40_000)
    every: int = 100
    """Steps between two rounds, at least: fewer see too few of the views to judge by."""
    rounds: int = 132
    """Rounds in all, at most: three times as many make twice the Gaussians, not better images."""
    grad_threshold: float = 1.4e-4
    """Gradient of the loss to the 2D mean in normalised device coordinates, at 800 pixels (official code: 2e-4 at any
    size)."""
    resolution_exponent: float = 0.66
    """The threshold grows by (800 / image size) to this power: small images have larger gradients per Gaussian."""
    absolute_grad: bool = False
    """Judge by the sum of absolute per-pixel gradients."""
    percent_dense: float = 0.01
    """Gaussians larger than this share of the extent are split, smaller ones cloned."""
    min_opacity: float = 0.005
    min_contribution: float = 0.05
    """Before each opacity reset and at the end of densification, prune what makes up less than this many pixels (its
    blending weights summed, at the size of the training images) of every view looked at; 0: nothing."""
    prune_large: Literal["auto", "always", "never"] = "auto"
    """Whether the next two hold; auto: where the images have alpha. Filled images show bare walls."""
    max_screen: float = 0.05
    """Prune what covers more than this share of the image (once opacities were reset)."""
    max_scale: float = 0.1
    """Prune what is larger than this share of the extent (once opacities were reset)."""
    opacity_reset_every: int = milestone(10_000)
    sh_every: int = milestone(1_500)
    """Main steps between two degrees of spherical harmonics."""
    nodes_every: int = milestone(5_000)
    nodes_until: int = milestone(25_000)
    node_grad_threshold: float = 2e-4
    max_gaussians: int = 300_000

    @property
    def interval(self) -> int:
        """Steps from one round to the next."""
        return max(self.every, -(-(self.until - self.start) // self.rounds))


@dataclass(frozen=True)
class LossConfig:
    """L1 + D-SSIM, and ARAP on the control points' trajectories (paper Eq. 10; seed S4)."""

    ssim: float = 0.2
    arap: float = 1e-2
    arap_end: float = 1e-2
    arap_until: int = milestone(80_000)
    """The ARAP weight goes exponentially from the first value to the second until this main step, then the term is
    off (paper: from 1e-4 to 1e-7 over 10,000 steps)."""
    arap_every: int = 5
    """Apply it every so many steps with as many times the weight."""
    arap_pair: Literal["frame", "random"] = "frame"
    """The two instants that are compared. frame: the step's own and a random one, of which the network has to be asked
    for one alone; random: two random ones."""
    arap_times: int = 8
    """Sampled times N_t whose trajectories define the neighbours."""
    arap_neighbors: int = 8
    arap_refresh: int = 200
    hexplane_tv: float = 1e-4
    hexplane_smooth: float = 1e-2
    hexplane_rest: float = 1e-4
    """Feature planes (4D-GS): differences in space, second differences in time, distance of time planes from 1."""


@dataclass(frozen=True)
class TrainConfig:
    """A complete run. ``steps`` is the total of both stages; every milestone is in steps."""

    preset: PresetName = "paper"
    steps: int = 80_000
    freeze: int = milestone(3_000)
    """Main steps during which control points and network stay as stage 1 left them."""
    coarse: int = milestone(6_000)
    """The same for models without stage 1: a static scene comes first."""
    init_points: int = 20_000
    """Gaussians to start with, and no more where the data brings more points; filled images get points behind theirs up
    to this total."""
    init_from: Literal["points", "spheres"] = "spheres"
    """points: at the data's points, else at random where the images' alpha allows something to be; spheres: around the
    control points that stage 1 found."""
    sh_degree: int = 3
    antialiased: bool = False
    seed: int = 0
    batch: int = 1
    """Views per step: their gradients are averaged. Several processes share them (docs/scaling.md)."""
    half_size: int = milestone(0)
    """Steps of both stages in which the images are looked at in half their size: coarse first, and twice as fast."""
    evaluate_every: int = milestone(5_000)
    """Steps between two looks at the test split (a few images, for the curve only: nothing is selected by it)."""
    checkpoint_seconds: float = 60.0
    data: DataConfig = field(default_factory=DataConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    loss: LossConfig = field(default_factory=LossConfig)

    @property
    def pretrain_steps(self) -> int:
        """Stage 1 exists for control points alone."""
        return self.pretrain.steps if self.motion.model == "control-points" else 0

    @property
    def rest_steps(self) -> int:
        """First main steps in which only the Gaussians learn: ``freeze`` or ``coarse``."""
        return self.freeze if self.motion.model == "control-points" else self.coarse

    @property
    def main_steps(self) -> int:
        return self.steps - self.pretrain_steps


BACKGROUND_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "random": (0.0, 0.0, 0.0)}
"""What RGBA images are composited on when they are read. With ``random`` the trainer composites, once per step."""
