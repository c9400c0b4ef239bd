"""The settings of a training run: frozen, nested dataclasses, one per component that uses them, with bounds and help
for each field.

Step counts that scale with the length of a run are declared with ``milestone``; ``presets.with_steps`` scales them
all. ``config/presets.py`` makes, reads and writes presets; ``config/validation.py`` checks the bounds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from .bounds import bounded, chosen, milestone, newer, rate
from .losses import LossConfig
from .rates import OptimConfig

MotionName = Literal["control-points", "per-gaussian", "hexplane", "static"]
PresetName = Literal["quick", "cpu", "best", "paper"]
IMAGE_SETTINGS = ("downscale", "resample", "background", "frames", "only_cameras", "min_frames")
"""Fields of ``DataConfig`` that say which images a run sees, and how: arguments of ``data.load``."""
CACHE_MIB = 2048
"""Default size of the cache of decoded images: 200 images of 800 x 800 pixels with alpha."""


@dataclass(frozen=True)
class DataConfig:
    """Images that the run learns from."""

    downscale: int = bounded(1, 1, 1_000)
    """Divide the images' width and height by this."""
    resample: Literal["area", "bicubic"] = "area"
    """Filter of the reduction. bicubic (Pillow, 8 bits) reduces the images as the official code does."""
    background: Literal["black", "white", "random"] = "black"
    """Colour behind transparent pixels. random: a new colour in every step, and black for evaluation."""
    frames: str = newer("", before="")
    """Instants to read, as A:B:C (first, end, step) in their order; their times then go from 0 to 1. Empty: all."""
    only_cameras: str = newer("", before="")
    """Names of the cameras to read, separated by commas (docs/data.md says what is a camera's name). Empty: all."""
    min_frames: int = newer(0, before=0, least=0)
    """Smallest number of frames whose images must exist; frames without images are left out. 0: half of the frames."""
    cache_mib: int = bounded(CACHE_MIB, 0)
    """Size of the cache of decoded images, MiB. Images beyond it are decoded at each use. The result is bit-identical
    for every size."""


@dataclass(frozen=True)
class MotionConfig:
    """Control points and the network that moves them (paper section 4.1)."""

    model: MotionName = "control-points"
    """Motion model: control points (SC-GS), one network query per Gaussian, feature planes, or no motion."""
    nodes: int = bounded(512, 1, 1_000_000)
    """Number of control points, N_p."""
    neighbors: int = chosen(4, 1, 16)
    """Number of control points that move each Gaussian, K."""
    layers: int = bounded(8, 1, 64)
    """Number of layers of the network."""
    width: int = bounded(256, 1, 2_048)
    """Width of its layers."""
    skip: int = bounded(4, 0, 64)
    """Index of the layer whose output is concatenated with the network's input."""
    position_frequencies: int = bounded(10, 1, 32)
    """Number of frequencies by which positions are encoded."""
    time_frequencies: int = bounded(6, 1, 32)
    """Number of frequencies by which times are encoded."""
    chunks: int = newer(1, before=1, least=1, most=64)
    """Number of chunks of time, each with a network of its own over the same control points and Gaussians, for long
    films: one for about 250 frames. Neighbouring networks are blended where chunks meet. For control points and
    per-gaussian."""
    train_positions: bool = True
    """Learn the rest positions of the control points in the main stage (paper); the official code never moves them."""
    hyper_dim: int = bounded(1, 0, 64)
    """Number of hyper-coordinates appended to positions in the neighbour search. They separate parts that lie side by
    side and move apart, such as a shadow and the table on which it falls. The official code has eight, which begin
    equal, have equal gradients, and so stay equal."""
    hyper_stretch: float = newer(8**0.5, before=1.0, least=0, most=1e3)
    """Factor on the start and the learning rates of the hyper-coordinates. One coordinate that is stretched by the
    square root of eight makes the distances of eight equal ones."""
    hyper_dim_filled: int = bounded(1, 0, 64)
    """Minimum of hyper_dim if no image has alpha."""
    node_weight: bool = True
    """Learn a weight per control point in the RBF (official code)."""
    shape_rotation: bool = False
    """Use a second rotation head for the Gaussians' shape (official code); otherwise one rotation serves positions and
    shape (paper Eq. 7)."""
    scale_residual: bool = False
    """Let the network also change the Gaussians' scales (official code); here it changes their logarithm. Turns
    ``tints`` off."""
    shading: bool = True
    """Let a Gaussian's brightness follow the rotation of its surface (not in the paper): the first-order effect of the
    angle between light and normal."""
    correctives: bool = newer(True, before=False)
    """Let a Gaussian's position follow the rotation of its surface (not in the paper): what pose blend shapes are to a
    body model."""
    tints: bool = newer(True, before=False)
    """Let the control points change the Gaussians' colours over time (not in the paper), as shadows and the light from
    neighbouring surfaces do. Off with ``scale_residual``, because skinning blends three values beside the motion."""
    turns: bool = newer(True, before=False)
    """Find the turns of round bodies, which outlines do not show, by comparing what the views show on their surface,
    and add them to the motion before each opacity reset from the second on (not in the paper). Only for cut-out
    subjects."""
    mask: bool = False
    """Learn for each Gaussian which share of the motion it takes (an option of the official code); hyper-coordinates
    work better."""
    time_noise: float = bounded(0.0, 0, 1e6)
    """Standard deviation of the noise on each step's time, in intervals between frames; the noise fades until
    ``network_until`` (official code, for real video)."""
    bfloat16: bool = False
    """Compute the hidden layers in bfloat16 while training."""
    bfloat16_adjoint: bool = newer(True, before=False)
    """On a CPU with AVX512-BF16, round the factors of the network's gradients to bfloat16; sums stay in float32."""
    plane_times: int = bounded(0, 0, 4_096)
    """Number of texels of the feature planes along t; 0: half the number of training times (4D-GS)."""

    @property
    def hyper_columns(self) -> int:
        """Number of hyper-coordinates of each Gaussian, the mask's logit included; 0 for the other models, which have
        no neighbours to find."""
        return self.hyper_dim + self.mask if self.model == "control-points" else 0

    @property
    def has_shading(self) -> bool:
        """True if shading is on and the model is control-points: the other models have no shading."""
        return self.shading and self.model == "control-points"

    @property
    def has_tints(self) -> bool:
        """True if tints are on, the model is control-points, and it does not change scales."""
        return self.tints and self.model == "control-points" and not self.scale_residual

    @property
    def has_correctives(self) -> bool:
        """True if correctives are on and the model is control-points."""
        return self.correctives and self.model == "control-points"


