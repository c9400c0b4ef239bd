"""A scene under edit: what an editor, a script or a notebook holds on to."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
from collections import deque
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import UserError
from ..formats.gaussian_ply import write_gaussian_ply
from ..rendering.render import render
from ..scene.scene import Scene
from ..storage.files import write_atomically
from ..types import Camera, Gaussians, Image
from . import edit_file
from .document import Edit
from .engine import Engine
from .graph import ControlGraph
from .handles import STAY, Handle, Target
from .keyframes import Easing, Keyframe
from .pose import NodePose

HISTORY = 1000
"""Steps that can be undone: a session that is open for days must not grow for ever."""


class EditSession:
    """A scene, its graph of control points, an :class:`Edit`, and the thousand edits before it.

    All points, cameras and lengths are in world units; ``time`` is the scene's, in [0, 1]; ``at`` is a moment of the
    film in seconds, which decides what keyframes say; without it handles are where they are now.

    Whatever changes the edit can be undone; a drag counts as one change from its first ``drag`` to ``release``.
    Results depend on the edit alone, but for those with ``live=True``: they are for the eye while something is dragged.
    ``frame`` is how far from its time an edit of one frame shows; None: as far as in the edit's film.

    Attributes: ``scene``, ``graph``, ``edit`` (replace it with :meth:`apply`).
    """

    def __init__(self, scene: Scene, edit: Edit | None = None) -> None:
        self.engine = Engine(scene)
        self.scene: Scene = self.engine.scene
        self.graph: ControlGraph = self.engine.graph
        self.edit = edit or Edit()
        self._past: deque[Edit] = deque(maxlen=HISTORY)
        self._future: list[Edit] = []
        self._before_drag: Edit | None = None

    def __len__(self) -> int:
        """Number of control points."""
        return len(self.graph)

    def fork(self) -> EditSession:
        """Another session on the same scene that begins with this one's edit and without its history. Scene, graph and
        solutions are shared, not copied: the two may not compute at the same time."""
        other = copy.copy(self)
        other._past, other._future, other._before_drag = deque(maxlen=HISTORY), [], None
        return other

    # The edit and its history

    def apply(self, edit: Edit) -> None:
        """Make ``edit`` the present one; undo leads back."""
        self.release()
        if edit != self.edit:
            self._past.append(self.edit)
            self._future.clear()
            self.edit = edit

    def undo(self) -> bool:
        """False if there was nothing to undo."""
        self.release()
        if not self._past:
            return False
        self._future.append(self.edit)
        self.edit = self._past.pop()
        return True

    def redo(self) -> bool:
        self.release()
        if not self._future:
            return False
        self._past.append(self.edit)
        self.edit = self._future.pop()
        return True

    def reset(self) -> None:
        """No edit; the film's settings stay."""
        self.apply(Edit(film=self.edit.film))

    def _change(self, **changes: Any) -> None:
        self.apply(dataclasses.replace(self.edit, **changes))

    # Choosing control points

    def node_positions(
        self, time: float, at: float | None = None, *, live: bool = False, frame: float | None = None
    ) -> np.ndarray:
        """[M, 3] edited control points, world."""
        bent = self._bend(time, at, live, frame)
        time = min(max(float(time), 0.0), 1.0)
        positions = self.engine.motion_at(time).positions if bent is None else bent.positions
        return self.engine.to_world(positions)

    def nearest(self, point: Sequence[float], time: float, at: float | None = None) -> int:
        """The edited control point nearest to a point."""
        return int(np.linalg.norm(self.node_positions(time, at) - np.asarray(point, np.float64), axis=1).argmin())

    def ring(self, nodes: Iterable[int], count: int = 1) -> tuple[int, ...]:
        """The nodes and all that are at most ``count`` edges away."""
        return self.graph.ring(self._nodes(nodes), count)

    def within(self, point: Sequence[float], radius: float, time: float, at: float | None = None) -> tuple[int, ...]:
        """Control points in a ball: a brush."""
        away = np.linalg.norm(self.node_positions(time, at) - np.asarray(point, np.float64), axis=1)
        return tuple(np.flatnonzero(away <= radius).tolist())

    def pick(self, camera: Camera, x: float, y: float, time: float, at: float | None = None) -> np.ndarray | None:
        """[3] the surface point seen at a pixel, world; None where there is none."""
        image = self.render(camera, time, at)
        column, row = int(math.floor(x)), int(math.floor(y))
        if not (0 <= column < camera.width and 0 <= row < camera.height) or float(image.alpha[row, column]) < 0.5:
            return None
        K, viewmat = camera.K.double().cpu().numpy(), camera.viewmat.double().cpu().numpy()
        ray = np.array([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], 1.0])
        return viewmat[:3, :3].T @ (float(image.depth[row, column]) * ray - viewmat[:3, 3])

    def _nodes(self, nodes: Iterable[int]) -> tuple[int, ...]:
        found = tuple(sorted({int(node) for node in nodes}))
        if found and not (found[0] >= 0 and found[-1] < len(self)):
            raise UserError(
                f"control point {found[0] if found[0] < 0 else found[-1]}: there are {len(self)}, from 0 on"
            )
        return found

    # Handles and pins

    def add_handle(self, nodes: Iterable[int], time: float, name: str | None = None, **fields: Any) -> Handle:
        """Take hold of some control points; ``fields`` as in :class:`Handle`. A name that is taken is taken over,
        without its target and its part in keyframes.

        Raises:
            UserError: no node, or one that does not exist, or a field that makes no sense.
        """
        chosen = self._nodes(nodes)
        if not chosen:
            raise UserError("a handle needs at least one control point; choose some first")
        taken = {handle.name for handle in self.edit.handles}
        if name is None:
            name = next(f"handle {i}" for i in range(1, len(taken) + 2) if f"handle {i}" not in taken)
        handle = Handle(name=name, nodes=chosen, time=float(time), **fields)
        edit_file.check_handle(handle, len(self))
        edit = self._without(name)
        self.apply(dataclasses.replace(edit, handles=(*edit.handles, handle)))
        return handle

    def remove_handle(self, name: str) -> None:
        """With its target and its part in every keyframe."""
        self.apply(self._without(self._handle(name).name))

    def _without(self, name: str) -> Edit:
        """The edit without a handle of that name."""
        frames = []
        for frame in self.edit.keyframes:
            rest = {n: t for n, t in frame.targets.items() if n != name}
            frames += [dataclasses.replace(frame, targets=rest)] if rest or not frame.targets else []
        targets = {n: t for n, t in self.edit.targets.items() if n != name}
        handles = tuple(h for h in self.edit.handles if h.name != name)
        return dataclasses.replace(self.edit, handles=handles, targets=targets, keyframes=tuple(frames))

    def pivot(self, name: str) -> np.ndarray:
        """[3] what a handle turns about, world, at its own time."""
        handle = self._handle(name)
        if handle.pivot is not None:
            return np.array(handle.pivot)
        positions = self.engine.base_at(self.edit, handle.time).positions
        return self.engine.to_world(positions[list(handle.nodes)].mean(0))

    def pin(self, nodes: Iterable[int]) -> None:
        """These stay with the motion from now on."""
        self._change(pins=tuple(sorted({*self.edit.pins, *self._nodes(nodes)})))

    def unpin(self, nodes: Iterable[int] | None = None) -> None:
        """None: all of them."""
        gone = set(self.edit.pins) if nodes is None else set(self._nodes(nodes))
        self._change(pins=tuple(node for node in self.edit.pins if node not in gone))

    def pin_rest(self, rings: int = 2) -> None:
        """Pin everything more than ``rings`` edges away from any handle."""
        held = {node for handle in self.edit.handles for node in handle.nodes}
        self._change(pins=self.graph.beyond(held, rings))

    def _handle(self, name: str) -> Handle:
        found = self.edit.handle(name)
        if found is None:
            known = ", ".join(repr(handle.name) for handle in self.edit.handles) or "none"
            raise UserError(f"no handle is called {name!r}; there is {known}")
        return found

    # Moving

    def drag(
        self, name: str, translation: Sequence[float] | None = None, rotation: Sequence[float] | None = None
    ) -> Target:
        """Put a handle somewhere: turned by ``rotation`` (wxyz) about its pivot, then shifted, both from where the
        motion has it. What is None stays. Cheap: nothing is solved until somebody asks.

        Raises:
            UserError: there is no such handle, or a number is not finite; the edit is as before.
        """
        self._handle(name)
        old = self.edit.targets.get(name, STAY)
        target = Target.of(
            old.translation if translation is None else translation, old.rotation if rotation is None else rotation
        )
        self.preview(dataclasses.replace(self.edit, targets={**self.edit.targets, name: target}))
        return target

    def preview(self, edit: Edit) -> None:
        """Make ``edit`` the present one as part of a drag: ``release`` makes one step of it all."""
        if self._before_drag is None:
            self._before_drag = self.edit
        self.edit = edit

    def release(self) -> None:
        """The drag is over: one step for undo."""
        before, self._before_drag = self._before_drag, None
        if before is not None and before != self.edit:
            self._past.append(before)
            self._future.clear()

    def cancel(self) -> None:
        """The drag has not been: the edit is what it was before."""
        before, self._before_drag = self._before_drag, None
        self.edit = self.edit if before is None else before

    def move(
        self, name: str, translation: Sequence[float] | None = None, rotation: Sequence[float] | None = None
    ) -> Target:
        """A drag and its release in one."""
        self.release()
        target = self.drag(name, translation, rotation)
        self.release()
        return target

    # Keyframes

    def add_keyframe(self, at: float, easing: Easing = "smooth") -> Keyframe:
        """Keep where all handles are now, for a moment of the film; one that is there already is replaced."""
        edit_file.check_keyframe(at, easing)
        names = [handle.name for handle in self.edit.handles]
        if not names:
            raise UserError("a keyframe needs a handle; take hold of some control points first")
        frame = Keyframe(float(at), {name: self.edit.targets.get(name, STAY) for name in names}, easing)
        others = [other for other in self.edit.keyframes if other.at != frame.at]
        self._change(keyframes=tuple(sorted([*others, frame], key=lambda f: f.at)))
        return frame

    def remove_keyframe(self, at: float) -> None:
        self._change(keyframes=tuple(frame for frame in self.edit.keyframes if frame.at != at))

    def show_keyframes(self, at: float) -> None:
        """Put handles where keyframes have them at a moment of the film, to go on from there."""
        self._change(targets=self.engine.targets(self.edit, at))

    # Results

    def resize_film(self, size: int) -> None:
        """Longer side of the film in pixels.

        Raises:
            UserError: no film is that small or large.
        """
        edit_file.check_size(size)
        self._change(film=dataclasses.replace(self.edit.film, size=size))

    def scene_time(self, at: float) -> float:
        """The moment of the motion that a moment of the film shows."""
        return self.edit.playback.time_at(at, self.edit.film.seconds)

    def _bend(self, time: float, at: float | None, live: bool, frame: float | None = None) -> NodePose | None:
        if not (math.isfinite(time) and (at is None or math.isfinite(at))):
            raise UserError(f"time {time}, at {at}: give finite numbers")
        time = min(max(float(time), 0.0), 1.0)
        frame = self.edit.reach if frame is None else frame
        if live and at is None:
            return self.engine.bend_live(self.edit, time, frame=frame)
        return self.engine.bend(self.edit, time, at, frame=frame)

    def gaussians_at(
        self, time: float, at: float | None = None, *, live: bool = False, frame: float | None = None
    ) -> Gaussians:
        """Activated Gaussians under the edit, world units; the scene's own bits where the edit changes nothing."""
        bent = self._bend(time, at, live, frame)
        return self.engine.gaussians(min(max(float(time), 0.0), 1.0), bent)

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        time: float,
        at: float | None = None,
        background: Sequence[float] | Tensor | None = None,
        *,
        live: bool = False,
        frame: float | None = None,
    ) -> Image:
        """The edited scene, as ``Scene.render`` shows the scene; its very bits where the edit changes nothing."""
        bent = self._bend(time, at, live, frame)
        time = min(max(float(time), 0.0), 1.0)
        scene = self.scene
        if bent is None:
            return scene.render(camera, time, background)  # type: ignore[arg-type]
        color = torch.as_tensor(scene.background_color if background is None else background, dtype=torch.float32)
        view = scene.normalisation.apply_camera(camera).to(scene.device)
        posed = self.engine.normalised(time, bent)
        image = render(posed, view, color.to(scene.device), antialiased=scene.config.antialiased)
        return Image(image.rgb, image.alpha, scene.normalisation.undo_scale(image.depth))

    # Files

    def save(self, path: str | Path) -> None:
        """As JSON; loading it gives the same edit. A drag goes on.

        Raises:
            UserError: the place cannot be written, or the edit holds something that no file may say.
        """
        text = edit_file.to_json(self.edit, self)
        edit_file.parse(json.loads(text), "the edit", self)
        write_atomically(Path(path), text.encode())

    def load(self, path: str | Path) -> None:
        """The edit in a file; can be undone.

        Raises:
            UserError: the file is missing or wrong, with the field; the edit is as before.
        """
        self.apply(edit_file.read(Path(path), self))

    def export_ply(self, path: str | Path, time: float, at: float | None = None) -> None:
        """The edited Gaussians at one moment as a 3D-GS file, world units."""
        write_gaussian_ply(path, self.gaussians_at(time, at))
