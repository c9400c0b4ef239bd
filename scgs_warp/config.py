"""Every setting of a training run: frozen dataclasses, nested by who uses them, and the three presets.

Step counts that are milestones of a run are marked ``milestone``: ``with_steps`` scales them all when ``--steps``
changes the total. ``config.json`` of a run directory is ``to_dict`` of the whole and can be read back.
"""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from .errors import UserError

MotionName = Literal["control-points", "per-gaussian", "hexplane", "static"]
PresetName = Literal["quick", "cpu", "paper"]
MOTIONS: tuple[str, ...] = get_args(MotionName)
PRESETS: tuple[str, ...] = get_args(PresetName)


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
    """Spheres per control point to start with; while they are at rest they cost little."""
    max_ratio: float = 4.0
    """At most this many spheres per control point once they move: each one queries the network."""
    opacity_rate: float = 0.02
    """Learning rates of the spheres; with the Gaussians' own they turn transparent before they find their colour."""
    color_rate: float = 1e-2
    arap_weight: float = 1e-2
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
    means_until: int = milestone(30_000)
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4
    opacity: float = 0.05
    scales: float = 5e-3
    quats: float = 1e-3
    hyper: float = 2.5e-3
    shading: float = 2.5e-3
    network: float = 8e-4
    network_end: float = 1.6e-6
    network_until: int = milestone(40_000)
    nodes: float = 8e-4
    """Radii, weights and hyper-coordinates of the control points."""
    node_positions: float = 8e-5
    cameras: float = 0.0
    """Corrections of the training cameras' poses (radians, normalised units), from the end of ``freeze``; 0: none."""
    planes: float = 8e-3
    """Feature planes of the hexplane model."""


@dataclass(frozen=True)
class DensifyConfig:
    """Growing, splitting and pruning Gaussians and control points, in main steps."""

    start: int = milestone(500)
    until: int = milestone(50_000)
    every: int = 100
    grad_threshold: float = 2e-4
    """Gradient of the loss to the 2D mean in normalised device coordinates, at 800 pixels."""
    resolution_exponent: float = 0.66
    """The threshold grows by (800 / image size) to this power: small images have larger gradients per Gaussian."""
    absolute_grad: bool = False
    """Judge by the sum of absolute per-pixel gradients."""
    percent_dense: float = 0.01
    """Gaussians larger than this share of the extent are split, smaller ones cloned."""
    min_opacity: float = 0.005
    prune_large: Literal["auto", "always", "never"] = "auto"
    """Whether the next two hold; auto: where the images have alpha. Filled images show bare walls."""
    max_screen: float = 0.05
    """Prune what covers more than this share of the image (once opacities were reset)."""
    max_scale: float = 0.1
    """Prune what is larger than this share of the extent (once opacities were reset)."""
    opacity_reset_every: int = milestone(3_000)
    sh_every: int = milestone(1_000)
    """Main steps between two degrees of spherical harmonics."""
    nodes_every: int = milestone(5_000)
    nodes_until: int = milestone(25_000)
    node_grad_threshold: float = 2e-4
    max_gaussians: int = 300_000


@dataclass(frozen=True)
class LossConfig:
    """L1 + D-SSIM, and ARAP on the control points' trajectories (paper Eq. 10; seed S4)."""

    ssim: float = 0.2
    arap: float = 1e-4
    arap_end: float = 1e-7
    arap_until: int = milestone(10_000)
    """The ARAP weight decays exponentially until this main step, then the term is off."""
    arap_every: int = 1
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
    init_points: int = 100_000
    """Gaussians to start with where the data brings no points."""
    init_from: Literal["points", "spheres"] = "points"
    """points: at the data's points, else at random where the images' alpha allows something to be; spheres: around the
    control points that stage 1 found."""
    sh_degree: int = 3
    antialiased: bool = False
    seed: int = 0
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


