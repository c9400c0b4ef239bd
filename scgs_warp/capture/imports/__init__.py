"""Cameras and depth that other programs have found, as a data set: ``import_scene``."""

from __future__ import annotations

from .agreement import TOLERATED
from .importing import ImportResult, import_scene

__all__ = ["TOLERATED", "ImportResult", "import_scene"]
