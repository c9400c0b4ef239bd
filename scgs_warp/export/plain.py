"""Gaussians in place of sharp ones, fitted to look alike, for the formats that hold Gaussians only."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import cycle, islice
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ..geometry.cameras import SWING_SHARE, Overview, orbit_camera
from ..ops.activations import exponential
from ..ops.ssim import photometric_loss
from ..optim import Adam, log_linear
from ..rendering.render import draw
from ..runtime.environment import one_piece
from ..runtime.progress import progress
from ..scene.scene import Scene
from ..types import Camera, Gaussians, plain_scale

STEPS, VIEWS = 240, 40
"""Number of steps and of views."""
USUAL_SIZE, LARGEST_SIZE = 400, 800
"""Longer side of the views in pixels, where that of the training images is not known, and at most. The fit holds for
one size, because the low-pass filter of rendering widens small splats by a constant number of pixels."""
RATES = {"log_scales": 0.02, "opacity_logits": 0.05, "sh_dc": 5e-3}
"""Learning rates of the changes; over the second half they fall to ``SETTLED`` of this."""
SETTLED = 0.05
GOLDEN, SILVER = (math.sqrt(5.0) - 1.0) / 2.0, math.sqrt(2.0) - 1.0
"""Multiples of either number, modulo 1, fill an interval evenly. Azimuths follow the one and times the other, so that
they are not tied to each other."""
ELEVATIONS = (-15.0, 10.0, 35.0)
"""Elevations of the views in degrees, relative to the training cameras' median."""


class _View(NamedTuple):
    camera: Camera
    """In normalised units."""
    time: float
    truth: Tensor
    """[3, H, W]"""


def at_once(action: Callable[[], Any]) -> Any:
    """Call a function and return its result."""
    return action()


def pieces_of(scene: Scene) -> int:
    """Return the number of calls by ``plain_scene`` of its ``compute``."""
    return 0 if scene.gaussians.sharpness == 0.0 else VIEWS + STEPS


def plain_scene(scene: Scene, compute: Callable[[Callable[[], Any]], Any] = at_once) -> Scene:
    """Return a scene of sharpness 0 that looks like ``scene``; a scene that has no sharpness is returned unchanged.

    Scales, opacities and base colours are fitted to images of ``scene`` from around and at different times, beginning
    with ``Gaussians.plain``. The result is bit-identical for the same scene. Gaussians that no view shows, and those
    whose fit is not finite, stay as ``Gaussians.plain`` makes them.

    Args:
        compute: calls a function and returns its result, so that another thread may compute.
    """
    gaussians, motion = scene.gaussians, scene.motion
    if gaussians.sharpness == 0.0:
        return scene
    scene.freeze_binding()
    views = [compute(functools.partial(_view, scene, index)) for index in range(VIEWS)]
    background = torch.tensor(scene.background_color, device=scene.device)
    start = math.log(plain_scale(gaussians.sharpness))
    changes = {
        "log_scales": nn.Parameter(torch.full_like(gaussians.log_scales, start)),
        "opacity_logits": nn.Parameter(torch.zeros_like(gaussians.opacity_logits)),
        "sh_dc": nn.Parameter(torch.zeros_like(gaussians.sh_dc)),
    }
    optimizer = Adam(changes, RATES)

    def learn(step: int, view: _View) -> None:
        with torch.no_grad():
            posed = motion.gaussians_at(gaussians, view.time)
        changed = _changed(posed, gaussians.opacity_logits.detach(), changes)
        image, _ = draw(changed, view.camera, background, antialiased=scene.config.antialiased)
        photometric_loss(image, view.truth)[0].backward()
        for name, group in optimizer.groups.items():
            group.rate = RATES[name] * log_linear(1.0, SETTLED, max(0, 2 * step - STEPS), STEPS)
        optimizer.step()
        optimizer.zero_grad()

    with progress(STEPS, "fitting Gaussians") as shown:
        for step, view in enumerate(islice(cycle(views), STEPS)):
            compute(functools.partial(learn, step, view))
            shown.advance()
    made = copy.deepcopy(gaussians)
    made.sharpness = 0.0
    with torch.no_grad():
        for name, change in changes.items():
            usual = start if name == "log_scales" else 0.0
            getattr(made, name).add_(torch.where(change.isfinite(), change, usual))
    return Scene(
        made, motion, scene.normalisation, replace(scene.config, sharpness=0.0), scene.overview, step=scene.step,
        settings=scene.settings,
    )  # fmt: skip


def _view(scene: Scene, index: int) -> _View:
    overview = scene.overview
    size = min(round(overview.longer_side) or USUAL_SIZE, LARGEST_SIZE)
    time = (0.5 + SILVER * index) % 1.0
    camera = orbit_camera(overview, view_azimuth(overview, index), size, overview.elevation + ELEVATIONS[index % 3])
    view = scene.normalisation.apply_camera(camera).to(scene.device)
    background = torch.tensor(scene.background_color, device=scene.device)
    with torch.no_grad():
        posed = scene.motion.gaussians_at(scene.gaussians, time)
        truth, _ = draw(posed, view, background, antialiased=scene.config.antialiased)
    return _View(view, time, truth)


def view_azimuth(overview: Overview, index: int) -> float:
    """Return the azimuth of a view in degrees; over all views they fill the orbit, or the observed arc, evenly."""
    share = (GOLDEN * index) % 1.0
    if overview.sweep >= 360.0:
        return overview.azimuth + 360.0 * share
    return overview.azimuth + SWING_SHARE * overview.sweep * (share - 0.5)


def _changed(posed: Gaussians, opacity_logits: Tensor, changes: dict[str, nn.Parameter]) -> Gaussians:
    with one_piece():
        opacities = (opacity_logits + changes["opacity_logits"]).sigmoid()
    scales = posed.scales * exponential(changes["log_scales"])
    return replace(posed, scales=scales, opacities=opacities, sh_dc=posed.sh_dc + changes["sh_dc"], sharpness=0.0)
