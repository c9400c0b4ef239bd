"""Meshes from a scene to a file: the surface at a moment, and the motion of its vertices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ...edit import EditSession
from ...runtime.progress import progress
from ...scene.scene import Scene
from ...types import Gaussians
from ..finite import finite_rows
from ..moments import AnimationMoment
from ..skeleton import Skeleton, build_skeleton
from .binding import SAMPLES, bind, clearest_frame, posed, sample_frames
from .cleaning import clean
from .colors import VIEWS as COLOR_VIEWS
from .colors import PosedMesh, paint
from .decimation import decimate
from .files import write_mesh
from .surface import OPAQUE, RESOLUTION, VIEWS, Surface, locate, reconstruct
from .views import Surroundings, surroundings_of

FACES = 100_000
"""Largest number of triangles; colours are those of vertices, which therefore are many."""
PAINTED_FRAMES = 8
"""Number of frames of a moving mesh over which its colours are averaged."""


@dataclass(frozen=True)
class MeshSettings:
    """Size of a mesh."""

    faces: int = FACES
    resolution: int = RESOLUTION


class _Shape(NamedTuple):
    surface: Surface
    """In normalised units."""
    surroundings: Surroundings


class MeshJob:
    """A scene whose surface is to be written, and the edit applied to it."""

    def __init__(self, scene: Scene, session: EditSession | None, settings: MeshSettings) -> None:
        self.scene, self.session, self.settings = scene, session, settings

    def write_still(self, path: Path, moment: AnimationMoment) -> str:
        """Write the surface at a moment; return a description.

        Raises:
            UserError: there is no surface, or the file cannot be written.
        """
        gaussians = self._posed(moment)
        with progress(VIEWS + COLOR_VIEWS, "mesh") as shown:
            surface, surroundings = self._shape(gaussians, shown.advance)
            moments = [lambda: PosedMesh(surface.vertices, gaussians)]
            colors = paint(surroundings, moments, surface.faces, shown.advance)
        made = self._to_world(surface)
        write_mesh(path, made, colors, self.scene.overview.up, closed=surroundings.closed)
        return _described(made, surroundings)

    def write_moving(self, path: Path, moments: list[AnimationMoment]) -> str:
        """Write the surface and its motion as an animated .glb whose triangles stay the same; return a description.

        Raises:
            UserError: there is no surface, the motion is not finite, or the file cannot be written.
        """
        assert self.session is not None
        with progress(len(moments) + VIEWS + COLOR_VIEWS, "mesh") as shown:
            skeleton = build_skeleton(self.session, moments, shown.advance)
            frame = clearest_frame(skeleton)
            surface, surroundings = self._shape(self._posed(moments[frame]), shown.advance)
            made = self._to_world(surface)
            bound = self._bound(made, moments, frame, skeleton)

            def posed_at(at: int) -> PosedMesh:
                moved = posed(made.vertices, bound, frame, at)
                return PosedMesh(self._to_normalised(moved), self._posed(moments[at]))

            painted = [partial(posed_at, int(at)) for at in sample_frames(len(moments), PAINTED_FRAMES)]
            colors = paint(surroundings, painted, made.faces, shown.advance)
        up, closed = self.scene.overview.up, surroundings.closed
        write_mesh(path, made, colors, up, closed=closed, skeleton=bound, frame=frame)
        joints = f"moved by {len(skeleton.rest)} control points at {len(moments)} instants"
        return f"{_described(made, surroundings)}, {joints}"

    def _shape(self, gaussians: Gaussians, advance: Callable[[], None]) -> _Shape:
        surroundings = surroundings_of(self.scene, gaussians)
        region = locate(surroundings, gaussians)
        surface = reconstruct(surroundings, gaussians, region, self.settings.resolution, advance)
        return _Shape(decimate(clean(surface, surroundings.closed), self.settings.faces), surroundings)

    def _bound(self, surface: Surface, moments: list[AnimationMoment], frame: int, skeleton: Skeleton) -> Skeleton:
        """Return the skeleton with the binding of a mesh, world units, that shows ``frame``."""
        frames = [frame, *sample_frames(len(moments), SAMPLES).tolist()]
        gaussians = [self._all_posed(moments[at]) for at in frames]
        rows = finite_rows(gaussians[0]) & (gaussians[0].opacities > OPAQUE).cpu().numpy()
        tracks = np.stack([self.scene.normalisation.undo(moved.means.double()).cpu().numpy() for moved in gaussians])
        rows &= np.isfinite(tracks).all(axis=(0, 2))
        return bind(surface, tracks[:, rows], skeleton.select(rows))

    @torch.no_grad()
    def _all_posed(self, moment: AnimationMoment) -> Gaussians:
        """Return posed Gaussians in normalised units."""
        if self.session is None:
            return self.scene.motion.gaussians_at(self.scene.gaussians, moment.time)
        engine, edit = self.session.engine, self.session.edit
        return engine.normalised(moment.time, engine.bend(edit, moment.time, moment.at, frame=edit.reach))

    def _posed(self, moment: AnimationMoment) -> Gaussians:
        """Return the finite ones of the posed Gaussians, in normalised units."""
        gaussians = self._all_posed(moment)
        rows = torch.from_numpy(finite_rows(gaussians)).to(gaussians.means.device)
        return replace(gaussians, **{name: value.detach()[rows] for name, value in gaussians.tensors().items()})

    def _to_world(self, surface: Surface) -> Surface:
        unit = self.scene.normalisation
        return Surface(surface.vertices / unit.scale + unit.centre, surface.faces)

    def _to_normalised(self, vertices: np.ndarray) -> np.ndarray:
        unit = self.scene.normalisation
        return (vertices - unit.centre) * unit.scale


def _described(surface: Surface, surroundings: Surroundings) -> str:
    kind = "closed" if surroundings.closed else "open"
    return f"{kind} mesh of {len(surface.faces):,} triangles"
