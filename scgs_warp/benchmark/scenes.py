"""Synthetic scenes to measure: a seeded figure of any size under any motion model, its camera and training images."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from ..config.presets import MotionConfig, OptimConfig, TrainConfig
from ..data.dataset import Dataset
from ..errors import UserError
from ..gaussians import SH_C0, GaussianParameters, neighbor_distance
from ..geometry.cameras import Overview, orbit_camera
from ..geometry.normalisation import Normalisation
from ..kernels import benchmark as kernels
from ..motion import ControlPoints, HexPlane, PerGaussian, build_motion
from ..motion.base import Motion
from ..motion.network import DeformationNetwork, encode, rows_of
from ..ops.binning import bin_splats
from ..ops.projection import project
from ..ops.sampling import farthest_points
from ..runtime.environment import one_piece
from ..runtime.launch import launch
from ..scene.scene import Scene
from ..seeding import generator
from ..training.state import TrainState
from ..types import Camera, Frame, Gaussians

SEED = 20
SMALLEST_SIDE, LARGEST_SIDE = 16, 8192
"""Bounds for the sides of an image, pixels."""
PARTS = (  # centre, half axes, share of the Gaussians
    ((0.0, 0.0, 0.30), (0.36, 0.25, 0.50), 0.40),  # trunk
    ((0.0, 0.0, 1.00), (0.19, 0.21, 0.23), 0.14),  # head
    ((0.50, 0.0, 0.42), (0.27, 0.12, 0.13), 0.09),  # arms
    ((-0.50, 0.0, 0.42), (0.27, 0.12, 0.13), 0.09),
    ((0.19, 0.0, -0.66), (0.15, 0.16, 0.57), 0.14),  # legs
    ((-0.19, 0.0, -0.66), (0.15, 0.16, 0.57), 0.14),
)
SHELL = 0.35
"""Thickness of the shell of Gaussians, as a share of a part's half axes; trained Gaussians also lie below the
surface."""
SIZE = 2.0
"""Median scale of N Gaussians times sqrt(N), so that the area they cover does not depend on N."""
SIZE_SPREAD = 0.5
"""Standard deviation of the logarithm of a scale."""
OPACITY_POWER = 0.45
"""Exponent of uniform random numbers, from which opacities between ``OPACITIES`` are made."""
OPACITIES = (0.02, 0.95)
OVERVIEW = Overview((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 4.0311, math.degrees(0.6911), 15.0, 60.0)
"""Distance and field of view of D-NeRF's cameras."""
MOTION = 1e-2
"""Standard deviation of the network's outputs: control points move by some hundredths of the figure's height."""
ZEROS = 0.8
"""Share of hidden values that the ReLU sets to zero, as in trained networks (``benchmarks/network_zeros.py``)."""
SAMPLES = 512
"""Number of positions at which the network is evaluated to set that share."""
TIMES = 5
PLANE_HEAD_WEIGHT = 5e-2
"""Standard deviation of the last layer's weights in the small network of ``hexplane``, whose features are small."""
HYPER_SPREAD = 0.02
FRAMES = 4
RATES = 1e-6
"""Factor on learning rates, so small that the scene hardly changes from step to step while Adam does all its work."""


def figure(count: int, seed: int = SEED, motion: MotionConfig | None = None) -> GaussianParameters:
    """Make ``count`` Gaussians in the shape of a standing figure, 2.5 units high, determined by the arguments.

    They have the hyper-coordinates, the shading and the correctives that ``motion`` asks for.
    """
    random = generator(seed, 1)
    centres, axes, shares = (torch.tensor(column) for column in zip(*PARTS))
    part = torch.multinomial(shares, count, replacement=True, generator=random)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=1)
    depth = 1.0 - SHELL * torch.rand(count, 1, generator=random)
    means = centres[part] + axes[part] * direction * depth
    log_scales = math.log(SIZE / math.sqrt(count)) + SIZE_SPREAD * torch.randn(count, 3, generator=random)
    colors = (0.5 + 0.4 * torch.sin(5.0 * means + torch.tensor([0.0, 2.0, 4.0]))).clamp(0.0, 1.0)
    own = motion or MotionConfig(shading=False, correctives=False)
    made = GaussianParameters(
        means,
        log_scales,
        (colors - 0.5) / SH_C0,
        hyper_columns=own.hyper_columns,
        shaded=own.has_shading,
        corrected=own.has_correctives,
    )
    low, high = OPACITIES
    opacities = low + (high - low) * torch.rand(count, generator=random) ** OPACITY_POWER
    with torch.no_grad():
        made.quats.copy_(torch.randn(count, 4, generator=random))
        made.opacity_logits.copy_(opacities.logit())
        made.sh_rest.copy_(0.05 * torch.randn(made.sh_rest.shape, generator=random))
        made.hyper.add_(HYPER_SPREAD * torch.randn(made.hyper.shape, generator=random))
        made.shading.copy_(0.1 * torch.randn(made.shading.shape, generator=random))
        made.correctives.copy_(0.1 * torch.randn(made.correctives.shape, generator=random))
    return made


