"""Two lines of advice on a data set before training: its properties, the expected result, and the most useful setting.

Thresholds are angles and shares that a user can check in the pictures. The gains of the settings come from
``docs/quality.md`` and ``docs/design.md``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from ..config.presets import TrainConfig, preset
from ..data.dataset import Dataset, spread
from ..geometry.normalisation import FEWEST_POINTS, Normalisation
from ..types import Frame
from .automatic import fewest_points
from .scene_distance import place
from .silhouettes import is_in_parts, is_thin
from .standing_cameras import LATE, standing_groups
from .vanishing import VIEWS, has_content

MOST_PAIRS = 12
FEWEST_PAIRS = 6
"""Largest and smallest number of pairs of neighbouring frames, seen from nearly the same place, whose brightness is
compared."""
SAME_PLACE = 5.0
"""Largest angle in degrees between two cameras that see a surface in the same light."""
LITTLE_PARALLAX = 5.0
"""Angle in degrees, seen from the scene. If all cameras lie within it, depth cannot be determined reliably."""
MOSTLY_MAPPED = 0.5
"""Share of the frames with depth maps from which depth counts as known."""
BRIEFLY = 0.1
"""Share of the film within which a mover hardly changes its shape, so that several frames together show its depth."""
JUMPS = 10.0
"""Angle in degrees between the cameras of neighbouring instants. Beyond it, the camera jumps at every instant, as in
D-NeRF."""
GAP = 5.0
"""Ratio of a time without frames to the usual distance between instants. Beyond it, the motion in between is
unknown."""
UNSTEADY = 0.08
"""Relative change of brightness between neighbouring frames that indicates a change of exposure."""
MOSTLY_BEHIND = 0.2
"""Share of the (camera, point) pairs whose point lies before the camera; below it, the cameras look away from the
points."""
WIDE_ARC = 0.02
"""Smallest eigenvalue of the mean of I - d d^T over the optical axes d from which the place where they meet is known;
it corresponds to an arc of about 20 degrees."""
FEW_STEPS = 7_000
"""Number of steps, those of the preset quick, below which thin or fast parts of a moving subject may be lost."""
FEW_VISITS = 20
"""Number of steps per frame below which frames are hardly learnt."""
LARGE_IMAGE = 1_000_000
"""Number of pixels per image beyond which training is slow on a CPU."""


@dataclass(frozen=True)
class Survey:
    """Properties of a data set."""

    frames: int
    width: int
    height: int
    instants: int
    views: int
    """Largest number of frames that share an instant."""
    arc: float
    """Largest angle in degrees between two cameras, seen from the centre of the scene."""
    turn: float
    """Median angle in degrees between the cameras of neighbouring instants."""
    gap: tuple[float, float]
    """Beginning and end of the longest interval without a frame."""
    typical_gap: float
    """Median interval between neighbouring instants, of one camera if several stand still."""
    cut_out: bool
    """True where alpha separates objects from the background."""
    thin: bool
    """True if the subject is thin (:func:`silhouettes.is_thin`)."""
    in_parts: bool
    """True if the subject consists of separate parts (:func:`silhouettes.is_in_parts`)."""
    flicker: float
    """Relative change of brightness between successive frames (the ninth decile), measured where the camera hardly
    moves; of cameras that stand still, between frames of one camera."""
    points: int
    """Number of initial points in the data."""
    sweep: float = 180.0
    """Median angle in degrees between cameras that are ``BRIEFLY`` apart in time, seen from the centre of the scene."""
    look_away: bool = False
    """True if the content lies behind most cameras."""
    depth_maps: int = 0
    """Number of frames with a depth map."""
    standing: int = 0
    """Number of cameras, if all frames are of several that stand still and record at the same time."""
    guessed: bool = False
    """True if the distance of the scene from the cameras is a guess."""
    ends: tuple[float, float] = (0.0, 1.0)
    """First and last time of a frame."""
    blank: bool = False
    """True if the images show nothing but the background."""


def survey(data: Dataset) -> Survey:
    """Examine the cameras and times of all frames, and the pixels of some."""
    times = np.array([entry.time for entry in data.entries])
    instants, counts = np.unique(times, return_counts=True)
    steps = np.diff(instants)
    widest = int(steps.argmax()) if len(steps) else 0
    placed = place(data)
    normalisation = placed.normalisation
    directions = _directions(data, normalisation)
    order = np.argsort(times, kind="stable")
    near = directions[order]
    following = np.degrees(np.arccos(np.clip(np.einsum("vi,vi->v", near[1:], near[:-1]), -1, 1)))
    some = directions[spread(len(directions), 400)]
    groups = standing_groups(data, [normalisation.apply_camera(camera) for camera in data.cameras])
    if groups and not _together([times[group] for group in groups]):
        groups = []
    own_steps = np.concatenate([np.diff(times[group]) for group in groups]) if groups else steps
    close = [(int(order[i]), int(order[i + 1])) for i in np.flatnonzero(following < SAME_PLACE)]
    first = data.entries[0].camera
    return Survey(
        frames=len(data),
        width=first.width,
        height=first.height,
        instants=len(instants),
        views=int(counts.max()),
        arc=float(np.degrees(np.arccos(np.clip((some @ some.T).min(), -1, 1)))),
        turn=float(np.median(following)) if len(following) else 0.0,
        gap=(float(instants[widest]), float(instants[widest + 1])) if len(steps) else (0.0, 0.0),
        typical_gap=float(np.median(own_steps)) if len(own_steps) else 0.0,
        cut_out=bool(data.with_alpha),
        thin=is_thin(data),
        in_parts=is_in_parts(data),
        flicker=_flicker(data, [pair for group in groups for pair in pairwise(group)] or close),
        points=0 if data.points is None else len(data.points),
        sweep=_sweep(near, times[order]),
        look_away=looks_away(data),
        depth_maps=len(data.with_depth),
        standing=len(groups),
        guessed=placed.guessed,
        ends=(float(instants[0]), float(instants[-1])),
        blank=not any(has_content(data, index) for index in spread(len(data), VIEWS)),
    )


def _sweep(directions: np.ndarray, times: np.ndarray) -> float:
    """Measure ``Survey.sweep`` from directions [V, 3] in the order of their times [V]."""
    later = np.searchsorted(times, times + BRIEFLY - 1e-6)
    pairs = np.flatnonzero(later < len(times))
    if len(pairs) == 0:
        return 180.0
    cosines = np.einsum("vi,vi->v", directions[pairs], directions[later[pairs]])
    return float(np.median(np.degrees(np.arccos(np.clip(cosines, -1, 1)))))


def looks_away(data: Dataset) -> bool:
    """Return whether the content lies behind most of the cameras: the sparse points or, without points, the place where
    the optical axes meet, if they meet behind all cameras of a wide arc."""
    cameras = [data.entries[index].camera for index in spread(len(data), 100)]
    viewmats = torch.stack([camera.viewmat.double().cpu() for camera in cameras])
    if data.points is not None and len(data.points) >= FEWEST_POINTS:
        points = data.points[spread(len(data.points), 1000)].double()
        depths = points @ viewmats[:, 2, :3].T + viewmats[:, 2, 3]
        return float((depths > 0).double().mean()) < MOSTLY_BEHIND
    axes = viewmats[:, 2, :3]
    positions = -torch.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    if float(torch.linalg.eigvalsh(across.mean(0))[0]) < WIDE_ARC:
        return False
    centre = torch.linalg.solve(across.sum(0), torch.einsum("vij,vj->i", across, positions))
    depths = torch.einsum("vi,vi->v", centre - positions, axes)
    return bool((depths < 0).all())


def _together(times: list[np.ndarray]) -> bool:
    """Return whether most frames of each camera have one of another camera at about the same time."""
    reach = LATE * float(np.median(np.concatenate([np.diff(own) for own in times])))
    close = []
    for number, own in enumerate(times):
        others = np.sort(np.concatenate([each for other, each in enumerate(times) if other != number]))
        after = np.searchsorted(others, own).clip(1, len(others) - 1)
        close.append(np.minimum(np.abs(own - others[after - 1]), np.abs(own - others[after])) <= reach)
    return bool(np.concatenate(close).mean() > 0.5)


def _directions(data: Dataset, normalisation: Normalisation) -> np.ndarray:
    """Return the unit vectors [V, 3] from the centre of the scene to the cameras."""
    centre = normalisation.centre
    offsets = np.stack([camera.position.double().cpu().numpy() for camera in data.cameras]) - centre
    return offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)


def _flicker(data: Dataset, pairs: list[tuple[int, int]]) -> float:
    """Measure the change of exposure between successive frames that are seen from nearly the same place."""
    changes = []
    if len(pairs) < FEWEST_PAIRS:
        return 0.0
    for chosen in spread(len(pairs), MOST_PAIRS):
        before, after = (_brightness(data[index], data.background == "white") for index in pairs[chosen])
        if before > 0 and after > 0:
            changes.append(abs(math.log(after / before)))
    return math.expm1(float(np.quantile(changes, 0.9))) if changes else 0.0


def _brightness(frame: Frame, on_white: bool) -> float:
    """Return the mean brightness of opaque valid pixels only, so that a figure that fills more of the image does not
    count as brighter."""
    image = frame.image.mean(dim=2).double()
    weight = torch.ones_like(image) if frame.alpha is None else frame.alpha.double()
    if frame.alpha is not None and on_white:
        image = image - (1.0 - weight)
    if frame.mask is not None:
        image, weight = image * frame.mask, weight * frame.mask
    return float(image.sum()) / max(float(weight.sum()), 1e-9)


def advise(facts: Survey, config: TrainConfig, device: str = "cpu") -> tuple[str, str]:
    """Write two lines: the data's properties; the expected result and the most useful setting."""
    cameras = f"one camera, {facts.turn:.1f} degrees from frame to frame"
    locked = facts.frames == facts.views * facts.instants
    if facts.views > 1 and (locked or not facts.standing):
        cameras = f"{facts.views} views of each instant"
    elif facts.standing:
        cameras = f"{facts.standing} cameras that stand still"
    points = f"{facts.points:,} points" if facts.points else "no points"
    points += f", {facts.depth_maps:,} depth maps" if facts.depth_maps else ""
    first = (
        f"data: {facts.frames:,} frames of {facts.width} x {facts.height} at {facts.instants:,} times; {cameras}, "
        f"{facts.arc:.0f} in all; {_content(facts)}; {points}"
    )
    compares = config.loss.depth > 0.0 and facts.depth_maps >= MOSTLY_MAPPED * facts.frames
    return first, f"expect {_expectation(facts, compares)}; {_suggestion(facts, config, device)}"


