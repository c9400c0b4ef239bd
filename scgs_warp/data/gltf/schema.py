"""Types of all glTF fields that are read. They are checked once, before use, because the parser accepts any JSON.

Names and types: glTF 2.0 specification, chapter 5, and the extensions listed in ``file.py``.
"""

from __future__ import annotations

import math
from typing import Any

INT, NUMBER, TEXT, FLAG = "a whole number from 0 on", "a finite number", "text", "true or false"
MAX_INT = 2**40
MAX_NUMBER = 1e12
"""Largest magnitude of a number in a scene: products of a few matrices of such numbers stay in the range of float64."""

_TEXTURE = {
    "index": INT,
    "texCoord": INT,
    "extensions": {
        "KHR_texture_transform": {"offset": [NUMBER], "scale": [NUMBER], "rotation": NUMBER, "texCoord": INT}
    },
}  # fmt: skip
_GLOSSY = {"diffuseFactor": [NUMBER], "diffuseTexture": {**_TEXTURE, "": ("index",)}}
_PLACED = {"bufferView": INT, "byteOffset": INT, "componentType": INT}

ANY_INT: dict[str, Any] = {"*": INT}
"""An object with any keys."""
FIELDS: dict[str, Any] = {
    "asset": {"version": TEXT, "": ("version",)},
    "scene": INT,
    "scenes": [{"nodes": [INT]}],
    "extensionsRequired": [TEXT],
    "nodes": [
        {"children": [INT], "mesh": INT, "skin": INT, "matrix": [NUMBER], "translation": [NUMBER], "rotation": [NUMBER],
         "scale": [NUMBER], "weights": [NUMBER]}
    ],
    "meshes": [
        {"primitives": [{"attributes": ANY_INT, "indices": INT, "material": INT, "mode": INT, "targets": [ANY_INT],
                         "": ("attributes",)}],
         "weights": [NUMBER], "": ("primitives",)}
    ],
    "skins": [{"joints": [INT], "inverseBindMatrices": INT, "": ("joints",)}],
    "animations": [
        {"name": TEXT,
         "channels": [{"sampler": INT, "target": {"node": INT, "path": TEXT, "": ("path",)},
                       "": ("sampler", "target")}],
         "samplers": [{"input": INT, "output": INT, "interpolation": TEXT, "": ("input", "output")}],
         "": ("channels", "samplers")}
    ],
    "accessors": [
        {"bufferView": INT, "byteOffset": INT, "componentType": INT, "count": INT, "type": TEXT, "normalized": FLAG,
         "sparse": {"count": INT, "indices": {**_PLACED, "": ("bufferView", "componentType")},
                    "values": {**_PLACED, "": ("bufferView",)}, "": ("count", "indices", "values")},
         "": ("componentType", "count", "type")}
    ],
    "bufferViews": [{"buffer": INT, "byteOffset": INT, "byteLength": INT, "byteStride": INT, "": ("buffer",)}],
    "buffers": [{"uri": TEXT, "byteLength": INT}],
    "images": [{"uri": TEXT, "bufferView": INT, "mimeType": TEXT}],
    "samplers": [{"wrapS": INT, "wrapT": INT, "magFilter": INT, "minFilter": INT}],
    "textures": [{"source": INT, "sampler": INT, "extensions": {"*": {"source": INT}}}],
    "materials": [
        {"pbrMetallicRoughness": {"baseColorFactor": [NUMBER], "baseColorTexture": {**_TEXTURE, "": ("index",)}},
         "emissiveFactor": [NUMBER], "emissiveTexture": {**_TEXTURE, "": ("index",)},
         "alphaMode": TEXT, "alphaCutoff": NUMBER, "doubleSided": FLAG,
         "extensions": {"KHR_materials_pbrSpecularGlossiness": _GLOSSY}}
    ],
    "": ("asset",),
}  # fmt: skip
"""Expected type of each field: a type, a list of a type, or an object; the key "" of an object lists its required
fields. Other fields are ignored."""


def find_problem(value: Any, kind: Any = None, field: str = "") -> tuple[str, str] | None:
    """Return the first invalid field and its fault; None if the document is valid."""
    kind = FIELDS if kind is None else kind
    if isinstance(kind, list):
        if not isinstance(value, list):
            return field, "is not a list"
        for index, inner in enumerate(value):
            problem = find_problem(inner, kind[0], f"{field}[{index}]")
            if problem is not None:
                return problem
        return None
    if not isinstance(kind, dict):
        return None if _fits(value, kind) else (field, f"is not {kind}")
    if not isinstance(value, dict):
        return field or "the document", "is not an object"
    for name in kind.get("", ()):
        if value.get(name) is None:
            return f"{field}.{name}".strip("."), "is missing"
    for name, inner in value.items():
        wanted = kind.get(name) if name else None
        wanted = kind.get("*") if wanted is None else wanted
        if wanted is not None and inner is not None:
            problem = find_problem(inner, wanted, f"{field}.{name[:40]}".strip("."))
            if problem is not None:
                return problem
    return None


def _fits(value: Any, kind: str) -> bool:
    if kind == INT:
        return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < MAX_INT
    if kind == NUMBER:
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        return is_number and abs(value) <= MAX_NUMBER and math.isfinite(value)
    return isinstance(value, bool if kind == FLAG else str)
