"""The settings of a training run: frozen dataclasses, nested by who uses them, with bounds and help beside each field.

Step counts that scale with the length of a run are made by :func:`milestone`: ``presets.with_steps`` scales them all.
``config/presets.py`` makes, reads and writes presets; ``config/validation.py`` checks the bounds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

MotionName = Literal["control-points", "per-gaussian", "hexplane", "static"]
PresetName = Literal["quick", "cpu", "paper"]
CACHE_MIB = 2048
"""Default size of the cache of decoded images: 200 images of 800 x 800 pixels with alpha."""


def bounded(default: float, least: float | None = None, most: float | None = None, **more: Any) -> Any:
    """A number with bounds, inclusive. ``most`` is for sizes that take memory: a configuration may come from anywhere.

    Without ``least``, the field is checked by a rule of its own in ``validation.py`` or may be any number.
    """
    return field(default=default, metadata={"least": least, "most": most, **more})


def chosen(default: int, least: int, most: int) -> Any:
    """A whole number with a short range of choices, inclusive."""
    return field(default=default, metadata={"choices": (least, most)})


def milestone(steps: int, least: int | None = None) -> Any:
    """A step count that scales with the length of the run."""
    return bounded(steps, least, milestone=True)


@dataclass(frozen=True)
class DataConfig:
    """Images that the run learns from."""

    downscale: int = bounded(1, 1, 1_000)
    """Divide the images' width and height by this."""
    resample: Literal["area", "bicubic"] = "area"
    """Filter of the reduction; bicubic (through Pillow, 8 bit) makes the truth as the official code does."""
    background: Literal["black", "white", "random"] = "black"
    """Colour behind transparent pixels; random: another colour every step, black for evaluation."""
    cache_mib: int = bounded(CACHE_MIB, 0)
    """Decoded images kept in memory; the others are decoded whenever they are needed. Changes no bit of the result."""


@dataclass(frozen=True)
class MotionConfig:
    """Control points and the network that moves them (seed S4; paper section 4.1)."""

    model: MotionName = "control-points"
    nodes: int = bounded(512, most=1_000_000)
    """Number of control points, N_p."""
    neighbors: int = chosen(4, 1, 16)
    """Number of control points that move a Gaussian, K."""
    layers: int = bounded(8, 1, 64)
    width: int = bounded(256, 1, 2_048)
    skip: int = 4
    """The layer whose output is concatenated with the network's input."""
    position_frequencies: int = bounded(10, 1, 32)
    time_frequencies: int = bounded(6, 1, 32)
    train_positions: bool = True
    """Control points' rest positions learn in the joint phase (paper); the official code never moves them."""
    hyper_dim: int = bounded(0, 0, 64)
    """Hyper-coordinates appended to the neighbour search (the official code uses 8)."""
    hyper_dim_filled: int = bounded(4, 0, 64)
    """Minimum of hyper_dim where no image has alpha: hyper-coordinates part moving surfaces from resting ones beside
    them."""
    node_weight: bool = False
    """A learned weight per control point in the RBF (official code)."""
    shape_rotation: bool = False
    """A second rotation head for the Gaussians' shape (official code); else one rotation does both (paper Eq. 7)."""
    scale_residual: bool = False
    """The network also changes the Gaussians' scales (official code); ours changes their logarithm."""
    shading: bool = True
    """A Gaussian's brightness follows the rotation of its surface (ours): the effect of light and normal, to first
    order."""
    mask: bool = False
    """A learned share of the motion per Gaussian (an option of the official code); hyper-coordinates work better."""
    time_noise: float = bounded(0.0, 0, 1e6)
    """Standard deviation of the noise on a step's time, in intervals between frames; it fades until ``network_until``
    (official code, for real video)."""
    bfloat16: bool = False
    """Hidden layers in bfloat16 while training."""
    plane_times: int = 0
    """Texels along t of feature planes; 0: half as many as there are training times (4D-GS)."""

    @property
    def has_shading(self) -> bool:
        """True for control points only: the rival models have no shading."""
        return self.shading and self.model == "control-points"


