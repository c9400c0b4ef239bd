"""JSON that anybody may have written: every way in which it is none is a ``ValueError``."""

from __future__ import annotations

import json
from typing import Any


def parse_json(text: str | bytes, **hooks: Any) -> Any:
    """As ``json.loads``, which gives up on brackets that are nested too deeply in an error of its own.

    Raises:
        ValueError: no JSON; ``json.JSONDecodeError`` where it is known where.
    """
    try:
        return json.loads(text, **hooks)
    except RecursionError:
        raise ValueError("nested too deeply") from None
