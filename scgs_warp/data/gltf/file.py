"""Access to glTF 2.0 files: the arrays and images of a document that pygltflib parses.

All access to a document goes through ``GltfFile``, so that messages name the file and the field, as in
``figure.glb: accessors[3].count``.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import logging
import struct
import warnings
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2
import numpy as np

from ...errors import UserError
from ...storage.files import open_regular, read_bytes
from ...storage.json_files import parse_json
from ...storage.safe_paths import in_any_case, inside
from ..images import is_complete, oversized_claim
from .schema import find_problem

SUPPORTED_EXTENSIONS = {
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "KHR_materials_unlit",
    "KHR_materials_pbrSpecularGlossiness",
    "EXT_texture_webp",
}
"""Extensions whose data is read; others are refused if a file requires them."""
IGNORABLE_EXTENSIONS = ("KHR_materials_", "KHR_lights_", "KHR_xmp", "EXT_lights")
"""Prefixes of extensions that change reflection but not geometry. They are ignored, even if a file requires them."""
REMEDIES = {
    "KHR_draco_mesh_compression": "export it again without Draco compression",
    "EXT_meshopt_compression": "export it again without meshopt compression",
    "KHR_texture_basisu": "export it again with PNG or JPEG textures",
}
COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}


class GltfFile:
    """A parsed .glb or .gltf file. Errors of its look-ups name the file and the field."""

    def __init__(self, path: str | Path) -> None:
        """
        Raises:
            UserError: the file is missing, is not glTF 2.0 or requires an unsupported extension, or the parser is not
                installed.
        """
        self.path = Path(path)
        self._json = _checked(self.path)
        self.document = _parse(self.path)
        self._buffers: dict[int, bytes] = {}
        self._digest = hashlib.sha256(read_bytes(self.path, "restore it"))
        version = str(getattr(self.document.asset, "version", "") or "")
        if not version.startswith("2."):
            raise self.error("asset.version", f"is {version or 'missing'}; export it again as glTF 2.0")
        for name in self.document.extensionsRequired or []:
            if name not in SUPPORTED_EXTENSIONS and not name.startswith(IGNORABLE_EXTENSIONS):
                remedy = REMEDIES.get(name, "export it again without this extension")
                raise self.error("extensionsRequired", f"names {name}, which is not supported; {remedy}")

    def error(self, field: str, text: str) -> UserError:
        """Make the error to raise, from the field, its fault and the remedy."""
        return UserError(f"{self.path}: {field} {text}")

    @property
    def digest(self) -> str:
        """SHA-256 of the file and of the external resources read so far."""
        return self._digest.hexdigest()

    def item(self, kind: str, index: Any, field: str) -> Any:
        """Return element ``index`` of the document's list ``kind``; ``field`` names the reference in messages."""
        items = getattr(self.document, kind) or []
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(items):
            raise self.error(field, f"is {index!r}, but there are {len(items)} {kind}; export the file again")
        return items[index]

    def node_weights(self, index: int) -> list[float] | None:
        """Return ``nodes[index].weights`` of morph targets, which the parser drops; None if the node has none."""
        return self._json["nodes"][index].get("weights")

    def array(self, index: Any, field: str, components: int | None = None) -> np.ndarray:
        """Read an accessor, [count, components]; 4 x 4 matrices as [count, 4, 4], row-major.

        Floats and normalised integers become float64, other integers keep their type.
        """
        accessor = self.item("accessors", index, field)
        where = f"accessors[{index}]"
        width = COMPONENTS.get(accessor.type)
        dtype = TYPES.get(accessor.componentType)
        count = accessor.count
        if width is None or dtype is None or not isinstance(count, int) or count < 0:
            raise self.error(where, "has an unknown type, componentType or count; export the file again")
        if components is not None and width != components:
            raise self.error(where, f"is {accessor.type}, but {field} needs {components} components; export it again")
        if accessor.bufferView is None:
            raw = np.zeros((count, width), dtype)
        else:
            raw = self._strided(accessor.bufferView, accessor.byteOffset or 0, np.dtype(dtype), count, width, where)
        if accessor.sparse is not None:
            raw = self._with_sparse(raw, accessor.sparse, where)
        with np.errstate(invalid="ignore"):  # a signalling NaN; it is refused below, without a warning
            values: np.ndarray = raw.astype(np.float64) if dtype is np.float32 else raw
        if accessor.normalized and dtype is not np.float32:
            largest = 2 ** (8 * raw.dtype.itemsize - (raw.dtype.kind == "i")) - 1
            values = np.maximum(raw / float(largest), -1.0)
        if values.dtype == np.float64 and not np.isfinite(values).all():
            raise self.error(where, f"({field}) holds values that are not finite; repair the model and export it again")
        return values.reshape(count, 4, 4).swapaxes(1, 2) if accessor.type == "MAT4" else values

    def _strided(
        self, view: int, offset: int, dtype: np.dtype, count: int, width: int, field: str, fixed: bool = False
    ) -> np.ndarray:
        data, stride = self.view(view, field)
        size = dtype.itemsize * width
        step = size if fixed or not stride else stride
        needed = offset + step * (count - 1) + size if count else offset
        if offset < 0 or step < size or needed > len(data):
            raise self.error(field, f"needs {needed} bytes of a bufferView of {len(data)}; the file is damaged")
        if count == 0:
            return np.zeros((0, width), dtype)
        strides = (step, dtype.itemsize)
        return np.ndarray((count, width), dtype.newbyteorder("<"), data, offset, strides).astype(dtype)

    def _with_sparse(self, raw: np.ndarray, sparse: Any, where: str) -> np.ndarray:
        """Replace the elements that a sparse accessor lists."""
        kind = TYPES.get(sparse.indices.componentType)
        if kind is None or not isinstance(sparse.count, int):
            raise self.error(f"{where}.sparse", "has an unknown componentType or count; export the file again")
        indices = self._strided(
            sparse.indices.bufferView, sparse.indices.byteOffset or 0, np.dtype(kind), sparse.count, 1, where, True
        )[:, 0]
        values = self._strided(
            sparse.values.bufferView, sparse.values.byteOffset or 0, raw.dtype, sparse.count, raw.shape[1], where, True
        )
        if len(indices) and int(indices.max()) >= len(raw):
            raise self.error(f"{where}.sparse", f"names element {int(indices.max())} of {len(raw)}; export it again")
        result = raw.copy()
        result[indices] = values
        return result

    def view(self, index: Any, field: str) -> tuple[bytes, int]:
        """Return the bytes of a buffer view, and its stride or 0."""
        view = self.item("bufferViews", index, f"{field}.bufferView")
        data = self._buffer(view.buffer, f"bufferViews[{index}]")
        start, length = view.byteOffset or 0, view.byteLength or 0
        if start < 0 or start + length > len(data):
            raise self.error(
                f"bufferViews[{index}]", f"ends behind its buffer of {len(data)} bytes; the file is cut off"
            )
        return data[start : start + length], view.byteStride or 0

    def _buffer(self, index: Any, field: str) -> bytes:
        buffer = self.item("buffers", index, f"{field}.buffer")
        if index not in self._buffers:
            if buffer.uri:
                self._buffers[index] = self.resource(buffer.uri, f"buffers[{index}].uri")
            else:
                self._buffers[index] = self.document.binary_blob() or b""
        return self._buffers[index]

    def resource(self, uri: str, field: str) -> bytes:
        """Read the bytes of a URI: embedded data, or a file in this file's folder."""
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=False)
            except (binascii.Error, ValueError):
                raise self.error(field, "is no valid base64; export the file again") from None
        path = inside(self.path.parent, unquote(uri), f"{self.path}: {field}")
        path = in_any_case(path) or path
        try:
            with open_regular(path) as file:
                data = file.read()
            self._digest.update(data)
            return data
        except OSError as error:
            reason = error.strerror or type(error).__name__
            raise self.error(
                field, f"names {uri[:80]}, which cannot be read ({reason}); put it beside the file"
            ) from None

    def image(self, index: Any, field: str) -> np.ndarray:
        """Decode an image to [H, W, 4] uint8 RGBA."""
        image = self.item("images", index, field)
        where = f"images[{index}]"
        data = self.resource(image.uri, f"{where}.uri") if image.uri else self.view(image.bufferView, where)[0]
        claim = oversized_claim(data)
        if claim is not None:
            raise self.error(where, f"says it is {claim} in {len(data)} bytes; export the file with smaller textures")
        try:
            raw = np.frombuffer(data, np.uint8)
            pixels = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED) if is_complete(raw) else None
        except cv2.error:
            pixels = None
        if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
            kind = image.mimeType or "unknown type"
            raise self.error(where, f"({kind}) does not decode; export the file with PNG or JPEG textures")
        if pixels.dtype == np.uint16:
            pixels = (pixels // 257).astype(np.uint8)
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        code = {1: cv2.COLOR_GRAY2RGBA, 3: cv2.COLOR_BGR2RGBA, 4: cv2.COLOR_BGRA2RGBA}.get(channels)
        if code is None:
            raise self.error(where, f"has {channels} channels; export the file with RGB or RGBA textures")
        return np.ascontiguousarray(cv2.cvtColor(pixels, code))


def _checked(path: Path) -> dict[str, Any]:
    """Parse the document as JSON and check the types of its fields."""
    if path.is_dir():
        raise UserError(f"{path}: is a folder; name a .glb or .gltf file with --mesh")
    if not path.is_file():
        raise UserError(f"{path}: no such file; give a .glb or .gltf with --mesh")
    if path.suffix.lower() not in (".glb", ".gltf"):
        raise UserError(f"{path}: does not end in .glb or .gltf; give a .glb or .gltf (Blender exports them)")
    data = read_bytes(path, "give a .glb or .gltf with --mesh")
    try:
        if path.suffix.lower() == ".glb":
            magic, _, _, length = struct.unpack_from("<4sIII", data)
            if magic != b"glTF" or 20 + length > len(data):
                raise ValueError("truncated or not a GLB")
            data = data[20 : 20 + length]
        content = parse_json(data.decode("utf-8-sig"))
    except (ValueError, struct.error) as error:
        raise UserError(f"{path}: is not a readable glTF ({str(error)[:80]}); export it again") from None
    problem = find_problem(content)
    if problem is not None:
        raise UserError(f"{path}: {problem[0]} {problem[1]}; export the file again")
    return content


def _parse(path: Path) -> Any:
    """Parse the document with pygltflib."""
    try:
        import pygltflib
    except ImportError:
        raise UserError(f'{path}: reading glTF needs pygltflib; pip install "scgs-warp[gltf]"') from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            logging.disable(logging.WARNING)  # The parser logs errors before it raises them.
            document = pygltflib.GLTF2().load(path)
    except Exception as error:  # The parser passes on the exceptions of struct, json, dataclasses and unicode.
        reason = " ".join(str(error).split())[:80] or type(error).__name__
        raise UserError(f"{path}: is not a readable glTF ({reason}); export it again") from None
    finally:
        logging.disable(logging.NOTSET)
    if document is None or document.asset is None:
        raise UserError(f"{path}: asset is missing, so this is not a glTF; export it again")
    return document
