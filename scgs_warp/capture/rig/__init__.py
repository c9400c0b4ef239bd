"""Capture of a data set from the videos of a rig: cameras that stand still and record at the same time."""

from __future__ import annotations

from .pipeline import RigResult, capture_rig
from .request import RigRequest

__all__ = ["RigRequest", "RigResult", "capture_rig"]
