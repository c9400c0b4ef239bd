"""Tiny glTF files written byte by byte, as the specification says, without the library that reads them."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np

COMPONENTS = {"b": 5120, "B": 5121, "h": 5122, "H": 5123, "I": 5125, "f": 5126}
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class Glb:
    """A document to be filled; every method returns the index of what it adds."""

    def __init__(self) -> None:
        self.binary = bytearray()
        self.document: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}]}

    def add(self, kind: str, **fields: Any) -> int:
        items = self.document.setdefault(kind, [])
        items.append(fields)
        return len(items) - 1

    def view(self, data: bytes, **fields: Any) -> int:
        self.binary.extend(b"\0" * (-len(self.binary) % 4))
        start = len(self.binary)
        self.binary.extend(data)
        return self.add("bufferViews", buffer=0, byteOffset=start, byteLength=len(data), **fields)

    def array(self, values: Any, code: str = "f", **fields: Any) -> int:
        """An accessor of rows; matrices are given [N, 4, 4] as mathematicians write them."""
        values = np.asarray(values)
        if values.ndim == 3:
            values = values.swapaxes(1, 2).reshape(len(values), 16)
        rows = values.reshape(len(values), -1).astype(np.dtype(code).newbyteorder("<"))
        view = self.view(rows.tobytes())
        kind = KINDS[rows.shape[1]]
        return self.add(
            "accessors", bufferView=view, componentType=COMPONENTS[code], count=len(rows), type=kind, **fields
        )

    def image(self, pixels: np.ndarray) -> int:
        """PNG of [H, W, 3 or 4] RGB(A) bytes."""
        order = cv2.COLOR_RGB2BGR if pixels.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
        ok, data = cv2.imencode(".png", cv2.cvtColor(pixels, order))
        assert ok
        return self.add("images", bufferView=self.view(data.tobytes()), mimeType="image/png")

    def primitive(self, positions: Any, faces: Any = None, **fields: Any) -> dict[str, Any]:
        """``fields``: attributes in capitals, as accessor indices; others as they are."""
        attributes = {"POSITION": self.array(positions)}
        attributes.update({key: value for key, value in fields.items() if key.isupper() or key[-2:-1] == "_"})
        result = {"attributes": attributes}
        result.update({key: value for key, value in fields.items() if key not in attributes})
        if faces is not None:
            result["indices"] = self.array(np.asarray(faces).reshape(-1), "H")
        return result

    def animate(self, clip: int, node: int, path: str, times: Any, values: Any, interpolation: str = "LINEAR") -> None:
        animation = self.document["animations"][clip]
        sampler = {"input": self.array(times), "output": self.array(values), "interpolation": interpolation}
        animation["samplers"].append(sampler)
        target = {"node": node, "path": path}
        animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})

    def clip(self, name: str | None = None) -> int:
        fields: dict[str, Any] = {"samplers": [], "channels": []}
        return self.add("animations", **fields, **({"name": name} if name else {}))

    def save(self, path: Path) -> Path:
        document = dict(self.document)
        binary = bytes(self.binary) + b"\0" * (-len(self.binary) % 4)
        if binary:
            document["buffers"] = [{"byteLength": len(binary)}]
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        if binary:
            chunks += struct.pack("<II", len(binary), 0x004E4942) + binary
        path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
        return path


BOX = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip
"""Outward, counter-clockwise from outside."""


def quat_z(degrees: float) -> list[float]:
    """xyzw of a turn about z."""
    half = np.radians(degrees) / 2
    return [0.0, 0.0, float(np.sin(half)), float(np.cos(half))]


def box(color: tuple[float, ...] = (0.8, 0.2, 0.1, 1.0)) -> Glb:
    """A cube that slides 3 units along x in a second and turns a quarter about z, on a parent moved up by 1."""
    glb = Glb()
    material = glb.add("materials", pbrMetallicRoughness={"baseColorFactor": list(color)})
    glb.add("meshes", primitives=[glb.primitive(BOX, BOX_FACES, material=material)])
    glb.document["nodes"] = [{"children": [1], "translation": [0, 1, 0]}, {"mesh": 0}]
    clip = glb.clip("Slide")
    glb.animate(clip, 1, "translation", [0.0, 1.0], [[0, 0, 0], [3, 0, 0]])
    glb.animate(clip, 1, "rotation", [0.0, 1.0], [quat_z(0), quat_z(90)])
    return glb


def bar(rows: int = 9) -> tuple[Glb, dict[str, np.ndarray]]:
    """A square bar from y = 0 to 2 with joints at y = 0 and 1, bent about z at the second; and its arrays."""
    heights = np.linspace(0, 2, rows)
    ring = np.array([[-0.2, 0, -0.2], [0.2, 0, -0.2], [0.2, 0, 0.2], [-0.2, 0, 0.2]])
    positions = np.concatenate([ring + np.array([0, height, 0]) for height in heights])
    faces = []
    for row in range(rows - 1):
        for k in range(4):
            a, b = 4 * row + k, 4 * row + (k + 1) % 4
            faces += [[a, a + 4, b + 4], [a, b + 4, b]]
    share = np.clip((positions[:, 1] - 0.75) / 0.5, 0, 1)
    joints = np.tile([0, 1, 0, 0], (len(positions), 1))
    weights = np.stack([1 - share, share, 0 * share, 0 * share], 1)
    inverse = np.stack([np.eye(4), np.eye(4)])
    inverse[1, 1, 3] = -1.0
    glb = Glb()
    primitive = glb.primitive(
        positions, faces, JOINTS_0=glb.array(joints, "B"), WEIGHTS_0=glb.array(weights), material=0
    )
    glb.add("materials", doubleSided=True)
    glb.add("meshes", primitives=[primitive])
    glb.add("skins", joints=[1, 2], inverseBindMatrices=glb.array(inverse))
    # The mesh's node is moved far away: a skinned mesh must not care.
    glb.document["nodes"] = [{"children": [1]}, {"children": [2]}, {"translation": [0, 1, 0]},
                             {"mesh": 0, "skin": 0, "translation": [50, 60, 70]}]  # fmt: skip
    glb.document["scenes"] = [{"nodes": [0, 3]}]
    clip = glb.clip("Bend")
    glb.animate(clip, 2, "rotation", [0.0, 0.5, 1.0], [quat_z(0), quat_z(60), quat_z(90)])
    arrays = {"positions": positions, "joints": joints, "weights": weights, "inverse": inverse}
    return glb, arrays


def quad(pixels: np.ndarray | None = None, sampler: dict[str, int] | None = None, **material: Any) -> Glb:
    """A unit square in the plane z = 0 (glTF), facing +z, texture upright; no animation."""
    glb = Glb()
    pbr: dict[str, Any] = dict(material.pop("pbr", {}))
    if pixels is not None:
        texture: dict[str, Any] = {"source": glb.image(pixels)}
        if sampler is not None:
            texture["sampler"] = glb.add("samplers", **sampler)
        pbr["baseColorTexture"] = {"index": glb.add("textures", **texture)}
    glb.add("materials", pbrMetallicRoughness=pbr, **material)
    corners = [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]
    uv = [[0, 1], [1, 1], [1, 0], [0, 0]]
    primitive = glb.primitive(corners, [[0, 1, 2], [0, 2, 3]], TEXCOORD_0=glb.array(uv), material=0)
    glb.add("meshes", primitives=[primitive])
    glb.document["nodes"] = [{"mesh": 0}]
    return glb