def _content(facts: Survey) -> str:
    """Say what the images show: it decides how parts that do not fit are treated (``automatic.resolve_auto``)."""
    if not facts.cut_out:
        return "filled images"
    if facts.thin:
        return "cut out by alpha, a thin subject"
    return "cut out by alpha, a subject in parts" if facts.in_parts else "cut out by alpha"


def _expectation(facts: Survey, compares_depth: bool) -> str:
    if facts.look_away:
        return (
            "nothing: the cameras look away from the content; poses in transforms.json are OpenGL's (y up, z backward),"
            " not OpenCV's (y down, z forward)"
        )
    if facts.blank:
        return "nothing: the images show nothing but the background"
    if facts.instants < 2:
        return "a scene at rest: all frames are of one instant"
    if facts.guessed and not compares_depth:
        return "good views near the cameras only: how far away the scene is remains a guess, as they look the same way"
    if facts.arc < LITTLE_PARALLAX and not compares_depth:
        return f"good views near the cameras only: they lie within {facts.arc:.1f} degrees, which leaves depth unknown"
    first, last = facts.ends
    if max(first, 1.0 - last) > max(GAP * facts.typical_gap, 0.05):
        return (
            f"guessed motion before and after the frames, whose times only go from {first:.4g} to {last:.4g}: scale "
            "them to go from 0 to 1"
        )
    if facts.gap[1] - facts.gap[0] > max(GAP * facts.typical_gap, 0.05):
        return f"guessed motion from time {facts.gap[0]:.2f} to {facts.gap[1]:.2f}, where there is no frame"
    if facts.flicker > UNSTEADY:
        return f"averaged colours: brightness changes by {100 * facts.flicker:.0f} % from frame to frame (exposure)"
    if facts.views > 1 or facts.standing:
        return "good views between the cameras at all times: each instant is seen from several sides"
    if facts.turn > JUMPS:
        return (
            "good views from all around where the motion from one instant to the next is small: the camera stands "
            "elsewhere at each"
        )
    if compares_depth:
        return "good views near the camera's path; motion along the line of sight is as good as the depth maps"
    if facts.sweep < LITTLE_PARALLAX:
        return (
            f"good views near the camera's path; it moves by {facts.sweep:.1f} degrees within a tenth of the time, so "
            "the depth of what moves is a guess"
        )
    return "good views near the camera's path; motion along the line of sight stays uncertain"


