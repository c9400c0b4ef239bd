"""Seeded damage to files: bytes, JSON values and text. A mutator is a function of (data, random)."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any

import numpy as np

Random = np.random.Generator
Mutator = Callable[[bytes, Random], bytes]

NUMBERS = (
    0, -0.0, 1, -1, 2, 7, 255, 256, -128, 1e-45, 1e-320, 1e-10, 0.1, 0.5, 3.5, 1e6, 1e9, 1e12, 1e20, 3.4e38, 1e39,
    1e200, 1.7e308, -1e12, -1e300, 2**31 - 1, 2**31, -(2**31), 2**32, 2**53, 2**63, -(2**63), 2**64, 10**12, 10**30,
    10**400, float("nan"), float("inf"), -float("inf"),
)  # fmt: skip
TEXTS = (
    "", " ", "x", "0", "1e5", "nan", "null", "..", ".", "/", "\\", "../../../../etc/passwd", "/etc/passwd", "/dev/zero",
    "/dev/stdin", "a/../../b", "C:\\x", "\\\\host\\share", "~root", "%s%n", "\0", "a\0b", "line\nbreak", "\r\n",
    "\x1b[2J", "\u202e", "\ud800", "é", "日本", "a" * 300, "b/" * 3000, "<script>alert(1)</script>", "file:///etc/passwd",
    "data:application/octet-stream;base64,AAAA", "data:;base64,@@", "http://127.0.0.1:1/x",
)  # fmt: skip
OTHERS: tuple[Any, ...] = (
    None,
    True,
    False,
    [],
    {},
    [[]],
    [None],
    {"a": {}},
    [[1, 2], [3]],
    [[[0.0]]],
    ["x"],
    [True] * 3,
)
DEEP = 30_000
"""Nested brackets, deeper than the parser's stack."""
INTERESTING = bytes((0, 1, 2, 3, 4, 7, 0x7F, 0x80, 0xC0, 0xFE, 0xFF))


def truncate(data: bytes, random: Random) -> bytes:
    return data[: random.integers(len(data) + 1)]


def truncate_near_end(data: bytes, random: Random) -> bytes:
    return data[: max(len(data) - int(random.integers(1, 40)), 0)]


def flip_bits(data: bytes, random: Random) -> bytes:
    changed = bytearray(data)
    for _ in range(int(random.choice([1, 1, 2, 8, 64]))):
        if changed:
            changed[_place(len(changed), random)] ^= 1 << int(random.integers(8))
    return bytes(changed)


def set_bytes(data: bytes, random: Random) -> bytes:
    changed = bytearray(data)
    for _ in range(int(random.choice([1, 2, 4, 16]))):
        if changed:
            changed[_place(len(changed), random)] = INTERESTING[random.integers(len(INTERESTING))]
    return bytes(changed)


def set_word(data: bytes, random: Random) -> bytes:
    """Replace a count, an offset or a float of any size, mostly at an aligned place."""
    kind = str(random.choice(["<i2", "<i4", "<u4", "<i8", "<f4", "<f8", ">u4", ">u2"]))
    words = {
        "f": (np.nan, np.inf, -np.inf, 0.0, 1e30, -1e30, 1e-45, 3.4e38, 1e300),
        "i": (0, 1, -1, 2, 3, 255, 65535, 2**31 - 1, -(2**31), 10**12, 2**62),
    }["f" if "f" in kind else "i"]
    value = words[random.integers(len(words))]
    size = np.dtype(kind).itemsize
    if len(data) < size:
        return data
    with np.errstate(over="ignore"):
        packed = (
            np.array(value, kind).tobytes()
            if "f" in kind
            else (int(value) & (2 ** (8 * size) - 1)).to_bytes(size, "big" if kind[0] == ">" else "little")
        )
    place = _place(len(data) - size + 1, random)
    place -= place % size if random.random() < 0.7 else 0
    return data[:place] + packed + data[place + size :]


