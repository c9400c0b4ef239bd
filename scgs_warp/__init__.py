"""scgs_warp: Sparse-Controlled Gaussian Splatting (SC-GS) on NVIDIA Warp, for the CPU and CUDA.

Importing the package is cheap: torch and Warp are loaded when one of its names is first used.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .runtime.environment import prepare_environment as _prepare_environment
from .scene import film_maker as _film_maker
from .scene import page_maker as _page_maker

__version__ = "0.1.0"

_prepare_environment()

if TYPE_CHECKING:
    from .rendering.rasterize import rasterization as rasterization
    from .scene.scene import Scene as Scene
    from .training.loop import fit as fit
    from .training.one_call import train as train
    from .types import Camera as Camera
    from .types import Frame as Frame
    from .types import Gaussians as Gaussians
    from .types import Image as Image
    from .types import Pose as Pose

_EXPORTS = {
    "Camera": "types",
    "Frame": "types",
    "Gaussians": "types",
    "Image": "types",
    "Pose": "types",
    "Scene": "scene.scene",
    "fit": "training.loop",
    "rasterization": "rendering.rasterize",
    "train": "training.one_call",
}
_PACKAGES = ("data", "edit")
"""Packages whose names can be used as ``scgs_warp.data.load`` without an import of their own."""
__all__ = ["Camera", "Frame", "Gaussians", "Image", "Pose", "Scene", "__version__", "fit", "rasterization", "train"]


def _framed_page(scene: Any) -> str | None:
    """Return what a notebook shows of a scene."""
    return importlib.import_module(".export.notebook", __name__).framed_page(scene)


def _film(scene: Any, path: str | Path, **options: Any) -> Path:
    """Write what ``Scene.turntable`` films."""
    return importlib.import_module(".visualization.films", __name__).turntable(scene, path, **options)


_page_maker.register(_framed_page)
_film_maker.register(_film)


def __dir__() -> list[str]:
    """Return the names that are loaded when they are first used, too, for completion in notebooks."""
    return sorted({*globals(), *__all__, *_PACKAGES})


def __getattr__(name: str):
    if name in _PACKAGES:
        return importlib.import_module(f".{name}", __name__)
    if name not in _EXPORTS:
        raise AttributeError(f"module 'scgs_warp' has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_EXPORTS[name]}", __name__), name)