@dataclass(frozen=True)
class PretrainConfig:
    """Stage 1: control points trained alone, rendered as same-sized spheres."""

    steps: int = milestone(5_000)
    """Number of steps of stage 1."""
    with_points: bool = False
    """Keep stage 1 if the data has points. Otherwise these give control points, which learn with Gaussians."""
    densify_until: int = milestone(3_750)
    """Step at which spheres are no longer densified and pruned; farthest-point sampling of trajectories then reduces
    them to N_p."""
    warm_up: int = milestone(50)
    """Step at which the network starts to move the spheres. After a longer rest, only spheres of parts that hardly move
    would be left."""
    densify_every: int = bounded(100, 1)
    """Number of steps between two rounds of densification."""
    densify_by: Literal["share", "gradient"] = newer("share", before="share")
    """Choice of the spheres that are cloned. share: a fixed share of them. gradient: those whose gradient reaches
    ``grad_threshold``, and otherwise as Gaussians in the main stage: split if they are large, pruned below
    ``densify.min_opacity``, with opacity resets (official code)."""
    clone_share: float = bounded(0.2, 0, 1)
    """Share of the spheres cloned in each round, until the cap: those with the largest gradients."""
    grad_threshold: float = newer(2e-4, before=2e-4, least=0)
    """Gradient with respect to the 2D mean, in normalised device coordinates, for ``densify_by`` gradient."""
    start_ratio: float = bounded(8.0, 1, 1e4)
    """Number of spheres per control point at the start, where ``densify_by`` share counts at least 256 control points;
    spheres at rest cost little."""
    max_ratio: float = bounded(2.0, 1, 1e4)
    """Largest number of spheres per control point once the spheres move (control points counted as for
    ``start_ratio``): the network is evaluated at each sphere."""
    grey: bool = newer(False, before=False)
    """Start with grey spheres (official code), not with the colours of the points."""
    opacity_rate: float = rate(0.02)
    """Learning rate of the spheres' opacities. With the learning rates of the Gaussians, spheres would turn transparent
    before they find their colour."""
    color_rate: float = rate(1e-2)
    """Learning rate of the spheres' colours."""
    arap_weight: float = bounded(1e-3, 0, 1e6)
    """Weight of ARAP on the trajectories of the spheres."""
    arap_by: Literal["auto", "track", "moment"] = newer("auto", before="track")
    """Choice of ARAP's neighbours. track: those over the whole time (supplement). moment: those at the first of the two
    times compared, less those that part. auto: track; then, for cut-out subjects that are not thin, stage 1 is trained
    a second time with moment (``training.second_try``)."""
    body_turn: bool = newer(True, before=False)
    """Look for a turn of the whole subject in its silhouettes, where stage 1 may be trained a second time; if one is
    found, that begins with it (``training.body_turn``, not in the paper)."""
    random_background: bool = True
    """Change the background in every step if the data has alpha: black cloth is then not taken for empty space."""
    silhouette: float = newer(0.5, before=0.0, least=0, most=1e6)
    """Weight of the distance between the spheres' projected centres and the silhouette (not in the paper), in units of
    the image's width; needs alpha. It brings spheres to thin and fast parts, which the photometric loss makes
    transparent. If above 0, spheres are not larger than thin subjects are thick."""
    pooled: bool = newer(True, before=False)
    """Add the residual averaged over squares of 2, 4 and 8 % of the width (not in the paper). It draws a sphere to its
    part from farther away, and moves it instead of turning it transparent."""
    fade: Literal["auto", "always", "never"] = newer("auto", before="always")
    """Let spheres turn more transparent than ``solid_opacity``. A part whose spheres have faded is lost, but strays
    should fade. auto: never if the subject is in separate parts, is not thin, and ``silhouette`` is above 0; otherwise
    always."""
    progressive: bool = False
    """Begin with the first 20 % of the frames and add 20 % every ``progressive_every`` steps."""
    progressive_every: int = milestone(500, 1)
    """Number of steps from one fifth of the frames to the next."""
    progressive_by: Literal["frame", "fifth"] = newer("frame", before="frame")
    """How frames are added. frame: one by one at the same pace; every other step uses one of the newest 20 %, and
    spheres begin in the first pose. fifth: 20 % at a time; all frames are used equally often (supplement)."""
    solid_opacity: float = newer(0.1, before=0.1, least=0, most=1)
    """Opacity below which a sphere is not used to place control points or Gaussians, if there are enough others."""
    least_radius: float = newer(1.0, before=1.0, least=0, most=1e3)
    """Smallest radius of control points after stage 1, as a share of their typical spacing, so that neighbours blend.
    Their radius is otherwise that of the spheres."""


