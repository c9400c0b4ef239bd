"""From a video to a data set: frames, what moves in them, where the camera was (pycolmap), a folder that trains."""

from __future__ import annotations

from .pipeline import CaptureRequest, CaptureResult, capture

__all__ = ["CaptureRequest", "CaptureResult", "capture"]
