"""View of a scene while this process trains it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
import torch

from ..errors import UserError
from ..export.page_data import integers, pack
from ..export.page_scene import (
    PageScene,
    even_times,
    gaussian_columns,
    page_scene,
    pose_columns,
    scene_facts,
    to_array,
    visible,
)
from ..motion.spheres import Spheres
from ..scene.scene import Scene
from ..training.state import TrainState
from .viewer import SceneView

COST = 0.02
"""Largest share of the time that pictures may take while a page is open."""
LEAST_PAUSE = 2.0
"""Seconds between two pictures at least."""
SAMPLES, SPHERE_SAMPLES = 17, 9
"""Number of times at which control points are sampled; an exported page has more."""
SH_DEGREE = 1
"""Largest degree of spherical harmonics of a picture during training."""
COMPRESSION = 1


class TrainingView:
    """Shows a scene between training steps. It reads parameters and changes none, and it does nothing while no page is
    open.

    Args:
        view: server of the page.
        steps: number of steps of the whole training.
        clock: returns seconds.
    """

    def __init__(self, view: SceneView, steps: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._view, self._steps, self._clock = view, steps, clock
        self._next = -math.inf
        view.say("waiting for the first steps")

    def due(self) -> bool:
        """Return whether the state after the next step is to be shown."""
        return self._view.wanted.is_set() and self._clock() >= self._next

    def show(self, state: TrainState) -> None:
        """Publish the present scene."""
        began = self._clock()
        scene = state.scene()
        try:
            content = training_page(scene)
            status = f"step {state.step:,} of {self._steps:,}, {len(state.gaussians):,} Gaussians"
            self._view.publish(pack(content.facts, content.columns, COMPRESSION), status)
        except UserError as error:  # a scene that no page can show is trained all the same
            self._view.say(str(error))
        now = self._clock()
        self._next = now + max(LEAST_PAUSE, (now - began) / COST)


@torch.no_grad()
def training_page(scene: Scene) -> PageScene:
    """Return a coarse page of a scene in training. Each sphere of stage 1 is its own control point."""
    if isinstance(scene.motion, Spheres):
        return _sphere_page(scene, scene.motion)
    training = scene.motion.training
    scene.motion.eval()
    try:
        return page_scene(scene, min(scene.gaussians.sh_degree, SH_DEGREE), SAMPLES)
    finally:
        scene.motion.train(training)


def _sphere_page(scene: Scene, motion: Spheres) -> PageScene:
    gaussians = scene.gaussians
    kept = visible(gaussians)
    if not len(kept):
        raise UserError("web page: no sphere can be seen yet")
    facts = scene_facts(scene, len(kept), 0)
    facts.update(nodes=len(kept), neighbors=1)
    radii = motion.log_radius.expand_as(gaussians.log_scales)
    columns = gaussian_columns(gaussians, kept, 0, radii)
    columns.append(integers("node0", np.arange(len(kept))))
    rest = gaussians.means[kept]
    moves = to_array(motion.translations(rest, even_times(SPHERE_SAMPLES)))
    if not np.isfinite(moves).all():
        raise UserError("web page: the motion is not finite")
    still = np.zeros((*moves.shape[:2], 4))
    still[..., 0] = 1.0
    return PageScene(facts, columns + pose_columns(to_array(rest), {"translation": moves, "rotation": still}, facts))
