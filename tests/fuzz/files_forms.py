"""Damage that passes the first checks of a format: lying headers with valid checksums."""

from __future__ import annotations

import json
import struct
import zlib
from typing import Any

import numpy as np

from fuzz.files_arrays import FLOATS, count_of, npy_header, npy_values, npz_member, odd_array, spoil_floats
from fuzz.files_bytes import BYTES, JSON, TEXT, Mutator, Random, change_value, json_value, odd_value, set_word
from fuzz.files_splats import ply_header, ply_values, sog_member, splat_values, spz_inside


def png_size(data: bytes, random: Random) -> bytes:
    """Change the width or height with a valid checksum: data are missing, or the picture is a bomb."""
    if data[:4] != b"\x89PNG":
        return jpeg_size(data, random)
    changed = bytearray(data)
    place = 16 + int(random.choice([0, 4]))
    sizes = (0, 1, 2, 39, 41, 1000, 20_000, 100_000, 2**31 - 1, 2**32 - 1)
    struct.pack_into(">I", changed, place, sizes[random.integers(len(sizes))])
    if random.random() < 0.3:
        changed[24] = int(random.choice([1, 2, 4, 8, 16, 7]))
    if random.random() < 0.3:
        changed[25] = int(random.choice([0, 2, 3, 4, 6, 9]))
    struct.pack_into(">I", changed, 29, zlib.crc32(changed[12:29]))
    return bytes(changed)


def jpeg_size(data: bytes, random: Random) -> bytes:
    found = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2"))
    if found < 0:
        return set_word(data, random)
    changed = bytearray(data)
    struct.pack_into(">H", changed, found + int(random.choice([5, 7])), int(random.choice([0, 1, 29, 5000, 65535])))
    return bytes(changed)


def colmap_count(data: bytes, random: Random) -> bytes:
    return struct.pack("<Q", count_of(random)) + data[8:]


def colmap_doubles(data: bytes, random: Random) -> bytes:
    changed = bytearray(data)
    first = int(random.choice([8 + 4, 8 + 24, 8 + 8]))
    place = first + 8 * int(random.integers(max((len(data) - first) // 8, 1)))
    if place + 8 <= len(changed):
        struct.pack_into("<d", changed, place, FLOATS[random.integers(len(FLOATS))])
    return bytes(changed)


def safetensors_head(data: bytes, random: Random) -> bytes:
    """Damage the JSON header: shapes, types, offsets, metadata; with or without the right length."""
    (length,) = struct.unpack_from("<Q", data)
    head, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    if random.random() < 0.5 and "__metadata__" in head:
        key = next(iter(head["__metadata__"]))
        text = head["__metadata__"][key].encode()
        mutator = JSON[random.integers(len(JSON))] if random.random() < 0.3 else json_value
        head["__metadata__"][key] = _without_own_sum(mutator(text, random).decode("utf-8", "replace"))
    else:
        head = change_value(head, random)
    text = json.dumps(head).encode()
    size = len(text) if random.random() < 0.9 else count_of(random)
    return struct.pack("<Q", size) + text + body


def safetensors_values(data: bytes, random: Random) -> bytes:
    """Change values, shapes or types of tensors in an otherwise valid file."""
    import torch
    from safetensors.torch import load, save

    (length,) = struct.unpack_from("<Q", data)
    metadata = json.loads(data[8 : 8 + length]).get("__metadata__")
    tensors = dict(load(data))
    names = sorted(tensors)
    for _ in range(int(random.choice([1, 1, 2]))):
        name = names[random.integers(len(names))]
        kind = random.random()
        if kind < 0.1:
            tensors.pop(name, None)
        elif name in tensors:
            array = odd_array(tensors[name].numpy(), random)
            if array.dtype.kind in "fiub":
                native = array.astype(array.dtype.newbyteorder("="))
                tensors[name] = torch.from_numpy(np.ascontiguousarray(native).copy())
    return save(tensors, _with_sums(metadata, tensors))


def _without_own_sum(text: str) -> str:
    """Change metadata and drop its checksum, so that the reader gets to the contents."""
    try:
        content = json.loads(text)
        content["crc32"].pop("", None)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return text
    return json.dumps(content)


def _with_sums(metadata: Any, tensors: Any) -> Any:
    """Recompute the checksums of a changed checkpoint."""

    found = dict(metadata or {})
    for key, text in found.items():
        content = json.loads(text)
        if isinstance(content, dict) and "crc32" in content:
            flat = {name: np.ascontiguousarray(value.numpy()) for name, value in tensors.items()}
            content["crc32"] = {name: zlib.crc32(value) for name, value in flat.items()}
            found[key] = json.dumps(content)
    return found or None


def glb_json(data: bytes, random: Random) -> bytes:
    """Damage the JSON document inside, with valid lengths."""
    (length,) = struct.unpack_from("<I", data, 12)
    mutator = JSON[random.integers(len(JSON))] if random.random() < 0.2 else json_value
    text = mutator(data[20 : 20 + length], random)
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def glb_floats(data: bytes, random: Random) -> bytes:
    (length,) = struct.unpack_from("<I", data, 12)
    first = 28 + length
    count = (len(data) - first) // 4
    floats = spoil_floats(np.frombuffer(data, "<f4", count, first).reshape(-1, 1), random).tobytes()
    return data[:first] + floats + data[first + len(floats) :]


def glb_lengths(data: bytes, random: Random) -> bytes:
    changed = bytearray(data)
    place = int(random.choice([4, 8, 12, 16, 20 + struct.unpack_from("<I", data, 12)[0]]))
    if place + 4 <= len(changed):
        struct.pack_into("<I", changed, place, count_of(random, 32))
    return bytes(changed)


def jsonl_value(data: bytes, random: Random) -> bytes:
    lines = data.split(b"\n")
    place = int(random.integers(max(len(lines) - 1, 1)))
    lines[place] = (
        json.dumps(odd_value(json.loads(lines[place]), random)).encode()
        if random.random() < 0.2
        else (JSON[random.integers(len(JSON))](lines[place], random))
    )
    return b"\n".join(lines)


STRUCTURED: dict[str, tuple[Mutator, ...]] = {
    ".json": JSON,
    ".gltf": JSON,
    ".jsonl": (jsonl_value, jsonl_value, *TEXT),
    ".npy": (npy_header, npy_values, npy_values),
    ".npz": (npz_member,),
    ".png": (png_size,),
    ".jpg": (png_size,),
    ".webp": (png_size,),
    ".ply": (ply_header, ply_header, ply_values, ply_values, TEXT[0]),
    ".splat": (splat_values,),
    ".spz": (spz_inside,),
    ".sog": (sog_member,),
    ".bin": (colmap_count, colmap_doubles, colmap_doubles),
    ".txt": TEXT,
    ".safetensors": (safetensors_head, safetensors_head, safetensors_values, safetensors_values),
    ".glb": (glb_json, glb_json, glb_json, glb_floats, glb_lengths),
}


def mutate(name: str, data: bytes, random: Random) -> bytes:
    """Return a file's content, damaged in terms of its format in 7 of 10 cases, else byte by byte."""
    suffix = name[name.rfind(".") :].lower()
    known = STRUCTURED.get(suffix)
    if known and data and random.random() < 0.7:
        return known[random.integers(len(known))](data, random)
    return BYTES[random.integers(len(BYTES))](data, random)
