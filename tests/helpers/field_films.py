"""Interlaced films of H.264 whose fields are stored one by one, as camcorders write them; x264 does not."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np

RATE = 25
CLOCK = Fraction(1, 90_000)


class _Bits:
    """Bits of an H.264 unit."""

    def __init__(self) -> None:
        self.bits: list[int] = []

    def plain(self, value: int, count: int) -> _Bits:
        self.bits += [(value >> place) & 1 for place in reversed(range(count))]
        return self

    def golomb(self, *values: int) -> _Bits:
        """Append unsigned Exp-Golomb codes."""
        for value in values:
            count = (value + 1).bit_length()
            self.plain(0, count - 1).plain(value + 1, count)
        return self

    def taken(self, stop: bool = False) -> bytes:
        """Return the bytes so far, the last one filled with zeros, and begin anew."""
        if stop:
            self.plain(1, 1)
        made, self.bits = np.packbits(np.array(self.bits, np.uint8)).tobytes(), []
        return made


def _unit(head: int, content: bytes) -> bytes:
    """Make a unit, without start codes in its content."""
    made, zeros = bytearray(), 0
    for value in content:
        if zeros >= 2 and value <= 3:
            made.append(3)
            zeros = 0
        made.append(value)
        zeros = zeros + 1 if value == 0 else 0
    return b"\0\0\0\1" + bytes([head]) + bytes(made)


def _parameters(width: int, height: int) -> bytes:
    """Return the parameters of an interlaced film with the time between its fields."""
    sps = _Bits().plain(77, 8).plain(0, 8).plain(30, 8).golomb(0, 0, 0, 4, 1).plain(0, 1)
    sps.golomb(width // 16 - 1, height // 32 - 1).plain(0b00101, 5)
    sps.plain(0b00001, 5).plain(1, 32).plain(2 * RATE, 32).plain(0b10010, 5)
    pps = _Bits().golomb(0, 0).plain(0, 2).golomb(0, 0, 0).plain(0, 3).golomb(0, 0, 0).plain(0b100, 3)
    return _unit(0x67, sps.taken(stop=True)) + _unit(0x68, pps.taken(stop=True))


def _field(gray: np.ndarray, bottom: bool, number: int) -> bytes:
    """Return a field [H/2, W] uint8 as a unit of uncompressed blocks; a bottom field is the second of its frame."""
    bits, content = _Bits().golomb(0, 7, 0).plain(0, 4).plain(2 + bottom, 2), b""
    if not bottom:
        bits.golomb(number % 2)
    bits.plain(bottom, 8).plain(0, 1 if bottom else 2).golomb(0, 1)
    for top in range(0, gray.shape[0], 16):
        for left in range(0, gray.shape[1], 16):
            block = gray[top : top + 16, left : left + 16].tobytes()
            content += bits.golomb(25).taken() + block + bytes([128] * 128)
    return _unit(0x21 if bottom else 0x65, content + bits.taken(stop=True))


def write_fields(path: Path, frames: np.ndarray, all_timed: bool) -> None:
    """Write frames [F, H, W] uint8 of values from 1, H a multiple of 32 and W one of 16, as fields.

    Args:
        all_timed: whether second fields have time stamps of their own.
    """
    import av

    delimiter, head = _unit(0x09, b"\x10"), _parameters(frames.shape[2], frames.shape[1])
    fields = [
        delimiter + (b"" if bottom else head) + _field(frame[int(bottom) :: 2], bottom, number)
        for number, frame in enumerate(frames)
        for bottom in (False, True)
    ]
    stream = path.with_suffix(".h264")
    stream.write_bytes(b"".join(fields))
    count = 1 if all_timed else 2
    step = int(count / (2 * RATE * CLOCK))
    with av.open(str(stream)) as source, av.open(str(path), "w") as out:
        target = out.add_stream_from_template(source.streams.video[0])
        for index, begin in enumerate(range(0, len(fields), count)):
            packet = av.Packet(b"".join(fields[begin : begin + count]))
            packet.pts = packet.dts = index * step
            packet.time_base, packet.duration, packet.stream = CLOCK, step, target
            packet.is_keyframe = begin % 2 == 0
            out.mux(packet)
    stream.unlink()
