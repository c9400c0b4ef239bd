"""Moments of an animation, and the Gaussians of a scene at one of them."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from ..edit import EditSession
from ..scene.scene import Scene
from ..types import Gaussians


class AnimationMoment(NamedTuple):
    """Times of one frame of an animation."""

    seconds: float
    """Time since the animation's beginning."""
    time: float
    """Scene time in [0, 1]."""
    at: float | None = None
    """Time in an edit's film in seconds."""


def even_moments(frames: int, fps: float) -> list[AnimationMoment]:
    """Return moments spaced evenly from scene time 0 to 1."""
    return [AnimationMoment(frame / fps, frame / max(frames - 1, 1)) for frame in range(frames)]


def film_moments(session: EditSession) -> list[AnimationMoment]:
    """Return the moments of all frames of an edit's film."""
    film = session.edit.film
    seconds = np.arange(film.frames) / film.fps
    times = session.edit.playback.times_at(seconds, film.seconds)
    return [AnimationMoment(at, time, at) for at, time in zip(seconds.tolist(), times.tolist())]


def posed_gaussians(scene: Scene, session: EditSession | None, moment: AnimationMoment) -> Gaussians:
    """Return activated Gaussians, world units, with the session's edit applied if there is a session."""
    if session is None:
        return scene.gaussians_at(moment.time)
    return session.gaussians_at(moment.time, moment.at)


@torch.no_grad()
def at_rest(scene: Scene) -> Gaussians:
    """Return activated Gaussians before any motion, world units."""
    rest, undo = scene.gaussians.activate(), scene.normalisation
    return replace(rest, means=undo.undo(rest.means), scales=undo.undo_scale(rest.scales))