def preset(name: PresetName) -> TrainConfig:
    """A complete configuration. ``quick``: the built-in scene; ``cpu``: minutes on two cores; ``paper``: seed S4."""
    if name == "paper":
        return TrainConfig()
    cpu = TrainConfig(
        preset="cpu",
        steps=24_000,
        freeze=400,
        coarse=1_800,
        init_points=10_000,
        init_from="spheres",
        evaluate_every=5_000,
        pretrain=PretrainConfig(
            steps=3_000, densify_until=2_000, warm_up=300, max_ratio=2.0, arap_weight=1e-3, progressive_every=300
        ),
        motion=MotionConfig(nodes=256),
        optim=OptimConfig(means_until=21_000, network_until=21_000),
        densify=DensifyConfig(
            start=400,
            until=12_000,
            opacity_reset_every=3_000,
            sh_every=500,
            nodes_every=2_000,
            nodes_until=9_000,
        ),
        loss=LossConfig(arap_until=5_000, arap_every=5),
    )
    if name == "cpu":
        return cpu
    # The built-in figure swings an arm through 137 degrees: spheres follow it only frame by frame.
    stage1 = dataclasses.replace(
        cpu.pretrain,
        steps=1_800,
        densify_until=1_500,
        warm_up=100,
        progressive=True,
        progressive_every=330,
        start_ratio=16.0,
    )
    quick = with_steps(cpu, 7_000)
    return dataclasses.replace(quick, preset="quick", half_size=1_800, pretrain=stage1)


def with_steps(config: TrainConfig, steps: int) -> TrainConfig:
    """The same run compressed or stretched to ``steps`` in all: every milestone scales with it.

    Raises:
        UserError: fewer than 10 steps.
    """
    if steps < 10:
        raise UserError(f"--steps {steps}: a run needs at least 10 steps")
    ratio = steps / config.steps
    return dataclasses.replace(_scale(config, ratio), steps=steps)


def _scale(config: Any, ratio: float) -> Any:
    changes: dict[str, Any] = {}
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if item.metadata.get("milestone"):
            changes[item.name] = max(min(value, 1), round(value * ratio))
        elif dataclasses.is_dataclass(value):
            changes[item.name] = _scale(value, ratio)
    return dataclasses.replace(config, **changes)


def to_dict(config: TrainConfig) -> dict[str, Any]:
    return dataclasses.asdict(config)


FREE_TO_CHANGE = ("evaluate_every", "checkpoint_seconds")
"""Settings that change no bit of the result: not part of a checkpoint, and free when a run is resumed."""


def from_dict(values: dict[str, Any], source: str = "config", base: Any = None, prefix: str = "") -> TrainConfig:
    """Read a (possibly partial) configuration over ``base`` (default: the preset it names, else ``paper``).

    Raises:
        UserError: an unknown field or a value of the wrong type, with the file and the field.
    """
    if base is None:
        name = values.get("preset", "paper")
        if name not in PRESETS:
            raise UserError(f"{source}: preset is {name!r}; choose one of {', '.join(PRESETS)}")
        base = preset(name)
    hints = typing.get_type_hints(type(base))
    known = {item.name for item in dataclasses.fields(base)}
    changes: dict[str, Any] = {}
    for key, value in values.items():
        label = f"{prefix}{key}"
        if key not in known:
            raise UserError(f"{source}: unknown field {label!r}; known here: {', '.join(sorted(known))}")
        current = getattr(base, key)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, dict):
                raise UserError(f"{source}: {label} must be an object with fields")
            changes[key] = from_dict(value, source, current, f"{label}.")
        else:
            changes[key] = _checked(value, hints[key], f"{source}: {label}")
    return dataclasses.replace(base, **changes)


def _checked(value: Any, hint: Any, label: str) -> Any:
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            raise UserError(f"{label} is {value!r}; choose one of {', '.join(map(str, get_args(hint)))}")
        return value
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, hint if not isinstance(hint, types.UnionType) else get_args(hint)) or (
        isinstance(value, bool) and hint is not bool
    ):
        raise UserError(f"{label} is {value!r}; expected {getattr(hint, '__name__', hint)}")
    return value


def with_field(config: TrainConfig, name: str, value: Any, source: str) -> TrainConfig:
    """One field replaced, by its dotted name (``motion.hyper_dim``); unknown names and wrong types raise UserError."""
    values: dict[str, Any] = {}
    inner = values
    if name in ("steps", "preset"):
        raise UserError(f"{source}: give --{name} instead: it changes more than one field")
    *outer, last = name.split(".")
    for part in outer:
        inner = inner.setdefault(part, {})
    inner[last] = value
    return from_dict(values, source, config)


def whole_number(value: Any, label: str) -> int:
    """The value, if it is an int.

    Raises:
        UserError: it is not.
    """
    return _checked(value, int, label)


def parse_value(text: str) -> Any:
    """A JSON value, else the text itself."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def read_config(path: Path) -> dict[str, Any]:
    """The JSON object in ``path``.

    Raises:
        UserError: it is missing, not JSON, or not an object.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); give a config.json of an earlier run") from error
    except ValueError as error:
        raise UserError(f"{path}: not valid JSON ({error})") from error
    if not isinstance(values, dict):
        raise UserError(f"{path}: must hold a JSON object")
    return values
