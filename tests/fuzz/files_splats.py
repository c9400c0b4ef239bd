"""Damage to files of Gaussians that passes the first checks: lying headers, odd values, archives with valid sums."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
import zlib

import numpy as np

from fuzz.files_arrays import FLOATS, count_of, spoil_floats
from fuzz.files_bytes import BYTES, Random, json_value, set_word


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
