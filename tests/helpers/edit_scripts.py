"""A script that uses every part of an edit file, and damaged copies of it."""

from __future__ import annotations

import copy

SCRIPT = {
    "format": "scgs-warp edit",
    "version": 2,
    "comment": "the right end is raised and lowered",
    "handles": [
        {"name": "right", "nodes": {"point": [1.1, -1, 0.25], "rings": 1}, "time": 0.0, "pivot": [0.8, -1, 0.25]},
        {"name": "tip", "nodes": {"sphere": [1.1, -1, 0.25], "radius": 0.1}, "stiffness": 0.5, "lasts": "fade"},
    ],
    "pins": {"beyond": 2},
    "targets": {"tip": {"translation": [0, 0.02, 0]}},
    "keyframes": [
        {"at": 0.0, "easing": "ease", "targets": {"right": {}}},
        {"at": 0.5, "targets": {"right": {"axis": [0, 0, 1], "degrees": 60}}},
    ],
    "playback": {"speed": -1.0, "repeat": "swing"},
    "hold": [{"nodes": {"box": [[-1, -2, -1], [0, 2, 1]]}, "time": 0.3}],
    "exaggerate": {"factor": 1.2},
    "film": {
        "seconds": 0.5,
        "fps": 8,
        "size": 40,
        "background": [1, 1, 1],
        "shot": {"kind": "orbit", "views": [{"at": 0, "azimuth": 10}, {"at": 0.5, "azimuth": 70, "distance": 3}]},
    },
}


def changed(path: str, value: object) -> dict:
    """The script with one field replaced (...: removed); ``path``: keys and indices between dots."""
    script = copy.deepcopy(SCRIPT)
    inner: object = script
    *outer, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    for part in outer:
        inner = inner[part]  # type: ignore[index]
    if value is ...:
        del inner[last]  # type: ignore[attr-defined]
    else:
        inner[last] = value  # type: ignore[index]
    return script
