"""Odd counts, numbers and arrays, and damage to files of NumPy that passes the first checks."""

from __future__ import annotations

import io
import struct
import zipfile

import numpy as np

from fuzz.files_bytes import BYTES, Random

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
