"""A scene as a page's columns: Gaussians, their control points, and the trajectories of the control points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from ..errors import UserError
from ..gaussians import GaussianParameters
from ..geometry.morton import morton_order
from ..kernels.types import ALPHA_MIN
from ..motion.control_points import ControlPoints
from ..motion.static_nodes import StaticNodes
from ..scene.scene import Scene
from ..types import Pose
from .page_data import Column, common_size, integers, quantise
from .page_parts import part_columns
from .skeleton import continuous

MIN_SAMPLES, MAX_SAMPLES = 33, 257
"""Smallest and largest number of times at which control points are sampled; see ``COARSE_ERROR``. A motion in chunks
may take as many times for each chunk."""
COARSE_ERROR = 8e-4
"""Acceptable error of interpolation halfway between two times (root mean square, normalised units and radians). The
number of times is doubled until the error is below this, and then once more, which leaves about a quarter of the
error."""
POSE_PARTS = ("translation", "rotation", "shape", "log_scale", "tint")
QUATERNIONS = ("rotation", "shape", "own", "turn", "further")
TIMES_AT_ONCE = 16
"""Number of times per evaluation of the network; it limits the memory for many control points."""
STEPS = {
    "mean": 2.5e-5,  # normalised units (the visible scene has a radius of 1.4): a hundredth of a pixel at 800 x 800
    "quat": 1.4e-3,
    "log_scale": 0.02,
    "opacity": 1 / 255,
    "sh_dc": 6e-3,
    "sh_rest": 9e-3,
    "shading": 0.07,
    "corrective": 5e-3,
    "weight": 2e-3,
    "rest": 1e-6,
    "pose": 1e-4,
}
"""Quantisation step of each part; docs/page.md gives the loss of quality."""
FAR = 200.0
"""Distance, normalised units, up to which 24 bits suffice for the quantisation step of positions. A Gaussian is left
out if it is beyond this distance and more than twice as far as 99.9 % of all Gaussians."""
BYTE = 8
"""Largest number of bits of ``sh_rest``, because the page unpacks bytes."""


class HasPoses(Protocol):
    """Motion of control points."""

    def poses(self, times: Tensor) -> list[Pose]: ...


@dataclass(frozen=True)
class PageScene:
    """Facts for a page's header, and its columns."""

    facts: dict[str, Any]
    columns: list[Column]


@dataclass(frozen=True)
class PageMotion:
    """Control points that move Gaussians on a page in another way than the scene's own motion, such as under an
    edit."""

    rest: np.ndarray
    """[M, 3] at rest, normalised units."""
    binding: tuple[Tensor, Tensor]
    """Control points and weights of each Gaussian, [N, K] each."""
    poses: dict[str, np.ndarray]
    """As from :func:`sample_poses`; under an edit also ``own`` and ``turn`` [T, M, 4]: the rotations that shading and
    correctives follow, and those that turn colours. With a motion mask, ``shift`` [T, M, 3] and ``further`` [T, M, 4]
    are the edit's handles, which no share weakens."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Further facts, which replace those of the scene."""
    columns: list[Column] = field(default_factory=list)
    """Further columns."""


def page_scene(
    scene: Scene, sh_degree: int, samples: int | None = None, motion_of: PageMotion | None = None
) -> PageScene:
    """Quantise a scene for a page.

    Args:
        sh_degree: degree of the spherical harmonics, at most the scene's own.
        samples: number of times at which control points are sampled; None: as many as the motion needs.
        motion_of: replaces the scene's motion.

    Raises:
        UserError: the motion model has no control points to skin by, or no Gaussian can be seen.
    """
    gaussians, motion = scene.gaussians, scene.motion
    if not isinstance(motion, ControlPoints | StaticNodes) and motion.moves:
        raise UserError(
            f"web page: the motion model {motion.name} has no control points for a page to move Gaussians by; "
            "train with --motion control-points, or export a film with apps/view.py"
        )
    with torch.no_grad():
        kept = visible(gaussians)
        if not len(kept):
            raise UserError("web page: the scene has no Gaussian that can be seen; train it first")
        kept = kept[near(gaussians.means[kept])]
        order = morton_order(to_array(gaussians.means[kept]))  # neighbours together: deflate compresses them better
        kept = kept[torch.from_numpy(order).to(kept.device)]
        columns = gaussian_columns(gaussians, kept, sh_degree)
        facts = scene_facts(scene, len(kept), sh_degree)
        if motion_of is None and isinstance(motion, ControlPoints):
            poses = sample_poses(motion) if samples is None else one_sided(poses_at(motion, even_times(samples)))
            parts, owners = part_columns(scene) if samples is None else ([], [])  # not while the scene trains
            rest, binding = to_array(motion.positions), motion.binding(gaussians)
            motion_of = PageMotion(rest, binding, poses, {"parts": parts}, owners)
        if motion_of is not None:
            facts.update(masked=bool(scene.config.motion.mask) and motion.moves)
            columns += _binding_columns(motion_of, gaussians, kept, facts)
            columns += pose_columns(motion_of.rest, motion_of.poses, facts) + motion_of.columns
            facts.update(motion_of.facts)
    return PageScene(facts, columns)


