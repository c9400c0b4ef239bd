"""Capture of a data set from a video, or from the videos of a rig: frame selection, synchronisation, motion masks,
camera poses (pycolmap) and undistortion."""

from __future__ import annotations

from .pipeline import CaptureRequest, CaptureResult, capture
from .rig import RigRequest, RigResult, capture_rig

__all__ = ["CaptureRequest", "CaptureResult", "RigRequest", "RigResult", "capture", "capture_rig"]
