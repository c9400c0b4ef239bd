"""glTF materials reduced to diffuse surfaces: a base colour, its texture and the alpha mode.

Factors and vertex colours are linear, textures are sRGB (glTF 2.0, 3.9). Metals have no diffuse colour and are shown in
their base colour.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .file import GltfFile

REPEAT, CLAMP, MIRROR = 0, 1, 2
WRAPS = {10497: REPEAT, 33071: CLAMP, 33648: MIRROR}
NEAREST = 9728
OPAQUE, MASK, BLEND = 0, 1, 2
ALPHA_MODES = {"OPAQUE": OPAQUE, "MASK": MASK, "BLEND": BLEND}


class Texture(NamedTuple):
    """An image with its wrapping and filtering."""

    pixels: np.ndarray
    """[H, W, 4] uint8, sRGB and alpha."""
    wrap: tuple[int, int]
    nearest: bool


@dataclass(frozen=True)
class Material:
    """A diffuse surface."""

    factor: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    """Linear colour and alpha."""
    texture: int = -1
    """Index of the texture; -1 without one."""
    coordinates: int = 0
    """Index of the TEXCOORD set that the texture uses."""
    transform: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 1.0, 1.0)
    """Offset u, v, rotation in radians, scale u, v (KHR_texture_transform)."""
    alpha_mode: int = OPAQUE
    cutoff: float = 0.5
    double_sided: bool = False
    unlit: bool = False


def transformed(uv: np.ndarray, material: Material) -> np.ndarray:
    """Apply KHR_texture_transform to texture coordinates [P, 2]: scale, then rotate, then translate."""
    u0, v0, angle, su, sv = material.transform
    c, s = math.cos(angle), math.sin(angle)
    u, v = uv[:, 0] * su, uv[:, 1] * sv
    return np.stack([c * u + s * v + u0, -s * u + c * v + v0], axis=1)


def read_materials(file: GltfFile) -> tuple[list[Material], list[Texture]]:
    """Read all materials in the file's order, followed by the default material, and their textures.

    Raises:
        UserError: a texture, an image or a colour factor is invalid.
    """
    textures: list[Texture] = []
    read: dict[int, int] = {}

    def texture_of(info: Any, where: str) -> int:
        index = _field(info, "index")
        texture = file.item("textures", index, f"{where}.index")
        if index not in read:
            read[index] = len(textures)
            textures.append(_texture(file, texture, f"textures[{index}]"))
        return read[index]

    materials = []
    for index, material in enumerate(file.document.materials or []):
        where = f"materials[{index}]"
        extensions = material.extensions or {}
        pbr = material.pbrMetallicRoughness
        factor, info = (pbr.baseColorFactor, pbr.baseColorTexture) if pbr else (None, None)
        glossy = extensions.get("KHR_materials_pbrSpecularGlossiness")
        if isinstance(glossy, dict):
            factor, info = glossy.get("diffuseFactor"), glossy.get("diffuseTexture")
        shines = _shines_only(factor, material)
        if factor and shines:  # as programs export what shall look the same in any light
            factor, info = [*material.emissiveFactor, factor[3]], material.emissiveTexture
        coordinates, transform = _placing(info)
        materials.append(
            Material(
                factor=_color(file, factor, where),
                texture=-1 if info is None else texture_of(info, f"{where} base colour texture"),
                coordinates=coordinates,
                transform=transform,
                alpha_mode=ALPHA_MODES.get(material.alphaMode or "OPAQUE", OPAQUE),
                cutoff=0.5 if material.alphaCutoff is None else float(material.alphaCutoff),
                double_sided=bool(material.doubleSided),
                unlit=shines or "KHR_materials_unlit" in extensions,
            )
        )
    return [*materials, Material(double_sided=True)], textures


def _shines_only(factor: Any, material: Any) -> bool:
    """Return whether a material has no colour but that of its emission."""
    emission = material.emissiveFactor
    dark = isinstance(factor, list) and len(factor) == 4 and not any(factor[:3])
    return dark and isinstance(emission, list) and len(emission) == 3 and any(value > 0 for value in emission)


def _field(info: Any, name: str) -> Any:
    """Return a field of an object of the parser, or of a dictionary inside an extension."""
    return info.get(name) if isinstance(info, dict) else getattr(info, name, None)


def _color(file: GltfFile, factor: Any, where: str) -> tuple[float, float, float, float]:
    if factor is None:
        return (1.0, 1.0, 1.0, 1.0)
    values = np.asarray(factor, np.float64) if isinstance(factor, list) else np.zeros(0)
    if values.shape != (4,) or not np.isfinite(values).all():
        raise file.error(f"{where}.baseColorFactor", "is not four numbers; export the file again")
    r, g, b, a = values.clip(0.0, 1.0).tolist()
    return r, g, b, a


def _placing(info: Any) -> tuple[int, tuple[float, float, float, float, float]]:
    """Return the TEXCOORD set and the transform of a reference to a texture."""
    if info is None:
        return 0, Material.transform
    moved = (_field(info, "extensions") or {}).get("KHR_texture_transform") or {}
    offset, scale = moved.get("offset", [0.0, 0.0]), moved.get("scale", [1.0, 1.0])
    transform = (*map(float, offset), float(moved.get("rotation", 0.0)), *map(float, scale))
    coordinates = moved.get("texCoord", _field(info, "texCoord") or 0)
    return int(coordinates), (transform[0], transform[1], transform[2], transform[3], transform[4])


def _texture(file: GltfFile, texture: Any, where: str) -> Texture:
    wrap, nearest = (REPEAT, REPEAT), False
    if texture.sampler is not None:
        sampler = file.item("samplers", texture.sampler, f"{where}.sampler")
        wrap = (WRAPS.get(sampler.wrapS, REPEAT), WRAPS.get(sampler.wrapT, REPEAT))
        nearest = sampler.magFilter == NEAREST
    source = texture.source
    for extension in (texture.extensions or {}).values():  # WebP and others may come without a fallback image.
        if source is None and isinstance(extension, dict):
            source = extension.get("source")
    return Texture(file.image(source, f"{where}.source"), wrap, nearest)