def visible(gaussians: GaussianParameters) -> Tensor:
    """Return indices [V] int64 of the Gaussians that are finite and opaque enough to change an 8-bit picture."""
    parts = (
        gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.sh_dc, gaussians.sh_rest.flatten(1),
        gaussians.shading, gaussians.correctives, gaussians.hyper,
    )  # fmt: skip
    finite = torch.stack([part.isfinite().all(dim=1) for part in parts]).all(dim=0)
    solid = gaussians.opacities() >= float(ALPHA_MIN)
    return (finite & solid & gaussians.quats.any(dim=1)).nonzero()[:, 0]


def near(points: Tensor) -> Tensor:
    """Return [N] bool: all points but far outliers, which would coarsen the positions of all others."""
    sizes = points.abs().amax(dim=1)
    return sizes <= max(FAR, common_size(to_array(sizes)))


def to_array(values: Tensor) -> np.ndarray:
    return values.detach().cpu().double().numpy()


def scene_facts(scene: Scene, count: int, sh_degree: int) -> dict[str, Any]:
    """Return the header's facts for ``count`` Gaussians without control points."""
    unit = scene.normalisation
    return {
        "gaussians": count,
        "sh_degree": sh_degree,
        "shaded": scene.gaussians.shading.shape[1] > 0,
        "corrected": scene.gaussians.correctives.shape[1] > 0,
        "antialiased": bool(scene.config.antialiased),
        "sharpness": scene.gaussians.sharpness,
        "background": list(scene.background_color),
        "overview": scene.overview.to_dict(),
        "normalisation": {"centre": unit.centre.tolist(), "scale": unit.scale},
        "nodes": 0,
        "neighbors": 0,
        "samples": 0,
        "parts": [],
        "masked": False,
        "shapes": False,
        "scaled": False,
        "tinted": False,
        "edited": False,
        "turned": False,
    }


def gaussian_columns(
    gaussians: GaussianParameters, kept: Tensor, sh_degree: int, log_scales: Tensor | None = None
) -> list[Column]:
    """Store the Gaussians ``kept``; ``log_scales`` [N, 3] replace their own."""
    means, dc = to_array(gaussians.means[kept]), to_array(gaussians.sh_dc[kept])
    columns = [quantise(f"mean{a}", means[:, a], STEPS["mean"], delta=True) for a in range(3)]
    columns += _quaternion_columns("quat", to_array(gaussians.quats[kept]))
    scales = to_array((gaussians.log_scales if log_scales is None else log_scales)[kept])
    columns += [quantise(f"scale{a}", scales[:, a], STEPS["log_scale"]) for a in range(3)]
    columns.append(quantise("opacity", to_array(gaussians.opacities()[kept]), STEPS["opacity"]))
    columns += [quantise(f"dc{c}", dc[:, c], STEPS["sh_dc"]) for c in range(3)]
    rest = to_array(gaussians.sh_rest[kept])
    for k in range((sh_degree + 1) ** 2 - 1):
        columns += [quantise(f"sh{k}_{c}", rest[:, k, c], STEPS["sh_rest"], most_bits=BYTE) for c in range(3)]
    shading = to_array(gaussians.shading[kept])
    columns += [quantise(f"shading{k}", shading[:, k], STEPS["shading"]) for k in range(shading.shape[1])]
    correctives = to_array(gaussians.correctives[kept])
    for k in range(correctives.shape[1]):
        columns.append(quantise(f"corrective{k}", correctives[:, k], STEPS["corrective"]))
    return columns


def _quaternion_columns(name: str, quats: np.ndarray) -> list[Column]:
    """Store the index of the largest component, which is made positive, and the other three, within 1 / sqrt 2."""
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    quats = np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None] * quats
    others = np.stack([quats[rows, (largest + 1 + k) % 4] for k in range(3)])
    columns = [integers(f"{name}_largest", largest)]
    return columns + [quantise(f"{name}{k}", others[k], STEPS["quat"]) for k in range(3)]