@dataclass(frozen=True)
class DensifyConfig:
    """Adaptive density control of Gaussians and control points, in main steps."""

    start: int = milestone(250)
    """Main step of the first round."""
    until: int = milestone(20_000)
    """Main step of the last round."""
    every: int = bounded(100, 1)
    """Smallest number of steps between two rounds: after fewer steps, too few views would decide."""
    rounds: int = bounded(132, 0)
    """Largest number of rounds in total (0: no limit): three times as many double the number of Gaussians without
    improving the images."""
    grad_threshold: float = bounded(1.4e-4, 0)
    """Gradient of the 2D mean, in normalised device coordinates, above which Gaussians are densified, for images of 800
    pixels (official code: 2e-4 at any size)."""
    resolution_exponent: float = bounded(0.66, 0, 10)
    """Exponent of (800 / image size), by which the threshold is multiplied: in small images, each Gaussian has larger
    gradients."""
    absolute_grad: bool = False
    """Densify by the sum of absolute per-pixel gradients."""
    percent_dense: float = bounded(0.01, 0, 1e3)
    """Split Gaussians larger than this share of the extent, and clone smaller ones."""
    min_opacity: float = bounded(0.005, 0, 1)
    """Prune Gaussians that are less opaque than this."""
    min_contribution: float = bounded(0.05, 0)
    """Visibility pruning, before each opacity reset and at the end of densification: remove Gaussians that contribute
    less than this many pixels to every sampled view (sum of blending weights, at the size of the training images). 0:
    off."""
    least_views: int = newer(2, before=1, least=1, most=1_000)
    """Visibility pruning without alpha, if all views are sampled: also remove Gaussians that contribute
    ``min_contribution`` to fewer views than this. They fit a single photo and hide the scene from others. 1: off."""
    clear_distance: float = newer(0.25, before=0.0, least=0, most=1)
    """Visibility pruning without alpha: also remove Gaussians whose distance from a camera is less than this share of
    the distance at which the camera's content begins: they become fog before the lens. 0: off."""
    faint_share: float = newer(0.01, before=0.0, least=0, most=1)
    """Visibility pruning with alpha: also remove the Gaussians that contribute least, as many as together have at most
    this share of all contributions. The contribution of a Gaussian is its largest one to a sampled view. 0: off."""
    faint_at: Literal["resets", "end"] = newer("resets", before="end")
    """Rounds of visibility pruning in which these are removed. resets: all. end: only that at the end of
    densification."""
    prune_large: Literal["auto", "always", "never"] = "auto"
    """Apply max_screen and max_scale. auto: only with alpha; without it, bare walls need large Gaussians."""
    max_screen: float = bounded(0.05, 0, 1e3)
    """Prune Gaussians that cover more than this share of the image (after the first opacity reset). 0: off."""
    max_scale: float = bounded(0.1, 0, 1e3)
    """Prune Gaussians larger than this share of the extent (after the first opacity reset)."""
    opacity_reset_every: int = milestone(5_000, 1)
    """Number of main steps between two opacity resets."""
    sh_every: int = milestone(750, 1)
    """Number of main steps between two degrees of spherical harmonics."""
    nodes_every: int = milestone(2_500, 1)
    """Number of main steps between two rounds in which control points are cloned and pruned."""
    nodes_until: int = milestone(12_500)
    """Main step after which no control point is cloned or pruned."""
    node_grad_threshold: float = bounded(2e-4, 0)
    """Clone control points above this gradient: the weighted mean over the Gaussians that the control point moves, in
    the units of ``grad_threshold`` and scaled in the same way."""
    node_impact: float = newer(1e-2, before=1e-2, least=0)
    """Prune control points whose weights, summed over all Gaussians, are less than this."""
    node_growth: float = newer(0.1, before=0.1, least=0, most=1)
    """Clone at most this share of the control points at a time, those with the largest gradients."""
    max_gaussians: int = bounded(300_000, 1, 100_000_000)
    """Largest number of Gaussians at any time, which bounds memory."""

    @property
    def interval(self) -> int:
        """Number of steps from one round to the next."""
        return max(self.every, -(-(self.until - self.start) // self.rounds) if self.rounds else 0)


@dataclass(frozen=True)
class TrainConfig:
    """A complete run. ``steps`` is the total of both stages; every milestone is a number of steps."""

    preset: PresetName = "best"
    """Preset from which the other fields come."""
    steps: int = bounded(40_000, 1, 100_000_000)
    """Steps of both stages together (``--steps``, which scales the milestones)."""
    freeze: int = milestone(1_500)
    """Number of main steps at the beginning in which control points and network stay as stage 1 left them."""
    coarse: int = milestone(3_000)
    """Number of main steps at the beginning in which models without stage 1 learn a static scene."""
    shortest: int = newer(0, before=0, least=0)
    """Number of steps below which a shorter run does not scale ``freeze``, ``coarse`` and
    ``densify.opacity_reset_every``: Gaussians need about as many steps to turn transparent or opaque."""
    flow_points: int = newer(4_000, before=0, least=0, most=10_000_000)
    """Number of initial points on what moves, found by optical flow, stereo of a rig or depth maps (only with initial
    points, and without alpha). 0: none."""
    init_points: int = bounded(20_000, 1, 10_000_000)
    """Number of initial Gaussians. If the data has more points, only this many are used; if it has fewer and the images
    have no alpha, points behind the data's points are added up to this number."""
    init_from: Literal["points", "spheres"] = "spheres"
    """Placement of the initial Gaussians. points: at the data's points or, without any, at random where the images'
    alpha shows an object. spheres: around the control points that stage 1 found."""
    init_random: Literal["covered", "cube"] = newer("covered", before="covered")
    """Random initial points. covered: where the images' alpha shows an object or, without alpha, where the cameras'
    views overlap; where the data has points, behind them. cube: grey and uniformly in a cube around the scene, only if
    the data has no points (official code)."""
    sh_degree: int = chosen(3, 0, 3)
    """Degree of the spherical harmonics of the colours."""
    antialiased: bool = False
    """Dim Gaussians that are smaller than a pixel (Mip-Splatting)."""
    sharpness: float = newer(0.5, before=0.0, least=0, most=10)
    """Value s by which the splats fall off faster than a Gaussian (not in the paper): the opacity is multiplied by
    exp(-u - s u^2), where u is half the squared distance in units of the covariance. Opaque outlines become as sharp as
    in the images. 0: exact Gaussians, as other programs draw them; exports to their formats approximate others."""
    seed: int = bounded(0, 0)
    """Random seed; the same seed gives bit-identical results on the same machine."""
    batch: int = bounded(1, 1, 100_000)
    """Number of views per step; their gradients are averaged. Processes can share them (docs/scaling.md)."""
    half_size: int = milestone(0)
    """Number of steps, from the start and over both stages, that use the images at half their size: such steps are
    twice as fast."""
    evaluate_every: int = milestone(5_000, 1)
    """Number of steps between two evaluations on a few test images, which only draw the curve."""
    checkpoint_seconds: float = bounded(60.0, 0)
    """Seconds between two checkpoints."""
    data: DataConfig = field(default_factory=DataConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    loss: LossConfig = field(default_factory=LossConfig)

    @property
    def pretrain_steps(self) -> int:
        """Number of steps of stage 1, which exists only for control points."""
        return self.pretrain.steps if self.motion.model == "control-points" else 0

    @property
    def rest_steps(self) -> int:
        """Number of main steps at the beginning in which only the Gaussians learn: ``freeze`` or ``coarse``."""
        return self.freeze if self.motion.model == "control-points" else self.coarse

    @property
    def main_steps(self) -> int:
        """Number of steps after stage 1."""
        return self.steps - self.pretrain_steps


BACKGROUND_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "random": (0.0, 0.0, 0.0)}
"""Colours behind RGBA images when they are read. With ``random``, images are read on black, and the trainer composites
them on a new colour in every step."""
