"""From a video to a data set: frames, what moves in them, where the camera was (pycolmap), a folder that trains."""

from __future__ import annotations

from .pipeline import Captured, Request, capture

__all__ = ["Captured", "Request", "capture"]