def _binding_columns(
    motion: PageMotion, gaussians: GaussianParameters, kept: Tensor, facts: dict[str, Any]
) -> list[Column]:
    """Store each Gaussian's control points, and all of its weights but the first, since weights sum to one."""
    indices, weights = (value[kept] for value in motion.binding)
    count = indices.shape[1]
    facts.update(nodes=len(motion.rest), neighbors=count)
    columns = [integers(f"node{k}", indices[:, k].cpu().numpy()) for k in range(count)]
    columns += [quantise(f"weight{k}", to_array(weights[:, k]), STEPS["weight"]) for k in range(1, count)]
    if facts["masked"]:
        columns.append(quantise("share", to_array(gaussians.hyper[kept, -1].sigmoid()), STEPS["opacity"]))
    return columns


def pose_columns(rest: np.ndarray, poses: dict[str, np.ndarray], facts: dict[str, Any]) -> list[Column]:
    """Store rest positions [M, 3], and poses [T, M, ...] at evenly spaced times, node by node."""
    facts.update(samples=len(poses["translation"]), shapes="shape" in poses)
    facts.update(scaled="log_scale" in poses, tinted="tint" in poses, turned="turn" in poses)
    facts["edited"] |= facts["turned"]
    columns = [quantise(f"rest{a}", rest[:, a], STEPS["rest"]) for a in range(3)]
    for name, values in poses.items():
        for a in range(values.shape[2]):
            columns.append(quantise(f"{name}{a}", values[:, :, a].T.reshape(-1), STEPS["pose"], delta=True))
    return columns


def even_times(count: int) -> Tensor:
    return torch.linspace(0.0, 1.0, count)


def sample_poses(motion: ControlPoints) -> dict[str, np.ndarray]:
    """Sample ``translation`` [T, M, 3], ``rotation`` [T, M, 4], and if the model has them ``shape`` [T, M, 4] and
    ``log_scale`` or ``tint`` [T, M, 3], at T evenly spaced times, with quaternion signs continuous over time.

    Raises:
        UserError: a pose is not finite.
    """
    count, most = MIN_SAMPLES, (MAX_SAMPLES - 1) * motion.config.chunks + 1
    poses = poses_at(motion, even_times(count))
    while count < most:
        between = poses_at(motion, (torch.arange(count - 1) + 0.5) / (count - 1))
        errors = [(2.0 if name in QUATERNIONS else 1.0) * _error(poses[name], between[name]) for name in poses]
        poses = {name: _interleaved(poses[name], between[name]) for name in poses}
        count = 2 * count - 1
        if max(errors) <= COARSE_ERROR:
            break
    return one_sided(poses)


def one_sided(poses: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Make the signs of all quaternions continuous over time."""
    return {name: continuous(rows) if name in QUATERNIONS else rows for name, rows in poses.items()}


def _interleaved(values: np.ndarray, between: np.ndarray) -> np.ndarray:
    """Interleave [T, ...] and [T - 1, ...] to [2 T - 1, ...]."""
    merged = np.empty((len(values) + len(between), *values.shape[1:]))
    merged[::2], merged[1::2] = values, between
    return merged


def _error(values: np.ndarray, between: np.ndarray) -> float:
    """Return the root mean square distance between the rows halfway between two times and the mean of the rows at these
    times; signs of quaternions do not matter."""
    before, after = values[:-1], values[1:]
    if values.shape[2] == 4:
        before, after = (np.where((x * between).sum(2, keepdims=True) < 0, -x, x) for x in (before, after))
    return float(((0.5 * (before + after) - between) ** 2).sum(axis=2).mean() ** 0.5)


def poses_at(motion: HasPoses, times: Tensor) -> dict[str, np.ndarray]:
    """Return the poses of control points at some times, as :func:`sample_poses`.

    Raises:
        UserError: a pose is not finite.
    """
    samples: dict[str, list[np.ndarray]] = {}
    for part in times.split(TIMES_AT_ONCE):
        for pose in motion.poses(part):
            fields = pose.translations, pose.rotations, pose.shape_rotations, pose.log_scales, pose.tints
            for name, value in zip(POSE_PARTS, fields, strict=True):
                if value is not None:
                    samples.setdefault(name, []).append(to_array(value))
    poses = {name: np.stack(rows) for name, rows in samples.items()}
    if not all(np.isfinite(rows).all() for rows in poses.values()):
        raise UserError(
            "web page: the control points' motion is not finite; train again with a lower rate, or put the "
            "previous checkpoint back"
        )
    return poses
