"""Damage that passes the first checks of a format: lying headers with valid checksums."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
import zlib
from typing import Any

import numpy as np

from fuzz.files_bytes import BYTES, JSON, TEXT, Mutator, Random, change_value, json_value, odd_value, set_word

COUNTS = (0, 1, 2, 3, 5, 255, 65536, 10**7, 10**9, 2**31 - 1, 2**31, 2**32 - 1, 10**12, 2**61, 2**63, 2**64 - 1)
FLOATS = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-45, 1e-20, 1e9, 1e20, 3.4e38, -3.4e38)


def count_of(random: Random, bits: int = 64) -> int:
    return COUNTS[random.integers(len(COUNTS))] & (2**bits - 1)


def spoil_floats(array: np.ndarray, random: Random) -> np.ndarray:
    """Set some entries, a row, a column or all to one odd number."""
    changed = np.array(array, copy=True)
    if not changed.size or changed.dtype.kind not in "fiu":
        return changed
    flat = changed.reshape(len(changed), -1) if changed.ndim else changed.reshape(1, 1)
    value = FLOATS[random.integers(len(FLOATS))]
    with np.errstate(all="ignore"):
        number = np.array(value).astype(changed.dtype)
    kind = int(random.integers(5))
    if kind == 0:
        flat[random.integers(len(flat)), random.integers(flat.shape[1])] = number
    elif kind == 1:
        flat[random.integers(len(flat))] = number
    elif kind == 2:
        flat[:, random.integers(flat.shape[1])] = number
    elif kind == 3:
        flat[...] = number
    else:
        with np.errstate(all="ignore"):
            flat[random.random(flat.shape) < 0.3] = number
    return changed


def odd_array(array: np.ndarray, random: Random) -> np.ndarray:
    """Change an array's values, shape or type."""
    kind = int(random.integers(7))
    if kind < 3 or not array.size:
        return spoil_floats(array, random)
    if kind == 3:
        return array.reshape(-1)[: max(int(random.integers(array.size)), 0)]
    if kind == 4:
        shapes = [array[None], array.T, array.reshape(-1)[:0], array[..., :1] if array.ndim else array, np.zeros(())]
        return shapes[random.integers(len(shapes))]
    kinds = ("f2", "f4", "f8", ">f8", "i1", "u8", "?", "c16", "U4", "S3", "M8[s]")
    with np.errstate(all="ignore"):
        try:
            return array.astype(kinds[random.integers(len(kinds))])
        except (ValueError, TypeError):
            return array.astype("U4")


def npy_header(data: bytes, random: Random) -> bytes:
    """Write a header with another shape, type or order than the data."""
    try:
        length = struct.unpack_from("<H", data, 8)[0]
        body = data[10 + length :]
    except struct.error:
        return data
    shapes = ((10**12, 3), (2**62, 2**62), (-1, 3), (0, 3), (3,), (), (1,) * 40, (10**6, 10**6), (True, 3), (2.5, 3))
    kinds = ("<f4", "<f8", "|O", "<U5", "<i1", ">f8", [("a", "<f4")], "<M8[s]", "|V8", "x", 5, ("<f4", (10**9,)))
    old = (24, 3)
    head = {
        "descr": kinds[random.integers(len(kinds))] if random.random() < 0.5 else "<f4",
        "fortran_order": [False, True, None, "x"][random.integers(4)] if random.random() < 0.3 else False,
        "shape": shapes[random.integers(len(shapes))] if random.random() < 0.7 else old,
    }
    text = repr(head).encode() + b"\n"
    if random.random() < 0.2:
        text = (b"(" * 5000, b"__import__('os').getpid()\n", b"9" * 9000, b"{" * 60000)[random.integers(4)]
    version = int(random.choice([1, 1, 1, 2, 3, 9]))
    size = struct.pack("<H" if version == 1 else "<I", len(text) & 0xFFFF)
    return b"\x93NUMPY" + bytes([version, 0]) + size + text + body


def npy_values(data: bytes, random: Random) -> bytes:
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError):
        return data
    return _npy(odd_array(array, random))


