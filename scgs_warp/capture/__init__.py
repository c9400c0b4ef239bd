"""Capture of a data set from a video: frame selection, motion masks, camera poses (pycolmap) and undistortion."""

from __future__ import annotations

from .pipeline import CaptureRequest, CaptureResult, capture

__all__ = ["CaptureRequest", "CaptureResult", "capture"]
