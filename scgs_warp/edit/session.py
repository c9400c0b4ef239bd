"""Editing session: a scene, its edit and the history, for editors, scripts and notebooks."""

from __future__ import annotations

import copy
import dataclasses
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
from ..ops.shapes import given_number, given_whole
from ..rendering.render import render
from ..runtime.caller_settings import unaffected_methods
from ..scene.arguments import clamped_time, given_camera, given_color, given_scalar
from ..scene.scene import Scene
from ..storage.files import write_atomically
from ..storage.output_folders import make_parent
from ..types import Camera, Gaussians, Image
from . import edit_file
from .document import Edit, given_edit
from .engine import Engine
from .field_reader import point_of
from .graph import ControlGraph, chosen_nodes
from .handles import STAY, Handle, Target
from .keyframes import Easing, Keyframe
from .pose import NodePose
from .posing import Posing
from .rotations import IDENTITY, conjugate, mean, multiply
from .skeleton import Skeleton

HISTORY = 1000
"""Number of steps that can be undone, so that a session which is open for days does not grow without limit."""


@unaffected_methods
class EditSession(Posing):
    """A scene, its graph of control points, an :class:`Edit`, and the last thousand edits for undo.

    All points, cameras and lengths are in world units; ``time`` is scene time in [0, 1]; ``at`` is a moment of the film
    in seconds, at which keyframes place the handles. If it is None, handles are at their present targets.

    Every change of the edit can be undone; a drag counts as one change from its first ``drag`` to ``release``. Results
    depend on the edit alone, except those with ``live=True``, which are previews during a drag. ``frame`` is the
    largest distance from a handle's time, in scene time, at which a one-frame edit still shows; None: as in the edit's
    film.

    Attributes: ``scene``, ``graph``, ``edit`` (replace it with :meth:`apply`).
    """

    def __init__(self, scene: Scene, edit: Edit | None = None) -> None:
        self.engine = Engine(scene)
        self.scene: Scene = self.engine.scene
        self.graph: ControlGraph = self.engine.graph
        self.edit = Edit() if edit is None else given_edit(edit, len(self))
        self._past: deque[Edit] = deque(maxlen=HISTORY)
        self._future: list[Edit] = []
        self._before_drag: Edit | None = None
        self._found: dict[int | None, Skeleton] = {}
        """Skeletons by their number of parts; None: that of the run."""

    def __len__(self) -> int:
        """Return the number of control points."""
        return len(self.graph)

    def fork(self) -> EditSession:
        """Return another session on the same scene, with this one's edit but without its history. The two share scene,
        graph and caches, and so must not compute at the same time."""
        other = copy.copy(self)
        other._past, other._future, other._before_drag = deque(maxlen=HISTORY), [], None
        return other

    def drawn_with(self, scene: Scene) -> EditSession:
        """Return a session with this one's control points, parts and edit that poses the Gaussians of another scene of
        the same motion. Exports use it for the plain Gaussians that stand for sharp ones: these have other opacities,
        which would lead to other parts and neighbours."""
        other = self.fork()
        other.engine, other.scene = self.engine.drawn_with(scene), scene
        return other

    # The edit and its history

    def apply(self, edit: Edit) -> None:
        """Replace the edit; undo restores the previous one.

        Raises:
            UserError: it is no edit, or names a control point that does not exist.
        """
        edit = given_edit(edit, len(self))
        self.release()
        if edit != self.edit:
            self._past.append(self.edit)
            self._future.clear()
            self.edit = edit

    @property
    def can_undo(self) -> bool:
        return bool(self._past) or self._before_drag is not None

    @property
    def can_redo(self) -> bool:
        return bool(self._future)

    def undo(self) -> bool:
        """Return to the previous edit; return False if there is none."""
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
        """Remove the whole edit but for the film's settings."""
        self.apply(Edit(film=self.edit.film))

    def _change(self, **changes: Any) -> None:
        self.apply(dataclasses.replace(self.edit, **changes))

    # Choosing control points

    def node_positions(
        self, time: float, at: float | None = None, *, live: bool = False, frame: float | None = None
    ) -> np.ndarray:
        """Return the edited control points, [M, 3], world units."""
        bent = self._bend(time, at, live, frame)
        positions = self.engine.motion_at(clamped_time(time)).positions if bent is None else bent.positions
        return self.engine.to_world(positions)

    def nearest(self, point: Sequence[float], time: float, at: float | None = None) -> int:
        """Return the edited control point nearest to a point."""
        away = np.linalg.norm(self.node_positions(time, at) - point_of("point", point), axis=1)
        return int(away.argmin())

    def ring(self, nodes: Iterable[int], count: int = 1) -> tuple[int, ...]:
        """Return the nodes and all nodes at most ``count`` edges away from them."""
        return self.graph.ring(self._nodes(nodes), given_whole("count", count))

    def within(self, point: Sequence[float], radius: float, time: float, at: float | None = None) -> tuple[int, ...]:
        """Return the control points within ``radius`` of a point."""
        away = np.linalg.norm(self.node_positions(time, at) - point_of("point", point), axis=1)
        return tuple(np.flatnonzero(away <= given_number("radius", radius)).tolist())

    def pick(self, camera: Camera, x: float, y: float, time: float, at: float | None = None) -> np.ndarray | None:
        """Return the surface point seen at a pixel, [3], world units; None where the background shows."""
        camera, x, y = given_camera(camera), *(given_scalar("a pixel", value, "a number") for value in (x, y))
        image = self.render(camera, time, at)
        column, row = int(math.floor(x)), int(math.floor(y))
        if not (0 <= column < camera.width and 0 <= row < camera.height) or float(image.alpha[row, column]) < 0.5:
            return None
        K, viewmat = camera.K.double().cpu().numpy(), camera.viewmat.double().cpu().numpy()
        ray = np.array([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], 1.0])
        return viewmat[:3, :3].T @ (float(image.depth[row, column]) * ray - viewmat[:3, 3])

    def _nodes(self, nodes: Iterable[int]) -> tuple[int, ...]:
        return chosen_nodes(nodes, len(self))

    # Handles and pins

    def add_handle(self, nodes: Iterable[int], time: float, name: str | None = None, **fields: Any) -> Handle:
        """Add a handle on some control points; ``fields`` as in :class:`Handle`. It replaces a handle of the same name,
        whose target and keyframes are removed.

        Raises:
            UserError: there is no node, a node does not exist, or a field is out of range.
        """
        if fields.get("part") is not None:
            raise UserError(f"a handle of part {fields['part']!r}: take pose_part, which gives it the part's skeleton")
        chosen = self._nodes(nodes)
        if not chosen:
            raise UserError("a handle needs at least one control point; choose some first")
        taken = {handle.name for handle in self.edit.handles}
        if name is None:
            name = next(f"handle {i}" for i in range(1, len(taken) + 2) if f"handle {i}" not in taken)
        handle = Handle(name=name, nodes=chosen, time=given_scalar("time", time, "a number from 0 to 1"), **fields)
        edit = self.edit.without(name)
        self.apply(dataclasses.replace(edit, handles=(*edit.handles, handle)))
        return handle

    def remove_handle(self, name: str) -> None:
        """Remove a handle, its target, and its part in every keyframe."""
        self.apply(self.edit.without(self._handle(name).name))

    def rename_handle(self, old: str, new: str) -> None:
        """Rename a handle, also in targets and keyframes.

        Raises:
            UserError: there is no such handle, or the new name is taken or not a name.
        """
        if self._handle(old).name != new and self.edit.handle(new) is not None:
            raise UserError(f"handle {new!r}: the name is taken; choose another")
        self.apply(self.edit.with_name(old, new))

    def pivot(self, name: str) -> np.ndarray:
        """Return a handle's centre of rotation at its own time, [3], world units. That of a part is its joint in the
        present pose of its parent."""
        handle = self._handle(name)
        if handle.part is not None:
            return self.joint_of(handle.part, handle.time)
        if handle.pivot is not None:
            return np.array(handle.pivot)
        positions = self.engine.base_at(self.edit, handle.time).positions
        return self.engine.to_world(positions[list(handle.nodes)].mean(0))

    def rotation_of(self, name: str, time: float, at: float | None = None, *, live: bool = False) -> np.ndarray:
        """Return how far a handle's control points are turned at a scene time, [4] wxyz, relative to the motion. For a
        handle that moves as a free body this is what the solver found."""
        nodes = list(self._handle(name).nodes)
        bent = self._bend(time, at, live)
        if bent is None:
            return IDENTITY.copy()
        base = self.engine.base_at(self.edit, clamped_time(time))
        return mean(multiply(bent.turns[nodes], conjugate(base.turns[nodes]))[:, None])[0]

    def pin(self, nodes: Iterable[int]) -> None:
        """Pin nodes, so that they follow the motion alone."""
        self._change(pins=tuple(sorted({*self.edit.pins, *self._nodes(nodes)})))

    def unpin(self, nodes: Iterable[int] | None = None) -> None:
        """Unpin nodes; None: all of them."""
        gone = set(self.edit.pins) if nodes is None else set(self._nodes(nodes))
        self._change(pins=tuple(node for node in self.edit.pins if node not in gone))

    def pin_rest(self, rings: int = 2) -> None:
        """Pin every control point that is more than ``rings`` edges away from all handles."""
        held = {node for handle in self.edit.handles for node in handle.nodes}
        self._change(pins=self.graph.beyond(held, given_whole("rings", rings)))

    def _handle(self, name: str) -> Handle:
        handle = self.edit.handle(name)
        if handle is None:
            known = ", ".join(repr(handle.name) for handle in self.edit.handles) or "none"
            raise UserError(f"no handle is called {name!r}; there is {known}")
        return handle

    # Moving

    def drag(
        self, name: str, translation: Sequence[float] | None = None, rotation: Sequence[float] | None = None
    ) -> Target:
        """Set a handle's target: turn it by ``rotation`` (wxyz) about its pivot, then shift it, both relative to the
        motion. An argument that is None leaves that part of the target unchanged. Nothing is solved until a result is
        requested.

        Raises:
            UserError: there is no such handle, or a number is not finite; the edit stays unchanged.
        """
        self._handle(name)
        old = self.edit.targets.get(name, STAY)
        target = Target.of(
            old.translation if translation is None else translation, old.rotation if rotation is None else rotation
        )
        self.preview(dataclasses.replace(self.edit, targets={**self.edit.targets, name: target}))
        return target

    def preview(self, edit: Edit) -> None:
        """Replace the edit as part of a drag; ``release`` makes the whole drag one step for undo."""
        edit = given_edit(edit, len(self))
        if self._before_drag is None:
            self._before_drag = self.edit
        self.edit = edit

    def release(self) -> None:
        """End the drag, which becomes one step for undo."""
        before, self._before_drag = self._before_drag, None
        if before is not None and before != self.edit:
            self._past.append(before)
            self._future.clear()

    def cancel(self) -> None:
        """Abandon the drag and restore the edit before it."""
        before, self._before_drag = self._before_drag, None
        self.edit = self.edit if before is None else before

    def move(
        self, name: str, translation: Sequence[float] | None = None, rotation: Sequence[float] | None = None
    ) -> Target:
        """Drag a handle and release it."""
        self.release()
        target = self.drag(name, translation, rotation)
        self.release()
        return target

    # Keyframes

    def add_keyframe(self, at: float, easing: Easing = "smooth") -> Keyframe:
        """Store the present targets of all handles at a moment of the film; replace a keyframe that is already there.

        Raises:
            UserError: there is no handle, or ``at`` or ``easing`` is out of range.
        """
        names = [handle.name for handle in self.edit.handles]
        if not names:
            raise UserError("a keyframe needs a handle; take hold of some control points first")
        frame = Keyframe(at, {name: self.edit.targets.get(name, STAY) for name in names}, easing)
        others = [other for other in self.edit.keyframes if other.at != frame.at]
        self._change(keyframes=tuple(sorted([*others, frame], key=lambda f: f.at)))
        return frame

    def remove_keyframe(self, at: float) -> None:
        self._change(keyframes=tuple(frame for frame in self.edit.keyframes if frame.at != at))

    def show_keyframes(self, at: float) -> None:
        """Set the handles' present targets to those of the keyframes at a moment of the film."""
        self._change(targets=self.engine.targets(self.edit, at))

    # Results

    def resize_film(self, size: int) -> None:
        """Set the longer side of the film in pixels.

        Raises:
            UserError: the size is out of range.
        """
        self._change(film=dataclasses.replace(self.edit.film, size=size))

    def scene_time(self, at: float) -> float:
        """Return the scene time that a moment of the film shows."""
        return self.edit.playback.time_at(given_scalar("at", at, "seconds of the film"), self.edit.film.seconds)

    def _bend(self, time: float, at: float | None, live: bool, frame: float | None = None) -> NodePose | None:
        time, at = clamped_time(time), None if at is None else given_scalar("at", at, "seconds of the film")
        frame = self.edit.reach if frame is None else given_number("frame", frame)
        if live and at is None:
            return self.engine.bend_live(self.edit, time, frame=frame)
        return self.engine.bend(self.edit, time, at, frame=frame)

    def gaussians_at(
        self, time: float, at: float | None = None, *, live: bool = False, frame: float | None = None
    ) -> Gaussians:
        """Return activated Gaussians under the edit, world units; bit-identical to the scene's if the edit changes
        nothing."""
        bent = self._bend(time, at, live, frame)
        return self.engine.gaussians(clamped_time(time), bent)

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
        """Render the edited scene; bit-identical to ``Scene.render`` if the edit changes nothing."""
        bent, time = self._bend(time, at, live, frame), clamped_time(time)
        scene = self.scene
        if bent is None:
            return scene.render(camera, time, background)  # type: ignore[arg-type]
        color = given_color(scene.background_color if background is None else background)
        view = scene.normalisation.apply_camera(given_camera(camera)).to(scene.device)
        posed = self.engine.normalised(time, bent)
        drawn = posed, view, color.to(scene.device)
        return render(*drawn, antialiased=scene.config.antialiased, depth_unit=scene.normalisation.scale)

    # Files

    def save(self, path: str | Path) -> None:
        """Write the edit as JSON that loads as the same edit; missing folders are made. Saving does not end a drag.

        Raises:
            UserError: the file cannot be written, or the edit has a field that no file may hold.
        """
        edit_file.checked(self.edit, self.engine)
        make_parent(Path(path))
        write_atomically(Path(path), edit_file.to_json(self.edit, self.engine).encode())

    def load(self, path: str | Path) -> None:
        """Replace the edit with the one in a file, as a step that can be undone. If the file names parts but holds no
        skeleton, the names refer to the present skeleton.

        Raises:
            UserError: the file is missing, or a field is wrong; the edit stays unchanged.
        """
        self.apply(edit_file.read(Path(path), self.engine, lambda: self.skeleton))

    def export_ply(self, path: str | Path, time: float, at: float | None = None) -> None:
        """Write the edited Gaussians at one moment as a 3D-GS file, world units."""
        write_gaussian_ply(path, self.gaussians_at(time, at), antialiased=self.scene.config.antialiased)