def _npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npz_member(data: bytes, random: Random) -> bytes:
    """Spoil, remove, double, inflate or rename a member of an archive."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    names = list(members)
    name = names[random.integers(len(names))]
    kind = int(random.integers(8))
    if kind < 3:
        members[name] = npy_values(members[name], random)
    elif kind == 3:
        members[name] = npy_header(members[name], random)
    elif kind == 4:
        del members[name]
    elif kind == 5:
        members[name] = BYTES[random.integers(len(BYTES))](members[name], random)
    elif kind == 6:
        members[f"../../{name}"] = members.pop(name)
    else:  # 64 MiB of zeros in as many KiB
        members[name] = _npy(np.zeros((2**20, 8, 1) if random.random() < 0.5 else (2**20, 8)))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, value in members.items():
            archive.writestr(key, value)
    return stream.getvalue()


def ply_header(data: bytes, random: Random) -> bytes:
    head, end, body = data.partition(b"end_header\n")
    lines = head.split(b"\n")[:-1]
    place = int(random.integers(1, max(len(lines), 2)))
    kind = int(random.integers(9))
    elements = [index for index, line in enumerate(lines) if line.startswith(b"element")]
    if kind < 3 and elements:
        count = [str(count_of(random)), "-1", "1e9", "", "9" * 4000, "0x10", "nan"][random.integers(7)]
        lines[elements[0]] = b"element vertex " + count.encode()
    elif kind == 3:
        types = (
            b"char",
            b"uchar",
            b"short",
            b"int",
            b"uint",
            b"double",
            b"float",
            b"list uchar int",
            b"list int float",
            b"x",
        )
        words = lines[place].split(b" ")
        lines[place] = b"property " + types[random.integers(len(types))] + b" " + words[-1]
    elif kind == 4:
        del lines[place]
    elif kind == 5:
        lines.insert(place, lines[place])
    elif kind == 6:
        forms = (b"ascii 1.0", b"binary_big_endian 1.0", b"binary_little_endian 1.0", b"binary_little_endian 9", b"")
        lines[1] = b"format " + forms[random.integers(len(forms))]
    elif kind == 7:
        lines.insert(place, b"element other " + str(count_of(random)).encode() + b"\nproperty list uint float x")
    else:
        lines[place] = b"comment " + bytes(random.integers(0, 256, 50, np.uint8)) + b"x" * 10000
    return b"\n".join(lines) + b"\n" + end + body


def ply_values(data: bytes, random: Random) -> bytes:
    """Replace whole floats of the body, in binary or text."""
    head, end, body = data.partition(b"end_header\n")
    if b"ascii" in head:
        words = body.split(b" ")
        for _ in range(int(random.choice([1, 4, 100]))):
            words[random.integers(len(words))] = str(FLOATS[random.integers(len(FLOATS))]).encode()
        return head + end + b" ".join(words)
    usable = len(body) // 4 * 4
    floats = np.frombuffer(body[:usable], "<f4")
    columns = max(head.count(b"property"), 1)
    rows = floats[: len(floats) // columns * columns].reshape(-1, columns)
    spoilt = spoil_floats(rows, random).tobytes()
    return head + end + spoilt + body[len(spoilt) :]


def splat_values(data: bytes, random: Random) -> bytes:
    rows = np.frombuffer(data, [("f", "<f4", 6), ("u", "u1", 8)]).copy()
    rows["f"] = spoil_floats(rows["f"], random)
    return rows.tobytes()


def spz_inside(data: bytes, random: Random) -> bytes:
    """Unpack, damage and pack again, with a valid checksum."""
    if data[:2] != b"\x1f\x8b":
        return _spz_streams(data, random)
    plain = bytearray(gzip.decompress(data))
    kind = int(random.integers(5))
    if kind == 0:
        struct.pack_into("<I", plain, 8, count_of(random, 32))
    elif kind == 1:
        plain[12 + int(random.integers(4))] = int(random.integers(256))
    elif kind == 2:
        struct.pack_into("<I", plain, 4, int(random.integers(6)))
    elif kind == 3:  # a bomb: the header promises what so few bytes can hold
        struct.pack_into("<I", plain, 8, 9_999_999)
        plain += bytes(150_000_000)
        return zlib.compress(bytes(plain), 1, wbits=31)
    else:
        return gzip.compress(BYTES[random.integers(len(BYTES))](bytes(plain), random), mtime=0)
    return gzip.compress(bytes(plain), mtime=0)


def _spz_streams(data: bytes, random: Random) -> bytes:
    changed = bytearray(data)
    kind = int(random.integers(4))
    if kind == 0:
        struct.pack_into("<I", changed, 8, count_of(random, 32))
    elif kind == 1:
        place = 32 + 8 * int(random.integers(12))
        struct.pack_into("<Q", changed, place, count_of(random))
    elif kind == 2:
        changed[4 + int(random.integers(28))] = int(random.integers(256))
    else:
        return set_word(data, random)
    return bytes(changed)


def sog_member(data: bytes, random: Random) -> bytes:
    """Damage, remove, rename or inflate a member of a bundle, with valid check sums."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    names = list(members)
    name = names[random.integers(len(names))] if random.random() < 0.5 else "meta.json"
    kind = int(random.integers(7))
    if kind < 3:
        members[name] = (
            json_value(members["meta.json"], random) if name == "meta.json" else set_word(members[name], random)
        )
    elif kind == 3:
        members[name] = BYTES[random.integers(len(BYTES))](members[name], random)
    elif kind == 4:
        members[f"../../{name}" if random.random() < 0.5 else name.upper()] = members.pop(name)
    elif kind == 5:
        members[name] = members[names[random.integers(len(names))]]
    else:  # 80 MiB of zeros in as many KiB
        members[name] = bytes(80 << 20)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED if random.random() < 0.5 or kind == 6 else 0) as archive:
        for key, value in members.items():
            archive.writestr(key, value)
    return stream.getvalue()


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