@torch.no_grad()
def _let_move(network: DeformationNetwork, positions: Tensor, random: torch.Generator) -> None:
    """Give a network, which starts at rest, a small motion, and the share of zeros that trained networks have."""
    times = torch.linspace(0.0, 1.0, TIMES)[:, None]
    inputs = rows_of(encode(positions, network.position_frequencies), encode(times, network.time_frequencies))
    hidden = inputs
    with one_piece():
        for index, layer in enumerate(network.layers):
            if index == network.skip:
                hidden = torch.cat([inputs, hidden], dim=-1)
            values = layer(hidden)
            level = values.flatten().kthvalue(round(ZEROS * values.numel())).values
            layer.bias -= level
            hidden = (values - level).relu()
        weight = torch.randn(network.head.weight.shape, generator=random)
        network.head.weight.copy_(weight * (MOTION / (hidden @ weight.T).std()))


def _loosen(motion: Motion, positions: Tensor, seed: int) -> None:
    """Let a model move, which starts at rest."""
    random = generator(seed, 2)
    if isinstance(motion, ControlPoints | PerGaussian) and isinstance(motion.network, DeformationNetwork):
        _let_move(motion.network, positions[:SAMPLES], random)
    if isinstance(motion, HexPlane):
        with torch.no_grad():
            for head in motion.heads.values():
                weight = head[-1].weight  # type: ignore[index]
                weight.copy_(PLANE_HEAD_WEIGHT * torch.randn(weight.shape, generator=random))
            for plane in motion.planes:
                plane.mul_(0.5 + torch.rand(plane.shape, generator=random))


def synthetic_scene(motion: str, count: int, nodes: int, device: str, seed: int = SEED) -> Scene:
    """Make a moving figure as a trained scene: ``count`` Gaussians, ``nodes`` control points (control-points only),
    networks of the paper's size."""
    config = TrainConfig(seed=seed)
    config = dataclasses.replace(config, motion=dataclasses.replace(config.motion, model=motion, nodes=nodes))
    gaussians = figure(count, seed, config.motion)
    model = build_motion(motion, config)
    if isinstance(model, ControlPoints):
        positions = gaussians.means.detach()[farthest_points(gaussians.means.detach(), nodes)]
        with torch.no_grad():
            model.positions.copy_(positions)
            model.hyper.add_(HYPER_SPREAD * torch.randn(model.hyper.shape, generator=generator(seed, 3)))
            model.log_radii.fill_(math.log(float(neighbor_distance(positions).median())))
    _loosen(model, model.positions if isinstance(model, ControlPoints) else gaussians.means, seed)
    scene = Scene(gaussians.to(device), model.to(device), Normalisation.identity(), config, OVERVIEW)
    scene.motion.eval()  # Loaded scenes are in evaluation mode, too, where some models cache.
    scene.freeze_binding()
    return scene


Size = int | tuple[int, int]
"""The longer side of an image with the scene's proportions, or (width, height)."""


def camera_size(text: str) -> Size:
    """Parse ``"800"`` or ``"1920x1080"``.

    Raises:
        UserError: the text is neither, or a side is not one of ``SMALLEST_SIDE`` to ``LARGEST_SIDE`` pixels.
    """
    sides = text.lower().split("x")
    if not (1 <= len(sides) <= 2 and all(side.isascii() and side.isdigit() for side in sides)):
        raise UserError(f"--size {text}: give the longer side, such as 800, or width and height, such as 1920x1080")
    numbers = [int(side) for side in sides]
    if not all(SMALLEST_SIDE <= number <= LARGEST_SIDE for number in numbers):
        raise UserError(f"--size {text}: give {SMALLEST_SIDE} to {LARGEST_SIDE} pixels a side")
    return numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])


