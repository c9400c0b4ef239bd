"""Writing of binary glTF 2.0. glTF has y up, so root nodes turn scenes upright."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..edit.rotations import conjugate, multiply, rotate, to_matrix, unit
from ..errors import UserError
from ..storage.files import write_atomically
from .skeleton import Skeleton, continuous

COMPONENTS = {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125}
KINDS = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
VERTICES, INDICES = 34962, 34963
"""Targets of buffer views: vertex attributes and indices."""
MAX_BYTES = 2**32 - 1


class GltfDocument:
    """A glTF file under construction. Callers may edit ``json`` directly; methods that append return the new index."""

    def __init__(self) -> None:
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": f"scgs_warp {__version__}"},
            "scene": 0,
            "scenes": [{"nodes": []}],
        }
        self._parts: list[bytes] = []
        self._size = 0

    def append(self, group: str, item: dict[str, Any]) -> int:
        """Append an item to ``nodes``, ``meshes`` or another list of the file, and return its index."""
        items = self.json.setdefault(group, [])
        items.append(item)
        return len(items) - 1

    def view(self, content: bytes, target: int | None = None) -> int:
        """Append bytes as a buffer view and return its index."""
        item = {"buffer": 0, "byteOffset": self._size, "byteLength": len(content)}
        padding = b"\0" * (-len(content) % 4)
        self._parts += [content, padding]
        self._size += len(content) + len(padding)
        return self.append("bufferViews", item if target is None else {**item, "target": target})

    def accessor(
        self, values: np.ndarray, *, target: int | None = None, bounds: bool = False, normalized: bool = False
    ) -> int:
        """Append an array [N], [N, C] or [N, 4, 4] (column-major) of float32 or unsigned integers; return its index.

        Args:
            target: ``VERTICES``, ``INDICES``, or None for neither.
            bounds: write the smallest and largest values, which positions and animation times require.
            normalized: integers stand for fractions of their largest value.
        """
        values = np.ascontiguousarray(values)
        values = values.astype(values.dtype.newbyteorder("<"), copy=False)
        item = self._item(self.view(values.tobytes(), target), values)
        if bounds:
            low, high = np.atleast_1d(values.min(axis=0)), np.atleast_1d(values.max(axis=0))
            item |= {"min": low.tolist(), "max": high.tolist()}
        return self.append("accessors", {**item, "normalized": True} if normalized else item)

    def tracks(self, values: np.ndarray) -> list[int]:
        """Append M tracks [M, T, C] of float32 in one buffer view; return an accessor for each."""
        values = np.ascontiguousarray(values, "<f4")
        view = self.view(values.tobytes())
        step = values[0].nbytes
        return [
            self.append("accessors", {**self._item(view, track), "byteOffset": index * step})
            for index, track in enumerate(values)
        ]

    @staticmethod
    def _item(view: int, values: np.ndarray) -> dict[str, Any]:
        kind = COMPONENTS[values.dtype.str[1:]]
        return {"bufferView": view, "componentType": kind, "count": len(values), "type": KINDS[values.shape[1:]]}

    def content(self) -> bytes:
        """Return the bytes of the file.

        Raises:
            UserError: the file exceeds the format's limit, or a number is not finite.
        """
        whole = {**self.json, "buffers": [{"byteLength": self._size}]}
        try:
            text = json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()
        except ValueError:
            raise UserError("the .glb would hold numbers that are not finite; train again with a lower rate") from None
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + self._size
        if total > MAX_BYTES:
            size = f"the .glb would have {total / 2**30:.1f} GiB; the format ends at 4"
            raise UserError(f"{size}: give fewer --frames, or a shorter film")
        head = struct.pack("<4sIIII", b"glTF", 2, total, len(text), 0x4E4F534A)
        return b"".join([head, text, struct.pack("<II", self._size, 0x004E4942), *self._parts])

    def write(self, path: Path) -> None:
        """Write the file atomically.

        Raises:
            UserError: the file is too large or cannot be written.
        """
        write_atomically(path, self.content())


def linear_colors(srgb: np.ndarray, opacities: np.ndarray | None = None) -> np.ndarray:
    """Convert sRGB colours [N, 3] to linear ones with opacity (1 by default), [N, 4] uint16."""
    srgb = srgb.clip(0.0, 1.0)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    alpha = np.ones(len(srgb)) if opacities is None else opacities.clip(0.0, 1.0)
    return np.rint(65535 * np.column_stack([linear, alpha])).astype("<u2")


def upright(up: tuple[float, float, float]) -> list[float]:
    """Return the shortest turn from ``up`` to +y as xyzw. If ``up`` is -y, as in OpenCV's convention, it is half a turn
    about x."""
    x, y, z = unit([*up, 0.0])[:3]
    if y < -1.0 + 1e-9:
        return [1.0, 0.0, 0.0, 0.0]
    turn = unit([1.0 + y, -z, 0.0, x])  # the half-way vector between up and y, times y
    return [float(value) for value in turn[[1, 2, 3, 0]]]


def xyzw(quats: np.ndarray) -> np.ndarray:
    """Convert quaternions [..., 4] from wxyz to glTF's order, normalised, float32."""
    return unit(quats)[..., [1, 2, 3, 0]].astype("<f4")