@dataclass(frozen=True)
class PretrainConfig:
    """Stage 1: control points trained alone, rendered as same-sized spheres (seed S4)."""

    steps: int = milestone(10_000, 0)
    with_points: bool = False
    """Keep stage 1 where the data brings points; else control points then begin as a sample of those, and learn with
    the Gaussians from the first step."""
    densify_until: int = milestone(7_500)
    """Step until which spheres are densified and pruned; then farthest-point sampling of trajectories reduces them to
    N_p."""
    warm_up: int = milestone(500, 0)
    """Steps before the network starts to move the spheres."""
    densify_every: int = bounded(100, 1)
    clone_share: float = bounded(0.2, 0, 1)
    """Share of the spheres that is cloned each time, those with the largest gradients, until the cap."""
    start_ratio: float = bounded(8.0, 1, 1e4)
    """Spheres per control point (at least 256 points are assumed) at the start; while at rest they cost little."""
    max_ratio: float = bounded(2.0, 1, 1e4)
    """Cap of the spheres per control point (at least 256 are assumed) once they move: each queries the network."""
    opacity_rate: float = 0.02
    """Learning rates of the spheres; with the Gaussians' own they turn transparent before they find their colour."""
    color_rate: float = 1e-2
    arap_weight: float = bounded(1e-3, 0)
    random_background: bool = True
    """Where the data has alpha, use another background every step, so that black cloth is not mistaken for nothing."""
    progressive: bool = False
    """Begin with the first 20 % of the frames and add 20 % every ``progressive_every`` steps."""
    progressive_every: int = milestone(1_000, 1)


@dataclass(frozen=True)
class OptimConfig:
    """Learning rates; ``_end`` where they decay log-linearly (official values, normalised scene)."""

    means: float = 8e-4
    means_end: float = 8e-6
    means_until: int = milestone(66_000, 1)
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4
    opacity: float = 0.05
    scales: float = 5e-3
    quats: float = 1e-3
    hyper: float = 2.5e-3
    shading: float = bounded(2.5e-3, 0)
    network: float = 8e-4
    network_end: float = 1.6e-6
    network_until: int = milestone(66_000, 1)
    nodes: float = 8e-4
    """Radii, weights and hyper-coordinates of the control points."""
    node_positions: float = 8e-5
    settle: float = bounded(0.15, 0)
    """Last share of the main stage in which the constant rates of the Gaussians fall, too: to a twentieth."""
    cameras: float = bounded(0.0, 0)
    """Corrections of the training cameras' poses (radians, normalised units), from the end of ``freeze``; 0: none."""
    planes: float = 8e-3
    """Feature planes of the hexplane model."""