def insert(data: bytes, random: Random) -> bytes:
    place = int(random.integers(len(data) + 1))
    count = int(random.choice([1, 1, 2, 3, 4, 100, 5000]))
    filler = random.integers(0, 256, count, np.uint8).tobytes() if random.random() < 0.6 else b"\0" * count
    return data[:place] + filler + data[place:]


def delete(data: bytes, random: Random) -> bytes:
    place = int(random.integers(len(data) + 1))
    return data[:place] + data[place + int(random.choice([1, 1, 2, 4, 7, 100])) :]


def repeat(data: bytes, random: Random) -> bytes:
    first, last = sorted(int(x) for x in random.integers(len(data) + 1, size=2))
    return data[:last] + data[first:last] * int(random.integers(1, 4)) + data[last:]


def swap(data: bytes, random: Random) -> bytes:
    a, b, c = sorted(int(x) for x in random.integers(len(data) + 1, size=3))
    return data[:a] + data[b:c] + data[a:b] + data[c:]


def fill(data: bytes, random: Random) -> bytes:
    first, last = sorted(int(x) for x in random.integers(len(data) + 1, size=2))
    return data[:first] + bytes([INTERESTING[random.integers(len(INTERESTING))]]) * (last - first) + data[last:]


def empty(data: bytes, random: Random) -> bytes:
    return b""


def noise(data: bytes, random: Random) -> bytes:
    return random.integers(0, 256, int(random.choice([1, 8, 64, 1000])), np.uint8).tobytes()


def other_format(data: bytes, random: Random) -> bytes:
    """Replace the magic number by that of another format."""
    magics = (b"\x1f\x8b\x08\0", b"PK\x03\x04", b"\x93NUMPY\x01\0", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"ply\n")
    magics += (b"glTF\x02\0\0\0", b"NGSP", b"\x80\x04\x95", b"{", b"[", b"GIF89a", b"\x7fELF", b"II*\0")
    magic = magics[random.integers(len(magics))]
    return magic + data[len(magic) if random.random() < 0.5 else 0 :]


BYTES: tuple[Mutator, ...] = (
    truncate, truncate, truncate_near_end, flip_bits, flip_bits, set_bytes, set_word, set_word, insert, delete, repeat,
    swap, fill, empty, noise, other_format,
)  # fmt: skip


def _place(length: int, random: Random) -> int:
    """Choose an offset, mostly near the beginning, where headers stand."""
    return int(random.integers(min(length, 200) if random.random() < 0.5 else length))


def encode_otherwise(data: bytes, random: Random) -> bytes:
    text = data.decode("utf-8", "replace")
    kind = int(random.integers(5))
    if kind == 0:
        return b"\xef\xbb\xbf" + data
    if kind == 1:
        return text.encode("utf-16")
    if kind == 2:
        return text.encode("utf-32-be")
    if kind == 3:
        return data.replace(b"\n", b"\r\n") + b"\x1a"
    place = int(random.integers(len(data) + 1))
    return data[:place] + b"\xff\xfe\xe9" + data[place:]


def other_token(data: bytes, random: Random) -> bytes:
    """Replace a word of a text."""
    words = data.split(b" ")
    for _ in range(int(random.choice([1, 1, 3]))):
        words[random.integers(len(words))] = _token(random)
    return b" ".join(words)


def other_line(data: bytes, random: Random) -> bytes:
    """Remove, double or swap lines of a text."""
    lines = data.split(b"\n")
    place, other = (int(x) for x in random.integers(len(lines), size=2))
    kind = int(random.integers(4))
    if kind == 0:
        del lines[place]
    elif kind == 1:
        lines.insert(other, lines[place])
    elif kind == 2:
        lines[place], lines[other] = lines[other], lines[place]
    else:
        lines[place] = _token(random) * int(random.choice([1, 3]))
    return b"\n".join(lines)


def _token(random: Random) -> bytes:
    if random.random() < 0.7:
        return str(NUMBERS[random.integers(len(NUMBERS))]).encode()
    return TEXTS[random.integers(len(TEXTS))].encode("utf-8", "surrogatepass")


