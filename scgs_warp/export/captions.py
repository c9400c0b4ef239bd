"""Captions of a page's film, from WebVTT (https://www.w3.org/TR/webvtt1/): cue times and plain text."""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..storage.files import read_bytes

MAX_BYTES = 1 << 20
MAX_CUES = 10_000
TIMING = re.compile(r"((?:\d{1,4}:)?\d{2}:\d{2}[.,]\d{3})\s+-->\s+((?:\d{1,4}:)?\d{2}:\d{2}[.,]\d{3})(?:\s.*)?")


def read_captions(path: Path) -> list[dict[str, Any]]:
    """Return the cues: ``from`` and ``to`` in seconds, and ``text``. Styles, positions, notes and tags are left out.

    Raises:
        UserError: the file is missing, too large, or not WebVTT.
    """
    content = read_bytes(path, "give captions as WebVTT (.vtt)")
    if len(content) > MAX_BYTES:
        raise UserError(f"{path}: is larger than {MAX_BYTES >> 20} MiB; give captions as WebVTT (.vtt)")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UserError(f"{path}: is not UTF-8 text; save it as WebVTT (.vtt) in UTF-8") from None
    lines = text.replace("\r\n", "\n").replace("\r", "\n").replace("\0", "\ufffd")
    if not re.match(r"WEBVTT(?:[ \t\n]|$)", lines):
        raise UserError(f"{path}: does not begin with WEBVTT; give captions as WebVTT (.vtt)")
    cues = []
    for block in re.split(r"\n{2,}", lines)[1:]:
        rows = block.strip("\n").split("\n")
        if re.match(r"(?:NOTE|STYLE|REGION)(?:\s|$)", rows[0]):
            continue
        place = next((row for row in range(min(2, len(rows))) if "-->" in rows[row]), None)
        if place is None:
            continue
        timing = TIMING.fullmatch(rows[place].strip())
        begin, end = (_seconds(timing[k]) for k in (1, 2)) if timing else (0.0, 0.0)
        if not end > begin:
            raise UserError(f"{path}: {rows[place][:60]!r} is no time span; write 00:01.000 --> 00:03.500")
        said = html.unescape(re.sub(r"<[^<>]*>", "", "\n".join(rows[place + 1 :]))).strip()
        if said:
            cues.append({"from": begin, "to": end, "text": said})
        if len(cues) > MAX_CUES:
            raise UserError(f"{path}: has more than {MAX_CUES:,} cues; give fewer")
    return cues


def _seconds(text: str) -> float:
    *hours, minutes, seconds = text.replace(",", ".").split(":")
    return 3600.0 * int(hours[0] if hours else 0) + 60.0 * int(minutes) + float(seconds)
