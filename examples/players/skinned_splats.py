"""Gaussians of a skinned .glb at any second of its animation, with NumPy alone, for players inside other programs.

`apps/export.py --output scene.glb` writes such files, with control points or (`--skeleton parts`) with parts as joints.
World axes are glTF's: y up, right-handed. Rotations are quaternions w, x, y, z.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

EXTENSION = "KHR_gaussian_splatting"
KINDS = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
SH_C0 = 0.28209479177387814


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    scalar = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], -1)


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return v + 2.0 * np.cross(q[..., 1:], np.cross(q[..., 1:], v) + q[..., :1] * v)


def unit(q: np.ndarray) -> np.ndarray:
    return q / np.maximum(np.linalg.norm(q, axis=-1, keepdims=True), 1e-30)


def blend(weights: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Blend rotations [N, K, 4] by weights [N, K]: the mean of the quaternions on one side of the sphere."""
    turns = np.where((turns * turns[:, :1]).sum(-1, keepdims=True) < 0, -turns, turns)
    return unit((weights[..., None] * turns).sum(1))


class SkinnedSplats:
    """A file's Gaussians. ``names`` are those of its joints; ``colors`` [N, 3] (sRGB), ``opacities`` [N] and ``scales``
    [N, 3] do not change over time; ``quats`` [N, 4] are at rest."""

    def __init__(self, path: str | Path) -> None:
        data = Path(path).read_bytes()
        magic, _, _, size, _ = struct.unpack_from("<4sIIII", data)
        if magic != b"glTF":
            raise ValueError(f"{path} is no binary glTF")
        self._gltf, self._blob = json.loads(data[20 : 20 + size]), data[28 + size :]
        primitive = self._gltf["meshes"][0]["primitives"][0]
        found = {name: self._values(index) for name, index in primitive["attributes"].items()}
        self._rest, quats = found["POSITION"], found[f"{EXTENSION}:ROTATION"]
        self.quats = unit(quats[:, [3, 0, 1, 2]])
        self.scales, self.opacities = found[f"{EXTENSION}:SCALE"], found[f"{EXTENSION}:OPACITY"][:, 0]
        self.colors = (0.5 + SH_C0 * found[f"{EXTENSION}:SH_DEGREE_0_COEF_0"]).clip(0.0, 1.0)
        sets = range(sum(name.startswith("JOINTS_") for name in found))
        self.joints = np.concatenate([found[f"JOINTS_{i}"] for i in sets], 1).astype(int)
        self.weights = np.concatenate([found[f"WEIGHTS_{i}"] for i in sets], 1)
        skin = self._gltf["skins"][0]
        self._nodes = skin["joints"]
        self._bind = self._values(skin["inverseBindMatrices"])[:, 12:15]  # our inverse binds only shift
        self.names = [self._gltf["nodes"][node].get("name", "") for node in self._nodes]
        self._tracks: dict[tuple[int, str], np.ndarray] = {}
        self.seconds = np.zeros(1)
        for animation in self._gltf.get("animations", [])[:1]:
            self.seconds = self._values(animation["samplers"][0]["input"])[:, 0]
            for channel in animation["channels"]:
                sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
                self._tracks[target["node"], target["path"]] = self._values(sampler["output"])

    def _values(self, index: int) -> np.ndarray:
        accessor = self._gltf["accessors"][index]
        view = self._gltf["bufferViews"][accessor["bufferView"]]
        width = WIDTHS[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        flat = np.frombuffer(self._blob, KINDS[accessor["componentType"]], accessor["count"] * width, start)
        return flat.reshape(-1, width).astype(np.float64)

    def _local(self, node: int, name: str, seconds: float) -> np.ndarray:
        """Return a node's rotation (xyzw) or translation, interpolated linearly."""
        track = self._tracks.get((node, name))
        if track is None:
            default = [0.0, 0.0, 0.0, 1.0] if name == "rotation" else [0.0, 0.0, 0.0]
            return np.array(self._gltf["nodes"][node].get(name, default), float)
        place = float(np.interp(seconds, self.seconds, np.arange(len(self.seconds))))
        low, high = int(place), min(int(place) + 1, len(track) - 1)
        return track[low] + (place - low) * (track[high] - track[low])

    def joint_poses(self, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Return rotations [M, 4] and positions [M, 3] of the joints in the world."""
        found: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        stack: list[Any] = [(node, np.array([1.0, 0, 0, 0]), np.zeros(3)) for node in self._gltf["scenes"][0]["nodes"]]
        while stack:
            node, turn, place = stack.pop()
            own = unit(self._local(node, "rotation", seconds)[[3, 0, 1, 2]])
            place = place + rotate(turn, self._local(node, "translation", seconds))
            found[node] = multiply(turn, own), place
            stack += [(child, *found[node]) for child in self._gltf["nodes"][node].get("children", [])]
        return np.stack([found[n][0] for n in self._nodes]), np.stack([found[n][1] for n in self._nodes])

    def at(self, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Return means [N, 3] and rotations [N, 4] of all Gaussians at a second of the animation."""
        return self.posed(*self.joint_poses(seconds))

    def posed(self, turns: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return means and rotations of all Gaussians for joints with these rotations and positions."""
        turn = turns[self.joints]
        moved = rotate(turn, self._rest[:, None] + self._bind[self.joints]) + places[self.joints]
        means = (self.weights[..., None] * moved).sum(1)
        return means, unit(multiply(blend(self.weights, turn), self.quats))