TEXT: tuple[Mutator, ...] = (other_token, other_token, other_token, other_line, other_line, encode_otherwise, truncate)


def places(value: Any, prefix: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Yield the paths of a JSON value's parts, as keys and indices."""
    found = [prefix] if prefix else []
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        found += places(inner, (*prefix, key))
    return found


def odd_value(old: Any, random: Random) -> Any:
    """Return a wrong or almost right replacement for ``old``."""
    kind = random.random()
    if kind < 0.4:
        return NUMBERS[random.integers(len(NUMBERS))]
    if kind < 0.55:
        return TEXTS[random.integers(len(TEXTS))]
    if kind < 0.7:
        return copy.deepcopy(OTHERS[random.integers(len(OTHERS))])
    if kind < 0.75:
        return [old]
    if kind < 0.8:
        return str(old)
    if kind < 0.85:
        return {"value": old}
    if isinstance(old, list) and old:
        return [old[:-1], [*old, old[0]], old[::-1], old * 3][random.integers(4)]
    if isinstance(old, (int, float)) and not isinstance(old, bool):
        return [-old, old + 1, old - 1, old * 1e3, old * 1e-3, old * 1e30][random.integers(6)]
    return [None, old, [old, old], {}][random.integers(4)]


def change_value(content: Any, random: Random) -> Any:
    """Return the value with one place replaced, removed, doubled or renamed, shallow places more often."""
    content = copy.deepcopy(content)
    known = places(content)
    if not known:
        return odd_value(content, random)
    if random.random() < 0.5:
        depth = min(int(random.integers(1, 5)), max(map(len, known)))
        known = [place for place in known if len(place) == depth] or known
    *outer, key = known[random.integers(len(known))]
    inner = content
    for step in outer:
        inner = inner[step]
    kind = random.random()
    if kind < 0.7:
        inner[key] = odd_value(inner[key], random)
    elif kind < 0.85:
        del inner[key]
    elif isinstance(inner, list):
        inner.insert(int(random.integers(len(inner) + 1)), copy.deepcopy(inner[key]))
    else:
        inner[str(TEXTS[random.integers(len(TEXTS))]) or "twice"] = inner[key]
    return content


def json_value(data: bytes, random: Random) -> bytes:
    content = json.loads(data)
    for _ in range(int(random.choice([1, 1, 1, 2, 5]))):
        content = change_value(content, random)
    return json.dumps(content).encode()


def json_twice(data: bytes, random: Random) -> bytes:
    """Write a key twice; parsers take the last."""
    content = json.loads(data)
    if not isinstance(content, dict) or not content:
        return b"[" + data + b"]"
    keys = list(content)
    key = keys[random.integers(len(keys))]
    again = json.dumps({key: odd_value(content[key], random)})
    return data.rstrip()[:-1] + b"," + again[1:].encode()


def json_deep(data: bytes, random: Random) -> bytes:
    kind = int(random.integers(4))
    deep = [b"[" * DEEP, b"[" * DEEP + b"]" * DEEP, b'{"a":' * DEEP, b'{"a":' * DEEP + b"1" + b"}" * DEEP][kind]
    content = json.loads(data)
    if isinstance(content, dict) and content and random.random() < 0.7:
        keys = list(content)
        content[keys[random.integers(len(keys))]] = "@@"
        return json.dumps(content).encode().replace(b'"@@"', deep)
    return deep


def json_long_number(data: bytes, random: Random) -> bytes:
    content = json.loads(data)
    known = [place for place in places(content)]
    if not known:
        return b"1" * 5000
    *outer, key = known[random.integers(len(known))]
    inner = content
    for step in outer:
        inner = inner[step]
    inner[key] = "@@"
    return json.dumps(content).encode().replace(b'"@@"', b"-" * int(random.integers(2)) + b"9" * 5000)


JSON: tuple[Mutator, ...] = (*(json_value,) * 12, json_twice, json_deep, json_long_number, encode_otherwise)
