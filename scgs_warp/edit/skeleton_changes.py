"""The skeleton of a session: found in the motion or read from the run, and changed by hand."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from ..config.bounds import MOST_NODES
from ..errors import UserError
from . import edit_file, skeleton_file
from .document import Edit
from .engine import Engine
from .field_reader import FieldReader, plain_values
from .graph import chosen_nodes
from .skeleton import Part, Skeleton
from .skeleton_from_motion import find_skeleton


class SkeletonChanges:
    """Base of :class:`EditSession` that holds its skeleton. Points are in world units."""

    engine: Engine
    edit: Edit
    _found: dict[int | None, Skeleton]
    apply: Callable[[Edit], None]

    @property
    def skeleton(self) -> Skeleton:
        """The edit's skeleton, or else that of the run, which is found in the motion once and kept in its folder."""
        return self.edit.skeleton or self._run_skeleton()

    def _run_skeleton(self) -> Skeleton:
        found = self._found.get(None)
        if found is None:
            path, scene = self._skeleton_path(), edit_file.scene_of(self.engine)
            found = skeleton_file.read(path, scene) if path is not None and path.is_file() else None
            if found is None:
                found = self._find(None)
                with contextlib.suppress(UserError):  # a folder that nobody may write to is read only
                    if path is not None:
                        skeleton_file.replace(path, found, scene)
            self._found[None] = found
        return found

    def _find(self, count: int | None) -> Skeleton:
        indices, weights = (part.cpu().numpy() for part in self.engine.binding)
        return find_skeleton(self.engine.scene, (indices, weights), count)

    def _skeleton_path(self) -> Path | None:
        folder = self.engine.scene.folder
        return None if folder is None else folder / skeleton_file.FILE

    def parts(self, count: int | None = None) -> tuple[Part, ...]:
        """Return the parts that moved rigidly together over the trained motion, with their joints.

        Args:
            count: number of parts; more if the scene falls into more pieces, fewer if the motion tells fewer apart.
                None: the parts of the edit's skeleton, or else of the run's, whose number follows from the motion.

        Raises:
            UserError: the count is no whole number above 0.
        """
        if count is None:
            return self.skeleton.parts
        FieldReader(plain_values({"count": count}), "parts").integer("count", 1, 1, MOST_NODES)
        if count not in self._found:
            self._found[count] = self._find(count)
        return self._found[count].parts

    def use_parts(self, count: int | None = None) -> None:
        """Replace the edit's skeleton by one of ``count`` parts, as for :meth:`parts`; None: by that of the run.
        Handles of parts are removed."""
        if count is not None:
            self.parts(count)
        edit = self.edit
        for handle in self.edit.handles:
            edit = edit if handle.part is None else edit.without(handle.name)
        self.apply(dataclasses.replace(edit, skeleton=None if count is None else self._found[count]))

    def save_skeleton(self) -> Path:
        """Write the present skeleton into the run folder, where it is the default of every later session.

        Raises:
            UserError: the scene has no folder, or the file cannot be written.
        """
        path = self._skeleton_path()
        if path is None:
            raise UserError("the scene comes from no run folder; save the edit, which holds its skeleton")
        skeleton_file.replace(path, self.skeleton, edit_file.scene_of(self.engine))
        self._found[None] = self.skeleton
        return path

    def rename_part(self, old: str, new: str) -> None:
        """Rename a part, also in the handles that pose it and are called after it."""
        self._restructure(self.skeleton.renamed(old, new), {old: new})

    def merge_parts(self, first: str, second: str) -> None:
        """Unite two neighbouring parts under the first one's name. The united part turns as the one nearer to the root
        did (as the first one, if both hang on the same part); a handle of the other one is removed."""
        below = self.skeleton.part(first).parent == second
        self._restructure(
            self.skeleton.merged(first, second), {first: None, second: first} if below else {second: None}
        )

    def split_part(self, name: str, nodes: Iterable[int], new: str | None = None) -> str:
        """Make some control points of a part a part of their own, which hangs on it; return its name."""
        start = self.engine.to_world(self.engine.motion_at(0.0).positions)
        skeleton = self.skeleton.split(name, chosen_nodes(nodes, len(start)), start, self.engine.graph.edges, new)
        self._restructure(skeleton, {})
        return skeleton.parts[-1].name

    def move_joint(self, name: str, joint: Sequence[float], axis: Sequence[float] | None = None) -> None:
        """Move the joint of a part with its parent to a point at time 0."""
        self._restructure(self.skeleton.with_joint(name, joint, axis), {})

    def attach_part(self, name: str, parent: str | None) -> None:
        """Make a part hang on another one; None: on none, as a root. The joint is then the middle of the boundary of
        the two parts, or lies between their nearest control points, and :meth:`move_joint` corrects it. What hangs on
        the part comes with it, and its turns are kept: they then count from the new parent, about the new joint."""
        start = self.engine.to_world(self.engine.motion_at(0.0).positions)
        self._restructure(self.skeleton.attached(name, parent, start, self.engine.graph.edges), {})

    def _restructure(self, skeleton: Skeleton, renamed: dict[str, str | None]) -> None:
        """Replace the skeleton and adapt handles: ``renamed`` maps parts to their new names, None: gone."""
        edit, handles = dataclasses.replace(self.edit, skeleton=skeleton), []
        for handle in edit.handles:
            if handle.part is not None:
                part = renamed.get(handle.part, handle.part)
                if part is None:
                    edit = edit.without(handle.name)
                    continue
                handle = dataclasses.replace(handle, part=part, nodes=skeleton.part(part).nodes)
            handles.append(handle)
        edit = dataclasses.replace(edit, handles=tuple(handles))
        for old, new in renamed.items():
            edit = edit if new is None else edit.named_after(new, old)
        self.apply(edit)