def progressive_without_effect(config: TrainConfig, frames: int, points: int) -> str | None:
    """Say why progressive pre-training has no effect on data with so many ``frames`` and initial ``points``. None: it
    has an effect, or is off."""
    pretrain = config.pretrain
    if not pretrain.progressive:
        return None
    if config.motion.model != "control-points":
        return f"--progressive has no effect with --motion {config.motion.model}, which has no stage 1"
    if pretrain.steps == 0:
        return "--progressive has no effect without stage 1: pretrain.steps is 0"
    if points >= fewest_points(config) and not pretrain.with_points:  # as automatic.resolve_auto
        return (
            "--progressive has no effect: the data's points take the place of stage 1; "
            "--set pretrain.with_points=true keeps that stage"
        )
    return "--progressive has no effect: there is only one frame" if frames < 2 else None


def _suggestion(facts: Survey, config: TrainConfig, device: str) -> str:
    """Name the setting that improves the result most, or one that was asked for and has no effect."""
    without_effect = progressive_without_effect(config, facts.frames, facts.points)
    if without_effect is not None and not preset(config.preset).pretrain.progressive:
        return without_effect
    if facts.instants < 2 and config.motion.model != "static":
        return "--motion static is all it needs"
    if facts.width * facts.height > LARGE_IMAGE and device == "cpu":
        factor = math.ceil(math.sqrt(facts.width * facts.height / LARGE_IMAGE)) * config.data.downscale
        return f"on a CPU, --downscale {factor} makes it several times faster"
    if facts.cut_out and config.motion.model != "static" and facts.instants > 1 and config.steps < FEW_STEPS:
        return (
            f"{config.steps:,} steps are few: thin or fast parts, such as legs, may be blurred or missing; look for "
            f"them in contact_sheet.png, --steps {FEW_STEPS} usually shows them"
        )
    if facts.flicker > UNSTEADY and config.optim.frame_colors == 0.0:
        return "--set optim.frame_colors=2e-3 gives each frame its own exposure and white balance"
    visits = config.steps * config.batch / facts.frames
    if visits < FEW_VISITS:
        wanted = math.ceil(FEW_VISITS * facts.frames / config.batch / 1000) * 1000
        return f"each frame is seen {visits:.0f} times only: --steps {wanted} sees all of them enough"
    if facts.points < FEWEST_POINTS and not facts.cut_out:
        return "COLMAP's points (ply_file_path, or its sparse model) begin some 2 dB better than random ones"
    if not facts.cut_out and facts.views == 1 and not facts.standing and config.optim.cameras == 0.0:
        return "if the poses are off by more than a pixel, --set optim.cameras=2e-4 corrects them"
    return "the settings fit"