@dataclass(frozen=True)
class DensifyConfig:
    """Adaptive density control of Gaussians and control points, in main steps."""

    start: int = milestone(500, 0)
    until: int = milestone(40_000, 0)
    every: int = bounded(100, 1)
    """Least number of steps between two rounds: fewer see too few of the views to judge by."""
    rounds: int = bounded(132, 1)
    """Largest number of rounds in all: three times as many make twice the Gaussians, not better images."""
    grad_threshold: float = bounded(1.4e-4, 0)
    """Gradient of the loss to the 2D mean in normalised device coordinates, at 800 pixels (official code: 2e-4 at any
    size)."""
    resolution_exponent: float = 0.66
    """The threshold grows by (800 / image size) to this power: small images have larger gradients per Gaussian."""
    absolute_grad: bool = False
    """Judge by the sum of absolute per-pixel gradients."""
    percent_dense: float = 0.01
    """Gaussians larger than this share of the extent are split, smaller ones cloned."""
    min_opacity: float = bounded(0.005, 0)
    min_contribution: float = bounded(0.05, 0)
    """Visibility pruning, before each opacity reset and at the end of densification: remove Gaussians that contribute
    less than this many pixels (sum of blending weights, at the size of the training images) to every sampled view; 0:
    off."""
    prune_large: Literal["auto", "always", "never"] = "auto"
    """Apply max_screen and max_scale; auto: where the images have alpha. Filled images show bare walls."""
    max_screen: float = 0.05
    """Prune Gaussians that cover more than this share of the image (after the first opacity reset)."""
    max_scale: float = 0.1
    """Prune Gaussians larger than this share of the extent (after the first opacity reset)."""
    opacity_reset_every: int = milestone(10_000, 1)
    sh_every: int = milestone(1_500, 1)
    """Main steps between two degrees of spherical harmonics."""
    nodes_every: int = milestone(5_000, 1)
    nodes_until: int = milestone(25_000)
    node_grad_threshold: float = 2e-4
    max_gaussians: int = bounded(300_000, most=100_000_000)

    @property
    def interval(self) -> int:
        """Steps from one round to the next."""
        return max(self.every, -(-(self.until - self.start) // self.rounds))


@dataclass(frozen=True)
class LossConfig:
    """L1 + D-SSIM, and ARAP on the control points' trajectories (paper Eq. 10; seed S4)."""

    ssim: float = bounded(0.2, 0)
    arap: float = bounded(1e-2, 0)
    arap_end: float = bounded(1e-2, 0)
    arap_until: int = milestone(80_000)
    """The ARAP weight goes exponentially from the first value to the second until this main step, then the term is
    off (paper: from 1e-4 to 1e-7 over 10,000 steps)."""
    arap_every: int = bounded(5, 1)
    """Apply the term every so many steps with as many times the weight."""
    arap_pair: Literal["frame", "random"] = "frame"
    """The two instants that are compared. frame: the step's own and a random one, so that the network is queried for
    one more instant only; random: two random ones."""
    arap_times: int = bounded(8, 1, 10_000)
    """Sampled times N_t whose trajectories define the neighbours."""
    arap_neighbors: int = chosen(8, 1, 15)
    arap_refresh: int = bounded(200, 1)
    hexplane_tv: float = bounded(1e-4, 0)
    hexplane_smooth: float = bounded(1e-2, 0)
    hexplane_rest: float = bounded(1e-4, 0)
    """Feature planes (4D-GS): differences in space, second differences in time, distance of time planes from 1."""


@dataclass(frozen=True)
class TrainConfig:
    """A complete run. ``steps`` is the total of both stages; every milestone is in steps."""

    preset: PresetName = "paper"
    steps: int = bounded(80_000, most=100_000_000)
    freeze: int = milestone(3_000, 0)
    """Main steps during which control points and network stay as stage 1 left them."""
    coarse: int = milestone(6_000, 0)
    """The same for models without stage 1: a static scene comes first."""
    init_points: int = bounded(20_000, 1, 10_000_000)
    """Gaussians to start with, and no more where the data brings more points; filled images get points behind theirs up
    to this total."""
    init_from: Literal["points", "spheres"] = "spheres"
    """points: at the data's points, else at random where the images' alpha allows something to be; spheres: around the
    control points that stage 1 found."""
    sh_degree: int = chosen(3, 0, 3)
    antialiased: bool = False
    seed: int = bounded(0, 0)
    batch: int = bounded(1, 1)
    """Views per step: their gradients are averaged. Several processes share them (docs/scaling.md)."""
    half_size: int = milestone(0, 0)
    """Steps of both stages that use the images at half their size: coarse first, and twice as fast."""
    evaluate_every: int = milestone(5_000, 1)
    """Steps between two evaluations on a few test images, for the curve only: nothing is selected by it."""
    checkpoint_seconds: float = bounded(60.0, 0)
    data: DataConfig = field(default_factory=DataConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    loss: LossConfig = field(default_factory=LossConfig)

    @property
    def pretrain_steps(self) -> int:
        """Steps of stage 1, which exists for control points alone."""
        return self.pretrain.steps if self.motion.model == "control-points" else 0

    @property
    def rest_steps(self) -> int:
        """First main steps in which only the Gaussians learn: ``freeze`` or ``coarse``."""
        return self.freeze if self.motion.model == "control-points" else self.coarse

    @property
    def main_steps(self) -> int:
        """Steps after stage 1."""
        return self.steps - self.pretrain_steps


BACKGROUND_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "random": (0.0, 0.0, 0.0)}
"""Colours behind RGBA images when they are read. With ``random`` the trainer composites, once per step."""
