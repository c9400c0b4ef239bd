"""Cases of damaged files: a folder made once, the files to damage, and a law that loading must keep."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

if TYPE_CHECKING:
    from scgs_warp.data import Dataset


class Broken(AssertionError):
    """Loaded data break the law."""


@dataclass(frozen=True)
class Format:
    """One kind of input files."""

    name: str
    make: Callable[[Path], Any]
    """Function that fills a new folder."""
    load: Callable[[Path], Any]
    """Function that reads the folder and raises ``Broken`` for values that are not finite or out of range."""
    targets: Callable[[Path], list[Path]] | None = None
    """Patterns of the files to damage; None: all."""
    share: float = 1.0
    """Relative number of cases."""

    def files(self, folder: Path) -> list[Path]:
        if self.targets is not None:
            return self.targets(folder)
        return sorted(path for path in folder.rglob("*") if path.is_file())


def expect(condition: Any, what: str) -> None:
    if not condition:
        raise Broken(what)


def finite(what: str, *values: Any) -> None:
    for value in values:
        if isinstance(value, torch.Tensor):
            expect(bool(torch.isfinite(value).all()), f"{what} is not finite")
        elif isinstance(value, np.ndarray):
            expect(bool(np.isfinite(value).all()), f"{what} is not finite")
        else:
            expect(math.isfinite(value), f"{what} is {value}")


def within(what: str, value: Any, low: float = 0.0, high: float = 1.0) -> None:
    """Require finite values between two numbers, with room for rounding."""
    value = value.detach() if isinstance(value, torch.Tensor) else torch.as_tensor(np.asarray(value))
    finite(what, value)
    if value.numel():
        least, most = float(value.min()), float(value.max())
        expect(low - 1e-5 <= least and most <= high + 1e-5, f"{what} reaches from {least:g} to {most:g}")


def check_dataset(data: Dataset) -> None:
    """Check every frame as training takes it."""
    expect(len(data) > 0, "no frame")
    for frame in data:
        camera = frame.camera
        within("image", frame.image)
        expect(frame.image.shape == (camera.height, camera.width, 3), f"image of {list(frame.image.shape)}")
        finite("camera", camera.viewmat, camera.K)
        expect(float(camera.K[0, 0]) > 0 and float(camera.K[1, 1]) > 0, "focal length")
        rotation = camera.viewmat[:3, :3].double()
        within("rotation", rotation @ rotation.T - torch.eye(3), -3e-3, 3e-3)
        within("time", frame.time)
        if frame.alpha is not None:
            within("alpha", frame.alpha)
        if frame.mask is not None:
            expect(bool(frame.mask.any()), "empty mask")
    if data.points is not None:
        finite("points", data.points)
    if data.colors is not None:
        within("colours", data.colors)
        expect(data.points is not None and len(data.colors) == len(data.points), "colours without points")
    finite("extent", data.extent)


def check_gaussians(gaussians: Any) -> None:
    """Check activated Gaussians as renderers and exporters take them."""
    count = len(gaussians.means)
    for name in ("means", "quats", "scales", "opacities", "sh_dc", "sh_rest"):
        value = getattr(gaussians, name).detach()
        expect(len(value) == count, f"{len(value)} rows of {name}, {count} of means")
        finite(name, value)
    within("opacity", gaussians.opacities)
    expect(count == 0 or float(gaussians.scales.detach().min()) >= 0, "a negative scale")


def check_numbers(value: Any, what: str, most: float = 1e12) -> None:
    """Yield all numbers inside dataclasses, lists and dicts."""
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            check_numbers(getattr(value, field.name), f"{what}.{field.name}", most)
    elif isinstance(value, dict):
        for key, inner in value.items():
            check_numbers(inner, f"{what}.{key}", most)
    elif isinstance(value, (list, tuple)):
        for inner in value:
            check_numbers(inner, what, most)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        within(what, float(min(max(value, -1e300), 1e300)) if isinstance(value, int) else value, -most, most)


def suffixed(*suffixes: str) -> Callable[[Path], list[Path]]:
    def found(folder: Path) -> list[Path]:
        return sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix in suffixes)

    return found


def named(names: Iterable[str]) -> Callable[[Path], list[Path]]:
    wanted = list(names)
    return lambda folder: [folder / name for name in wanted]