def scene_camera(scene: Scene, size: Size, turn: float = 0.0) -> Camera:
    """Place a camera, in world units, on the rig of the training cameras, ``turn`` degrees from where a film starts.

    Its horizontal field of view is that of the training cameras, whatever the proportions of the image.
    """
    azimuth = scene.overview.azimuth + turn
    if isinstance(size, int):
        return orbit_camera(scene.overview, azimuth, size).to(scene.device)
    width, height = size
    placed = orbit_camera(scene.overview, azimuth, width)
    focal = width / (2 * math.tan(math.radians(scene.overview.fov_x) / 2))
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(placed.viewmat, K, width, height).to(scene.device)


class Load(NamedTuple):
    """Amount of compositing that an image takes."""

    pairs: int
    """Number of pairs of splat and tile."""
    contributors: float
    """Mean number of splats blended into a covered pixel: those with an alpha of at least 1/255, before the pixel's
    compositing ends."""
    covered: int = 0
    """Number of pixels into which at least one splat is blended."""


@torch.no_grad()
def load_of(gaussians: Gaussians, camera: Camera, antialiased: bool = False) -> Load:
    """Count the compositing work of an image exactly, pixel by pixel; the camera is in the units of the Gaussians."""
    geometry = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    view = camera.viewmat, camera.K, camera.width, camera.height
    splats = project(*geometry, *view, antialiased=antialiased, sharpness=gaussians.sharpness)
    tiles = bin_splats(splats)
    counts = torch.empty(camera.height * camera.width, dtype=torch.int32, device=splats.depths.device)
    tensors = [splats.means2d, splats.conics, splats.opacities, tiles.ranges, tiles.splats]
    lists = [tensor.contiguous() for tensor in tensors]
    grid = camera.width, tiles.columns, splats.sharpness, tiles.tile_size
    launch(kernels.count_contributors, len(counts), *lists, *grid, counts)
    covered = counts > 0
    mean = float(counts[covered].double().mean()) if bool(covered.any()) else 0.0
    return Load(len(tiles.splats), mean, int(covered.sum()))


def training_data(scene: Scene, size: Size) -> Dataset:
    """Render images of the scene from several sides and add noise, so that the gradient of the loss reaches all
    parameters."""
    frames = []
    for index in range(FRAMES):
        time = index / max(FRAMES - 1, 1)
        camera = scene_camera(scene, size, 30.0 * index)
        image = scene.render(camera, time)
        planar = image.rgb.permute(2, 0, 1).cpu()
        noise = 0.05 * torch.randn(planar.shape, generator=generator(SEED, 3, index))
        planar = (planar + noise * (image.alpha.cpu() > 0)).clamp(0.0, 1.0)
        frames.append(Frame(camera.to("cpu"), time, planar.permute(1, 2, 0), name=f"{index}"))
    return Dataset(frames, folder=Path("synthetic"), split="train", background=_background(scene))


def _background(scene: Scene) -> str:
    """Return the scene's background, or black for a random one, which would need images with alpha."""
    return "black" if scene.config.data.background == "random" else scene.config.data.background


def training_state(scene: Scene, arap: bool) -> TrainState:
    """Put the scene into the main stage of training: full harmonics, densification statistics, rates near 0.

    With ``arap`` every step has the ARAP term (in training every fifth has it), since a median over steps with and
    without the term would show neither kind. The scene's motion stays in training mode.
    """
    own = scene.config
    base = TrainConfig(
        seed=own.seed, data=own.data, motion=own.motion, antialiased=own.antialiased, sharpness=own.sharpness
    )
    rates = OptimConfig()
    slow = {
        item.name: RATES * getattr(rates, item.name)
        for item in dataclasses.fields(rates)
        if isinstance(getattr(rates, item.name), float)
    }
    loss = dataclasses.replace(base.loss, arap_every=1) if arap else dataclasses.replace(base.loss, arap=0.0)
    config = dataclasses.replace(base, optim=dataclasses.replace(rates, **slow), loss=loss)
    step = config.pretrain_steps + max(config.rest_steps, 3 * config.densify.sh_every)
    scene.motion.train()
    nothing: Tensor = torch.zeros(0, 3)
    rest = (scene.normalisation, scene.overview, 1.0, nothing, nothing)
    return TrainState(config, scene.gaussians, scene.motion, *rest, stage="main", fingerprint="", step=step)
