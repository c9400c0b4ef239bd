"""Capture of a data set from a video, or from the videos of a rig: frame selection, synchronisation, motion masks,
camera poses (pycolmap) and undistortion."""

from __future__ import annotations

from .imports import ImportResult, import_scene
from .pipeline import CaptureResult, capture
from .request import CaptureRequest
from .rig import RigRequest, RigResult, capture_rig

__all__ = [
    "CaptureRequest",
    "CaptureResult",
    "ImportResult",
    "RigRequest",
    "RigResult",
    "capture",
    "capture_rig",
    "import_scene",
]
