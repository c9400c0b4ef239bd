"""Kinematic skeleton of a scene: parts of control points, joined into trees. A frozen value, so that undo covers it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..errors import UserError
from .field_reader import FieldReader, plain_values
from .handles import Vector3

Source = Literal["motion", "geometry", "edited"]
AUTOMATIC = re.compile(r"part-\d+")
"""Names of parts that nobody has named."""

BRANCH_SHARE = 0.5
"""Number of control points of a side branch, relative to the pulled branch, from which on a pull does not pass it. A
hand holds still while one of its fingers is pulled, but a fragment of skin does not stop an arm."""


@dataclass(frozen=True)
class Part:
    """Set of control points that moved together, and its joint with its parent. World units, at time 0."""

    name: str
    nodes: tuple[int, ...]
    """Ascending."""
    parent: str | None
    """None: a root; ``joint`` is then the part's centre."""
    joint: Vector3
    axis: Vector3 | None = None
    """Unit direction about which the motion turned the part most; None if there is no such direction."""
    degrees: float = 0.0
    """Largest turn against the parent between two instants of the motion."""
    confidence: float = 0.0
    """0: the motion never bent the joint, which is put in the middle of the boundary; near 1: the motion shows it."""


@dataclass(frozen=True)
class Skeleton:
    """Parts that together hold every control point once."""

    parts: tuple[Part, ...]
    source: Source = "motion"
    """motion: found in it; geometry: found in the shape, since nothing moved; edited: changed by hand."""

    def part(self, name: str) -> Part:
        """Return the part of that name.

        Raises:
            UserError: there is none.
        """
        for part in self.parts:
            if part.name == name:
                return part
        raise UserError(f"no part is called {name!r}; there is {', '.join(self.names)}")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(part.name for part in self.parts)

    def owners(self) -> np.ndarray:
        """Return the row of the part that holds each control point, [M] int64."""
        owner = np.full(sum(len(part.nodes) for part in self.parts), -1, np.int64)
        for row, part in enumerate(self.parts):
            owner[list(part.nodes)] = row
        return owner

    def children(self, name: str) -> tuple[str, ...]:
        return tuple(part.name for part in self.parts if part.parent == name)

    def branch(self, name: str) -> tuple[str, ...]:
        """Return the part and all parts that hang on it, parents before children."""
        found = [self.part(name).name]
        for item in found:  # the list grows
            found += self.children(item)
        return tuple(found)

    def chain(self, name: str) -> tuple[str, ...]:
        """Return the parts that turn when a part is pulled, from that part towards the root. The first part from which
        another branch of comparable size leaves, and the root, hold still; if the part has no other parent, it turns
        alone."""
        part = self.part(name)
        found = [part.name]
        while part.parent is not None:
            above = self.part(part.parent)
            own = self._size(part.name)
            others = [self._size(child) for child in self.children(above.name) if child != part.name]
            if above.parent is None or max(others, default=0) >= BRANCH_SHARE * own:
                return tuple(found)
            found.append(above.name)
            part = above
        return tuple(found)

    def _size(self, name: str) -> int:
        return sum(len(self.part(item).nodes) for item in self.branch(name))

    # Changes by hand

    def renamed(self, old: str, new: str) -> Skeleton:
        """Return the skeleton with another name for a part.

        Raises:
            UserError: there is no such part, or the new name is taken or not a name.
        """
        FieldReader({"name": new}, "the skeleton").text("name")
        self.part(old)
        if new != old and new in self.names:
            raise UserError(f"part {new!r}: the name is taken; choose another")
        swap = lambda name: new if name == old else name  # noqa: E731
        parts = [dataclasses.replace(p, name=swap(p.name), parent=p.parent and swap(p.parent)) for p in self.parts]
        return Skeleton(tuple(parts), "edited")

    def merged(self, first: str, second: str) -> Skeleton:
        """Return the skeleton with two neighbouring parts united under the first one's name.

        Raises:
            UserError: a part does not exist, or the two have neither a common joint nor a common parent.
        """
        one, other = self.part(first), self.part(second)
        if one.name == other.name:
            raise UserError(f"part {first!r} cannot be merged with itself; name two parts")
        siblings = one.parent == other.parent and one.parent is not None
        if not (siblings or one.parent == other.name or other.parent == one.name):
            raise UserError(f"parts {first!r} and {second!r} are not neighbours; merge the parts between them first")
        upper = other if one.parent == other.name else one
        whole = dataclasses.replace(upper, name=one.name, nodes=tuple(sorted({*one.nodes, *other.nodes})))
        parts = []
        for part in self.parts:
            if part.name == other.name:
                continue
            part = whole if part.name == one.name else part
            parts.append(dataclasses.replace(part, parent=one.name) if part.parent == other.name else part)
        return Skeleton(tuple(parts), "edited")

    def split(
        self, name: str, nodes: Iterable[int], positions: np.ndarray, edges: np.ndarray, new: str | None = None
    ) -> Skeleton:
        """Return the skeleton with some control points of a part as a new part, which hangs on it. The joint is the
        middle of their boundary; children go to the nearer of the two parts.

        Args:
            nodes: control points of the part, neither none nor all of them.
            positions: [M, 3] control points at time 0, world units.
            edges: [E, 2] graph of the control points.
            new: name of the new part; None: the first free ``part-N``.

        Raises:
            UserError: a part or name is wrong, or the control points are not a proper share of the part's.
        """
        part, chosen = self.part(name), sorted({int(node) for node in nodes})
        rest = sorted(set(part.nodes) - set(chosen))
        if not chosen or not rest or len(chosen) + len(rest) != len(part.nodes):
            raise UserError(
                f"part {name!r} cannot be split: choose some but not all of its {len(part.nodes)} control points"
            )
        if new is None:
            new = next(f"part-{i}" for i in range(1, len(self.parts) + 2) if f"part-{i}" not in self.names)
        elif new in self.names:
            raise UserError(f"part {new!r}: the name is taken; choose another")
        FieldReader({"name": new}, "the skeleton").text("name")
        joint = tuple(_middle_of_boundary(positions, edges, chosen, rest).tolist())
        near = lambda point, group: np.linalg.norm(positions[group] - point, axis=1).min()  # noqa: E731
        parts = []
        for other in self.parts:
            if other.name == name:
                other = dataclasses.replace(other, nodes=tuple(rest))
            elif other.parent == name and near(other.joint, chosen) < near(other.joint, rest):
                other = dataclasses.replace(other, parent=new)
            parts.append(other)
        return Skeleton((*parts, Part(new, tuple(chosen), name, joint)), "edited")

    def attached(self, name: str, parent: str | None, positions: np.ndarray, edges: np.ndarray) -> Skeleton:
        """Return the skeleton with a part hanging on another one, at a joint in the middle of their boundary.

        Args:
            parent: None: the part becomes a root.
            positions: [M, 3] control points at time 0, world units.
            edges: [E, 2] graph of the control points.

        Raises:
            UserError: a part does not exist, or the parent hangs on the part.
        """
        part = self.part(name)
        if parent == part.parent:
            return self
        if parent is None:
            joint = positions[list(part.nodes)].mean(0)
        else:
            above = self.part(parent)
            if above.name == name:
                raise UserError(f"part {name!r} cannot hang on itself; name another part, or none")
            if above.name in self.branch(name):
                raise UserError(
                    f"part {name!r} cannot hang on {parent!r}, which hangs on it; attach {parent!r} elsewhere first"
                )
            joint = _middle_of_boundary(positions, edges, list(part.nodes), list(above.nodes))
        moved = Part(name, part.nodes, parent, tuple(joint.tolist()))
        return Skeleton(tuple(moved if other.name == name else other for other in self.parts), "edited")

    def with_joint(self, name: str, joint: Sequence[float], axis: Sequence[float] | None = None) -> Skeleton:
        """Return the skeleton with a part's joint moved.

        Args:
            joint: [3] world units, at time 0.
            axis: [3] of any length but 0; None: as before.

        Raises:
            UserError: there is no such part, or a number is wrong.
        """
        given = {"joint": list(joint), "axis": None if axis is None else list(axis)}
        fields = FieldReader(plain_values(given), f"part {name!r}")
        part = dataclasses.replace(self.part(name), joint=fields.vector("joint", 3), confidence=1.0)
        direction = fields.vector("axis", 3)
        if direction is not None:
            part = dataclasses.replace(part, axis=unit_axis(direction, fields))
        return Skeleton(tuple(part if other.name == name else other for other in self.parts), "edited")