def add_skeleton(
    document: GltfDocument, skeleton: Skeleton, up: tuple[float, float, float], frame: int | None = None
) -> int:
    """Append joints under one root, their animation, and the skin that binds vertices. Joints without names are called
    ``node_0000`` and so on.

    Args:
        frame: frame of the skeleton whose pose the vertices show. None: they are at rest.

    Returns:
        Index of the skin.
    """
    turns, positions = _local_poses(skeleton)
    positions, turns = positions.transpose(1, 0, 2), xyzw(turns.transpose(1, 0, 2))
    count = positions.shape[0]
    names = skeleton.names or tuple(f"node_{index:04d}" for index in range(count))
    parents = skeleton.parents or (-1,) * count
    joints = [
        document.append("nodes", {"name": title, "translation": position[0].tolist(), "rotation": turn[0].tolist()})
        for title, position, turn in zip(names, positions.astype("<f4"), turns)
    ]
    nodes = document.json["nodes"]
    for joint, parent in zip(joints, parents):
        if parent >= 0:
            nodes[joints[parent]].setdefault("children", []).append(joint)
    tops = [joint for joint, parent in zip(joints, parents) if parent < 0]
    title = "control points" if skeleton.names is None else "rig"
    root = document.append("nodes", {"name": title, "rotation": upright(up), "children": tops})
    document.json["scenes"][0]["nodes"].append(root)
    bind = np.tile(np.eye(4), (count, 1, 1))
    if frame is None:
        bind[:, 3, :3] = -skeleton.rest  # column-major
    else:
        bind[:, :3, :3] = to_matrix(skeleton.rotations[frame])  # of the inverse, column-major
        bind[:, 3, :3] = -rotate(conjugate(skeleton.rotations[frame]), skeleton.positions[frame])
    skin = {"inverseBindMatrices": document.accessor(bind.astype("<f4")), "joints": joints, "skeleton": root}
    if len(skeleton.seconds) > 1:
        when = document.accessor(skeleton.seconds.astype("<f4"), bounds=True)
        samplers, channels = [], []
        for path, tracks in (("translation", document.tracks(positions)), ("rotation", document.tracks(turns))):
            for joint, track in zip(joints, tracks):
                channels.append({"sampler": len(samplers), "target": {"node": joint, "path": path}})
                samplers.append({"input": when, "output": track, "interpolation": "LINEAR"})
        document.append("animations", {"name": "motion", "samplers": samplers, "channels": channels})
    return document.append("skins", skin)


def _local_poses(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations [T, M, 4] wxyz and positions [T, M, 3] of joints relative to their parents."""
    turns, positions = skeleton.rotations, skeleton.positions
    if skeleton.parents is None:
        return turns, positions
    above = np.array(skeleton.parents)
    held = np.flatnonzero(above >= 0)
    above, turns, positions = above[held], turns.copy(), positions.copy()
    back = conjugate(skeleton.rotations[:, above])
    turns[:, held] = multiply(back, skeleton.rotations[:, held])
    positions[:, held] = rotate(back, skeleton.positions[:, held] - skeleton.positions[:, above])
    return continuous(turns), positions


def influences(indices: np.ndarray, weights: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Split influences into sets of joints [N, 4] uint16 and weights [N, 4] float32, largest first; rows sum to 1."""
    order = np.argsort(-weights, axis=1, kind="stable")
    joints, shares = np.take_along_axis(indices, order, 1), np.take_along_axis(weights, order, 1)
    shares = np.where(shares < 1e-8, 0.0, shares).astype(np.float32)
    shares[:, 0] += 1.0 - shares.sum(axis=1, dtype=np.float64)  # the remainder of rounding
    width = -shares.shape[1] % 4
    joints = np.where(shares > 0, joints, 0)  # the format requires joint 0 where the weight is 0
    joints, shares = np.pad(joints, ((0, 0), (0, width))), np.pad(shares, ((0, 0), (0, width)))
    sets = range(0, joints.shape[1], 4)
    return [(joints[:, first : first + 4].astype("<u2"), shares[:, first : first + 4]) for first in sets]
