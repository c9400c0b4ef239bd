"""Validation of checkpoints, which may come from anyone and are therefore not trusted.

Sizes are checked before memory is allocated and numbers before they are used: an index out of range would make a
kernel read or write foreign memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from ..errors import UserError
from ..types import Gaussians

REMEDY = "use the previous checkpoint, or train again"
SH_COUNTS = (0, 3, 8, 15)
"""Numbers of coefficients above degree 0, for degrees 0 to 3."""
MAX_MAGNITUDE = 1e12
"""Largest magnitude that a checkpoint may hold for the normalisation, the overview and the step number."""
TIME_PLANE = "planes.3"
MAX_PLANE_TIMES = 4096
MIN_MOMENT = 1e-30
INTEGER_TENSORS = ("extra.graph.neighbors",)
"""Names of the int32 tensors; all others are float32."""
CHECKED_TIMES = (0.0, 0.5, 1.0)
"""Times at which a loaded scene is checked, of each chunk of its motion."""


def _unusable(source: str, what: str) -> UserError:
    return UserError(f"{source}: {what}; {REMEDY}")


def check_tensors(tensors: Mapping[str, Tensor], source: str) -> None:
    """Check that all tensors are finite and of consistent types and shapes.

    Raises:
        UserError: naming the tensor.
    """
    for name, value in tensors.items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            raise _unusable(source, f"{name} holds non-finite numbers")
        wanted = torch.int32 if name in INTEGER_TENSORS else torch.float32
        if value.dtype != wanted:
            raise _unusable(source, f"{name} is of {value.dtype}, not of {wanted}")
    rows = {name: tuple(tensors[name].shape) for name in tensors if name.startswith("gaussians.")}
    means, rest, hyper = (rows.get(f"gaussians.{name}", ()) for name in ("means", "sh_rest", "hyper"))
    if len(means) != 2 or means[0] < 1 or means[1] != 3:
        raise _unusable(source, f"gaussians.means is {list(means)}, not [N, 3]")
    if len(rest) != 3 or rest[1] not in SH_COUNTS or rest[2] != 3:
        raise _unusable(source, f"gaussians.sh_rest is {list(rest)}, not [N, 0 or 3 or 8 or 15, 3]")
    optional = (rows.get(f"gaussians.{name}", (0, 0)) for name in ("shading", "correctives"))
    if len(hyper) != 2 or any(len(shape) != 2 for shape in optional):
        raise _unusable(source, "gaussians.hyper, gaussians.shading or gaussians.correctives is not [N, ...]")
    for name, shape in rows.items():
        if not shape or shape[0] != means[0]:
            raise _unusable(source, f"{name} is {list(shape)}, but there are {means[0]} Gaussians")
    nodes = tensors.get("motion.positions")
    if nodes is not None and (nodes.ndim != 2 or nodes.shape[0] < 1 or nodes.shape[1] != 3):
        raise _unusable(source, f"motion.positions is {list(nodes.shape)}, not [M, 3]")
    plane = tensors.get(f"motion.{TIME_PLANE}")
    if plane is not None and (plane.ndim != 3 or not 1 <= plane.shape[0] <= MAX_PLANE_TIMES or plane.numel() == 0):
        raise _unusable(source, f"motion.{TIME_PLANE} is {list(plane.shape)}, not [T, X, channels]")


def check_metadata(metadata: Mapping[str, Any], source: str) -> None:
    """Check that all metadata of a scene is present, of the right type and finite.

    Raises:
        UserError: naming the field.
    """
    for name in ("config", "normalisation", "overview"):
        if not isinstance(metadata.get(name), dict):
            raise _unusable(source, f"metadata.{name} is missing or not an object")
    unit, overview = metadata["normalisation"], metadata["overview"]
    for name, value in (("normalisation.centre", unit.get("centre")), ("overview.centre", overview.get("centre"))):
        if not _vector(value):
            raise _unusable(source, f"metadata.{name} is not three numbers")
    if not _vector(overview.get("up")) or not any(abs(x) > 1e-6 for x in overview["up"]):
        raise _unusable(source, "metadata.overview.up is not a direction")
    ranges = {"radius": (0, MAX_MAGNITUDE), "fov_x": (1e-3, 179.0), "aspect": (1e-3, 1e3)}
    for name, value in overview.items():
        low, high = ranges.get(name, (-MAX_MAGNITUDE, MAX_MAGNITUDE))
        if name not in ("centre", "up") and not _number(value, low, high):
            raise _unusable(source, f"metadata.overview.{name} is not a number from {low:g} to {high:g}")
    if not _number(unit.get("scale"), 1 / MAX_MAGNITUDE, MAX_MAGNITUDE):
        raise _unusable(source, "metadata.normalisation.scale is not a positive number")
    step = metadata.get("step")
    if isinstance(step, bool) or not isinstance(step, int) or not 0 <= step < MAX_MAGNITUDE:
        raise _unusable(source, "metadata.step is no whole number")
    if not isinstance(metadata.get("motion"), str):
        raise _unusable(source, "metadata.motion names no motion model")


def check_settings(settings: Any, source: str) -> None:
    """Check the fields of ``config.json`` that are used besides the checkpoint: the data folder and its options.

    Raises:
        UserError: naming the field.
    """
    data = settings.get("data", {}) if isinstance(settings, dict) else None
    if not isinstance(data, dict):
        raise UserError(f"{source}: must hold a JSON object, and data another; restore it or train again")
    for name in ("folder", "resample", "background", "frames", "only_cameras"):
        if not isinstance(data.get(name, ""), (str, type(None))):
            raise UserError(f"{source}: data.{name} is not text; restore it or train again")
    if not isinstance(data.get("min_frames", 0), int):
        raise UserError(f"{source}: data.min_frames is not a whole number; restore it or train again")


def _number(value: Any, low: float, high: float) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and low <= value <= high  # False for NaN


def _vector(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(_number(x, -MAX_MAGNITUDE, MAX_MAGNITUDE) for x in value)


class Moving(Protocol):
    """Scene, as far as its motion is checked."""

    def gaussians_at(self, time: float) -> Gaussians: ...

    def control_points_at(self, time: float) -> Tensor: ...


def check_motion(scene: Moving, source: str, chunks: int = 1) -> None:
    """Check that the Gaussians and the control points are finite at the beginning, the middle and the end of the
    motion, or of each of its chunks: finite parameters may lead to non-finite poses.

    Raises:
        UserError: naming the time and the attribute.
    """
    for time in sorted({(chunk + share) / chunks for chunk in range(chunks) for share in CHECKED_TIMES}):
        posed = scene.gaussians_at(time)
        for name in ("means", "quats", "scales", "sh_dc"):
            if not bool(torch.isfinite(getattr(posed, name)).all()):
                raise _unusable(source, f"at time {time:g} the Gaussians' {name} are not finite")
        if not bool(torch.isfinite(scene.control_points_at(time)).all()):
            raise _unusable(source, f"at time {time:g} the control points are not finite")


def check_resumed(tensors: Mapping[str, Tensor], metadata: Mapping[str, Any], source: str) -> None:
    """Check the state that resuming needs besides the scene: statistics, moments, the graph of control points.

    Raises:
        UserError: naming the tensor or the field.
    """
    count = len(tensors["gaussians.means"])
    for name in ("grad_norm", "count", "max_radii"):
        statistic = tensors.get(f"stats.{name}")
        if statistic is None or statistic.shape != (count,):
            raise _unusable(source, f"stats.{name} is missing or not [{count}]")
    for name in ("points", "colors"):
        if name in tensors and (tensors[name].ndim != 2 or tensors[name].shape[1] != 3):
            raise _unusable(source, f"{name} is {list(tensors[name].shape)}, not [P, 3]")
    if len(tensors.get("points", ())) != len(tensors.get("colors", ())):
        raise _unusable(source, "points and colors differ in number")
    for name, value in tensors.items():
        if name.endswith(".exp_avg_sq") and value.numel():
            if float(value.min()) < 0:
                raise _unusable(source, f"{name} holds negative numbers")
            mean = tensors.get(name.removesuffix("_sq"))
            if mean is None or mean.shape != value.shape or _beyond(mean, value):
                raise _unusable(source, f"{name} and its exp_avg are not of the same gradients")
        if name.endswith(".step") and (value.ndim != 0 or not 0 <= float(value) < MAX_MAGNITUDE):
            raise _unusable(source, f"{name} is not a number of steps")
    if not _number(metadata.get("extent"), 1 / MAX_MAGNITUDE, MAX_MAGNITUDE) or metadata.get("stage") not in (
        "pretrain",
        "main",
    ):
        raise _unusable(source, "metadata.extent or metadata.stage is missing or none")
    _check_graph(tensors, source)


def _beyond(mean: Tensor, square: Tensor) -> bool:
    """Return whether moments are impossible: with Adam's rates the mean is at most 7.3 times the root of the mean
    square. Squares below ``MIN_MOMENT`` may have been rounded to 0."""
    return bool((mean.double().square() > 1000.0 * square.double() + MIN_MOMENT).any())


def _check_graph(tensors: Mapping[str, Tensor], source: str) -> None:
    neighbors, weights = tensors.get("extra.graph.neighbors"), tensors.get("extra.graph.weights")
    if neighbors is None and weights is None:
        return
    nodes = len(tensors.get("motion.positions", tensors["gaussians.means"]))  # In stage 1 they are the same.
    fits = neighbors is not None and weights is not None and neighbors.shape == weights.shape and neighbors.ndim == 2
    if not fits or neighbors is None or neighbors.dtype != torch.int32 or len(neighbors) != nodes:
        raise _unusable(source, f"extra.graph.neighbors and weights are not both [{nodes}, J]")
    if neighbors.numel() and not -1 <= int(neighbors.min()) <= int(neighbors.max()) < nodes:
        raise _unusable(source, f"extra.graph.neighbors names control points outside of the {nodes}")


def reason(error: Exception) -> str:
    """Shorten the text of a loading error, in which PyTorch lists every tensor."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 200 else f"{text[:200]} ..."
