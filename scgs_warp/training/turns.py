"""Turns of round bodies, added to the motion once the Gaussians show their shapes.

Stage 1 and the first steps of the main stage place a ball, but leave its turns out (``turn_search``). These are found
from the shape and the training views; the network then learns to carry the body's Gaussians through them, and the
Gaussians get the colours that the views show where they now are.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import cv2
import numpy as np
import torch
from torch import Tensor

from ..data.dataset import Dataset
from ..gaussians import SH_C0, GaussianParameters
from ..motion import ControlPoints
from ..optim import Adam, log_linear
from ..seeding import Purpose, generator
from .frames import Frames
from .round_bodies import RoundBody, find_round_bodies
from .second_try import shown_psnr
from .state import TrainState
from .step import training_step
from .turn_search import LONG, Surface, Turns, find_turns
from .turn_views import Views

FIRST_RESET = 2
"""Opacity reset from which on shapes are good enough; turns are found in the step before each reset."""
SOLID = 0.5
"""Opacity from which a Gaussian shows a surface, if enough have it."""
SHARE = 0.6
"""Share of the Gaussians that is at least taken for solid."""
WIDEST = 256
"""Width in pixels to which larger images are reduced for the comparison."""
BLUR = 1.0
"""Standard deviation of the blur of compared images, pixels."""
STEPS = 2500
"""Number of steps in which the network learns the turns."""
RATE, RATE_END = 1e-3, 1e-4
"""Learning rate of the network at the first and the last of them."""
TELL_EVERY = 25
"""Number of these and of trial steps from one line of progress to the next."""
MOST_INSTANTS, MOST_PLACES = 500, 50_000_000
"""Largest number of instants, and of places of Gaussians over all of them, with which turns are looked for, so that
views and tracks fit into memory."""
TRIAL = 1.0 / 3.0
"""Length of the trial that turns must pass, in periods of opacity resets. It is not part of the training."""
MOST_LOSS = 0.5
"""PSNR of the training views in dB that turns may still cost after the trial: what had adapted to the motion without
them for thousands of steps must adapt again. Wrong turns cost more."""
TURNED, OTHERS = 2000, 1000
"""Largest numbers of Gaussians of turning bodies, and of others, that the network learns to carry."""


def turns_due(state: TrainState, data: Dataset) -> bool:
    """Return whether turns are looked for before the next step: in cut-out subjects whose motion began with stage 1,
    seen at enough instants, once shapes are good."""
    config, after = state.config, state.stage_step + 1
    every = config.densify.opacity_reset_every
    if state.stage != "main" or after % every or not FIRST_RESET * every <= after <= config.densify.until:
        return False
    able = config.motion.turns and isinstance(state.motion, ControlPoints) and config.pretrain_steps > 0
    alone = state.group is None and state.exposure_optimizer is None and config.optim.cameras == 0
    instants = len(data.times.unique())
    fits = LONG <= instants <= MOST_INSTANTS and instants * len(state.gaussians) <= MOST_PLACES
    return able and alone and fits and after > config.freeze and bool(data.with_alpha)


def add_turns(state: TrainState, frames: Frames, tell: Callable[[str], None] = lambda text: None) -> str | None:
    """Add the turns of round bodies to the motion; a state without any stays as it is.

    Args:
        state: in the main stage.
        tell: gets what is being done, from time to time.

    Returns:
        What was found, in one line; None if no body turns.

    Raises:
        UserError: an image is no longer readable.
    """
    data = frames.data
    times = data.times.double().unique()
    opacities = state.gaussians.opacities().detach().cpu()
    solid = (opacities >= min(SOLID, float(opacities.quantile(1.0 - SHARE)))).numpy()
    tracks = _tracks(state, times)
    views = _views(state, data, times)
    found: list[tuple[RoundBody, Turns]] = []
    for body in find_round_bodies(tracks, solid, views):
        tell("looking")
        turns = find_turns(body, views)
        if turns is not None:
            found.append((body, turns))
    if not found:
        return None
    for body, turns in found:
        offsets = tracks[:, body.members] - body.centres[:, None]
        turned = np.einsum("tij,tnj->tni", turns.rotations, offsets) + body.centres[:, None]
        tracks[:, body.members] = turned.astype(np.float32)
    turned_state = _copied(state)
    turning = np.concatenate([body.members for body, _ in found])
    _follow(turned_state, torch.from_numpy(tracks), times, torch.from_numpy(turning), tell)
    _recolor(turned_state.gaussians, tracks, views, [body for body, _ in found])
    if _psnr_later(turned_state, frames, tell) < shown_psnr(state, data) - MOST_LOSS:
        return None
    state.enter(turned_state.gaussians, turned_state.motion)
    bodies = "1 round body turns" if len(found) == 1 else f"{len(found)} round bodies turn"
    return f"{bodies} by {_fastest(found):.0f} degrees per frame at most, which outlines do not show"


def _copied(state: TrainState) -> TrainState:
    """Return a state with copies of the models, and fresh optimisers and statistics."""
    made = copy.copy(state)
    made.enter(copy.deepcopy(state.gaussians), copy.deepcopy(state.motion))
    return made


def _psnr_later(state: TrainState, frames: Frames, tell: Callable[[str], None]) -> float:
    """Return the PSNR of the training views after some more steps, which the state does not keep."""
    trial, steps = _copied(state), round(TRIAL * state.config.densify.opacity_reset_every)
    for step in range(steps):
        if step % TELL_EVERY == 0:
            tell(f"trial {step:,}/{steps:,}")
        training_step(trial, frames)
        trial.step += 1
    return shown_psnr(trial, frames.data)


def _fastest(found: list[tuple[RoundBody, Turns]]) -> float:
    """Return the largest turn between two instants, degrees."""
    steps = [turns.rotations[1:] @ turns.rotations[:-1].transpose(0, 2, 1) for _, turns in found]
    cosines = (np.trace(np.concatenate(steps), axis1=1, axis2=2) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).max())


@torch.no_grad()
def _tracks(state: TrainState, times: Tensor) -> np.ndarray:
    """Return the means at each time, [T, N, 3] float32, normalised."""
    state.motion.eval()
    posed = [state.motion.gaussians_at(state.gaussians, float(time)).means.cpu() for time in times]
    state.motion.train()
    return torch.stack(posed).numpy()


@torch.no_grad()
def _views(state: TrainState, data: Dataset, times: Tensor) -> Views:
    """Read the training views and render their depth."""
    order = data.times.double().sort(stable=True).indices.tolist()
    scene, background = state.scene(), data.background_color.numpy()
    scene.motion.eval()
    viewmats, intrinsics, colors, depths = [], [], [], []
    for index in order:
        frame = data[index]
        assert frame.alpha is not None
        camera = state.normalisation.apply_camera(frame.camera)
        share = min(1.0, WIDEST / camera.width)
        size = max(1, round(camera.width * share)), max(1, round(camera.height * share))
        alpha = frame.alpha.numpy()[..., None]
        own = cv2.resize(frame.image.numpy() - (1.0 - alpha) * background, size, interpolation=cv2.INTER_AREA)
        covered = cv2.resize(alpha, size, interpolation=cv2.INTER_AREA)
        own, covered = cv2.GaussianBlur(own, (0, 0), BLUR), cv2.GaussianBlur(covered, (0, 0), BLUR)
        colors.append(own / np.maximum(covered, 0.05)[..., None])
        drawn = scene.render(frame.camera, frame.time)
        depth = np.where(drawn.alpha.cpu().numpy() > 0.5, drawn.depth.cpu().numpy(), np.inf)
        depth = cv2.resize(depth.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
        depths.append(depth * state.normalisation.scale)
        scaling = np.diag([size[0] / camera.width, size[1] / camera.height, 1.0])
        intrinsics.append(scaling @ camera.K.double().numpy())
        viewmats.append(camera.viewmat.double().numpy())
    scene.motion.train()
    instants = torch.searchsorted(times, data.times.double()[order]).numpy()
    return Views(instants, np.stack(viewmats), np.stack(intrinsics), colors, depths)


def _follow(state: TrainState, tracks: Tensor, times: Tensor, turning: Tensor, tell: Callable[[str], None]) -> None:
    """Train the network of a state to carry Gaussians along tracks [T, N, 3], in place."""
    motion, device = state.motion, state.device
    assert isinstance(motion, ControlPoints)
    random = generator(state.config.seed, Purpose.TURNS)
    others = torch.ones(tracks.shape[1], dtype=torch.bool)
    others[turning] = False
    still = torch.where(others)[0]
    chosen = [some[torch.randperm(len(some), generator=random)] for some in (turning, still)]
    count = min(TURNED, len(turning))
    index = torch.cat([chosen[0][:TURNED], chosen[1][:OTHERS]])
    few, tracks = _subset(state.gaussians, index.to(device)), tracks[:, index].to(device)
    size = float((tracks[0, :count] - tracks[0, :count].mean(0)).square().sum(1).mean().sqrt())
    network = dict(motion.network.named_parameters())
    optimizer = Adam(network, dict.fromkeys(network, RATE))
    for step in range(STEPS):
        if step % TELL_EVERY == 0:
            tell(f"learnt {step:,}/{STEPS:,}")
        for group in optimizer.groups.values():
            group.rate = log_linear(RATE, RATE_END, step, STEPS)
        instant = int(torch.randint(len(times), (1,), generator=random))
        pose = motion.poses(times[instant].float().view(1))[0]
        apart = (motion.bind_and_pose(few, pose, frozen=True).means - tracks[instant]).square().sum(1) / size**2
        loss = apart[:count].mean() + (apart[count:].mean() if len(still) else 0.0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    optimizer.zero_grad()
    motion.graph = None


@torch.no_grad()
def _subset(gaussians: GaussianParameters, index: Tensor) -> GaussianParameters:
    """Copy some of the Gaussians; the copies get no gradients."""
    hyper, rest = gaussians.hyper.shape[1], gaussians.sh_rest.shape[1]
    shaded, corrected = gaussians.shading.shape[1] > 0, gaussians.correctives.shape[1] > 0
    made = GaussianParameters.empty(len(index), rest, hyper, shaded, corrected, index.device, gaussians.sharpness)
    for name in GaussianParameters.NAMES:
        getattr(made, name).copy_(getattr(gaussians, name)[index])
    return made.requires_grad_(False)


@torch.no_grad()
def _recolor(gaussians: GaussianParameters, tracks: np.ndarray, views: Views, bodies: list[RoundBody]) -> None:
    """Give the Gaussians of bodies the mean colours that the views show where they are along ``tracks``."""
    for body in bodies:
        surface = Surface(body, views, tracks[:, body.members] - body.centres[:, None])
        weights, colors = np.zeros(len(body.members)), np.zeros((len(body.members), 3))
        for view in range(len(views.instants)):
            weight, color = surface.seen(view, np.eye(3)[None])
            weights, colors = weights + weight[0], colors + weight[0][:, None] * color[0]
        seen = weights > 0
        chosen = torch.from_numpy(body.members[seen]).to(gaussians.means.device)
        mean = torch.from_numpy((colors[seen] / weights[seen, None] - 0.5) / SH_C0)
        gaussians.sh_dc[chosen] = mean.float().to(chosen.device)
        everywhere = torch.from_numpy(body.members).to(chosen.device)
        for of_turns in (gaussians.sh_rest, gaussians.shading, gaussians.correctives):
            of_turns[everywhere] = 0.0