def strongest(labels: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the label with the largest sum of weights in each row, [N]; of equal ones, the first.

    Args:
        labels, weights: [N, K]
    """
    sums = ((labels[:, :, None] == labels[:, None, :]) * weights[:, None, :]).sum(2)
    return labels[np.arange(len(labels)), sums.argmax(1)]


def unit_axis(direction: Vector3, fields: FieldReader) -> Vector3:
    """Return a direction with length 1.

    Raises:
        UserError: it has no direction.
    """
    length = float(np.linalg.norm(direction))
    if not length > 1e-6:
        raise fields.wrong("axis", "has no direction", "give 3 numbers, not all close to 0")
    return direction if abs(length - 1.0) < 1e-12 else tuple((np.array(direction) / length).tolist())


def _middle_of_boundary(positions: np.ndarray, edges: np.ndarray, first: list[int], second: list[int]) -> np.ndarray:
    """Return the mean of the edges between two sets of control points, or else the middle of the nearest pair, [3]."""
    a, b = np.isin(edges, first), np.isin(edges, second)
    across = (a[:, 0] & b[:, 1]) | (a[:, 1] & b[:, 0])
    if across.any():
        return positions[edges[across]].mean((0, 1))
    away = np.linalg.norm(positions[first][:, None] - positions[second][None], axis=2)
    i, j = np.unravel_index(away.argmin(), away.shape)
    return 0.5 * (positions[first[int(i)]] + positions[second[int(j)]])
