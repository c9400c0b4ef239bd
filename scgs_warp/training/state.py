"""State of a training run at one step; it can be saved and resumed with bit-identical results."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from ..config.presets import TrainConfig, to_dict
from ..config.recorded import with_newer_fields
from ..data.dataset import Dataset
from ..errors import UserError
from ..gaussians import GaussianParameters
from ..geometry.cameras import Overview
from ..geometry.normalisation import COMMON_RADIUS, Normalisation
from ..motion import ControlPoints
from ..motion.base import Motion
from ..motion.spheres import Spheres
from ..optim import Adam
from ..scene import frame_colors
from ..scene.scene import Scene, scene_from
from ..scene.validation import check_metadata, check_motion, check_resumed, check_tensors, reason
from ..storage import checkpoint
from ..types import Stats
from .automatic import has_initial_points, resolve_auto
from .body_turn import BodyTurn
from .camera_refinement import CameraRefinement
from .depth import depth_applies
from .exposure import Exposure
from .initial_models import (
    control_points_from_spheres,
    initial_gaussians,
    initial_motion,
    initial_spheres,
)
from .initial_points import initial_points
from .process_group import ProcessGroup
from .recall import RecallPeriod
from .resuming import as_begun, check_same_configuration, check_same_frames, check_steps
from .scene_distance import place
from .silhouettes import half_thickness
from .sphere_density import thin_spheres
from .start_motion import learn_motion
from .stereo_depth import StereoDepths, stereo_depths

Stage = Literal["pretrain", "main"]
THICKEST = 2.0
"""Largest radius of the spheres at the start, in units of half the subject's thickness."""


class StepResult(NamedTuple):
    """Report of a step: detached scalars averaged over its views, and a picture for previews."""

    step: int
    """Number of steps before this one, of both stages."""
    loss: Tensor
    l1: Tensor
    ssim: Tensor
    regulariser: float
    """Weighted regulariser; 0 in steps without the term."""
    render: Tensor
    truth: Tensor
    mask: Tensor | None
    """[H, W] bool, True where the pixel is valid; None: all pixels are valid."""
    failed: str | None
    """Name of the non-finite term because of which the step was dropped, if any."""
    size: tuple[int, int]
    """Width and height of the step's first view in pixels."""


class TrainState:
    """Parameters, optimisers, statistics and step counts: ``step`` counts both stages, ``stage_step`` the present
    one."""

    def __init__(
        self,
        config: TrainConfig,
        gaussians: GaussianParameters,
        motion: Motion,
        normalisation: Normalisation,
        overview: Overview,
        extent: float,
        points: Tensor,
        colors: Tensor,
        *,
        stage: Stage,
        fingerprint: str,
        frames: int = 0,
        step: int = 0,
        data: Dataset | None = None,
    ) -> None:
        self.config, self.normalisation, self.overview = config, normalisation, overview
        self.extent, self.points, self.colors = extent, points, colors
        self.stage: Stage = stage
        self.step, self.fingerprint = step, fingerprint
        self.failures = 0
        self.recalls = RecallPeriod()
        """Steps that may draw back Gaussians, if a step has a single view."""
        self.group: ProcessGroup | None = None
        """Processes that share each step's views; not part of a checkpoint."""
        self.images: dict[str, str] = {}
        """``thumbnails`` of the splits, for the checkpoint."""
        self.stereo: StereoDepths | None = None
        """Depth of the frames of a rig, if it has been found; not part of a checkpoint."""
        self.consistent = True
        """False between an update of the parameters and the increment of ``step``; such a state must not be saved."""
        self.cameras = CameraRefinement(frames if config.optim.cameras > 0 else 0).to(gaussians.means.device)
        self.camera_optimizer = self.cameras.optimizer()
        self.exposure = Exposure.of(data if config.optim.frame_colors > 0 else None).to(gaussians.means.device)
        self.exposure_optimizer = self.exposure.optimizer() if len(self.exposure) else None
        self.enter(gaussians, motion)

    def enter(self, gaussians: GaussianParameters, motion: Motion) -> None:
        """Replace the models, with fresh optimisers and statistics."""
        self.gaussians, self.motion = gaussians, motion
        self.gaussian_optimizer = Adam(dict(gaussians.named_parameters()), self.gaussian_rates())
        self.motion_optimizer = motion.optimizer(self.config)
        self.reset_stats()

    @staticmethod
    def begin(config: TrainConfig, data: Dataset, device: str, turn: BodyTurn | None = None) -> TrainState:
        """Make the state at step 0.

        Args:
            turn: that of the subject; stage 1 then begins with points of the middle instant.
        """
        normalisation, overview, _ = place(data)
        config = resolve_auto(config, data)
        initial = initial_points(config, data, normalisation, turn)
        points, colors = initial.points.to(device), initial.colors.to(device)
        # Cameras that stand still have no extent; the extent of the content is used instead.
        extent = max(data.extent * normalisation.scale, COMMON_RADIUS)
        rest = (normalisation, overview, extent, points, colors)
        identity = {"fingerprint": data.fingerprint, "frames": len(data), "data": data}
        if config.pretrain_steps > 0:
            wide = THICKEST * half_thickness(data, normalisation) if config.pretrain.silhouette > 0 else math.inf
            spheres = initial_spheres(config, points, colors, device, wide)
            return TrainState(config, *spheres, *rest, stage="pretrain", **identity)
        gaussians = initial_gaussians(config, points, colors)
        # Control points start on what is seen, not on bare walls.
        moves, shown = initial.moves.to(device), points[: len(initial.moves)]
        motion = initial_motion(config, shown, len(data.times.unique()), moves).to(device)
        if isinstance(motion, ControlPoints) and initial.motion is not None and len(initial.motion.clouds) > 1:
            learn_motion(motion, initial.motion, shown[~moves].cpu(), config)
        state = TrainState(config, gaussians, motion, *rest, stage="main", **identity)
        state.stereo = initial.stereo
        return state

    def begin_main(self) -> None:
        """Enter the main stage: spheres become control points, and Gaussians are made."""
        assert isinstance(self.motion, Spheres)
        nodes, solid = self.config.motion.nodes, self.config.pretrain.solid_opacity
        thin_spheres(self.gaussians, self.gaussian_optimizer, self.motion, nodes, solid)
        points = control_points_from_spheres(self.gaussians, self.motion, self.config)
        gaussians = initial_gaussians(self.config, self.points, self.colors, (self.gaussians, self.motion))
        self.stage = "main"
        self.enter(gaussians, points)

    @property
    def steps_again(self) -> int:
        """Number of steps of a second try at stage 1 that is to come."""
        to_come = self.stage == "pretrain" and self.config.pretrain.arap_by == "auto"
        return self.config.pretrain_steps if to_come else 0

    @property
    def device(self) -> torch.device:
        return self.gaussians.means.device

    @property
    def stage_step(self) -> int:
        return self.step if self.stage == "pretrain" else self.step - self.config.pretrain_steps

    def compared_stereo(self, data: Dataset) -> StereoDepths | None:
        """Return the depth by stereo that steps to come compare (``loss.stereo``); None if none do. It is found again
        after a checkpoint."""
        config, step = self.config, 0 if self.stage == "pretrain" else self.stage_step
        compares = config.loss.stereo and depth_applies(step, config) and config.motion.model != "static"
        if not compares or data.with_alpha or data.with_depth or not has_initial_points(data, config):
            self.stereo = None
        elif self.stereo is None:
            self.stereo = stereo_depths(data, self.normalisation)
        return self.stereo

    @property
    def refines_cameras(self) -> bool:
        return len(self.cameras.twists) > 0 and self.stage == "main" and self.stage_step >= self.config.rest_steps

    def optimizers(self) -> list[Adam]:
        every = [self.gaussian_optimizer, self.motion_optimizer, self.camera_optimizer, self.exposure_optimizer]
        return [optimizer for optimizer in every if optimizer is not None]

    def reset_stats(self) -> None:
        absolute = self.config.densify.absolute_grad and self.stage == "main"
        self.stats = Stats.zeros(len(self.gaussians), self.device, absolute)

    def gaussian_rates(self) -> dict[str, float]:
        """Return the learning rates of the Gaussians: constant rates, and the initial values of the decaying ones."""
        rates, spheres = self.config.optim, self.stage == "pretrain"
        return {
            "means": rates.means,
            "quats": rates.quats,
            "log_scales": rates.scales,
            "opacity_logits": self.config.pretrain.opacity_rate if spheres else rates.opacity,
            "sh_dc": self.config.pretrain.color_rate if spheres else rates.sh_dc,
            "sh_rest": rates.sh_rest,
            "hyper": rates.hyper * self.config.motion.hyper_stretch,
            "shading": rates.shading,
            "correctives": rates.correctives,
        }

    def scene(self) -> Scene:
        """Return the present scene for evaluation and pictures; it shares the parameters."""
        return Scene(self.gaussians, self.motion, self.normalisation, self.config, self.overview, step=self.step)

    def save(self, folder: Path) -> None:
        """Write the checkpoint; only the first process does."""
        if self.group is not None and not self.group.first:
            return
        tensors = dict(self.scene().tensors())
        tensors.update(self.gaussian_optimizer.tensors("adam.gaussians"))
        if self.motion_optimizer is not None:
            tensors.update(self.motion_optimizer.tensors("adam.motion"))
        if len(self.cameras.twists):
            tensors["cameras.twists"] = self.cameras.twists
            tensors.update(self.camera_optimizer.tensors("adam.cameras"))
        if self.exposure_optimizer is not None:
            tensors[f"{frame_colors.PREFIX}offsets"] = self.exposure.offsets
            tensors[f"{frame_colors.PREFIX}times"] = self.exposure.times
            tensors.update(self.exposure_optimizer.tensors("adam.exposure"))
        tensors.update({f"extra.{name}": value for name, value in self.motion.extra_state().items()})
        for name in ("grad_norm", "count", "max_radii"):
            tensors[f"stats.{name}"] = getattr(self.stats, name)
        if self.stage == "pretrain":  # the main stage starts from the spheres
            tensors["points"], tensors["colors"] = self.points, self.colors
        metadata = {
            **self.scene().metadata(),
            "stage": self.stage,
            "extent": self.extent,
            "failures": self.failures,
            "recalls": list(self.recalls),
            "frames": self.fingerprint,
            "images": self.images,
        }
        checkpoint.write(folder, tensors, metadata)

    @staticmethod
    def resume(folder: Path, config: TrainConfig, data: Dataset, device: str) -> TrainState:
        """Continue from the checkpoint in ``folder``.

        Raises:
            UserError: the checkpoint is missing, damaged, or made with another configuration.
        """
        tensors, metadata = checkpoint.read(folder)
        source = str(folder / checkpoint.FILE)
        check_metadata(metadata, source)
        saved = with_newer_fields(metadata["config"], recorded=True)
        data = as_begun(data, config, saved.get("init_from"))
        config = resolve_auto(config, data)
        wanted = to_dict(config)
        check_same_configuration({"data": saved.get("data")}, {"data": wanted["data"]}, source)
        # Settings that the data chooses differ with the frames, so the frames come before them.
        check_same_frames(metadata, data, source)
        check_same_configuration(saved, wanted, source)
        check_tensors(tensors, source)
        check_resumed(tensors, metadata, source)
        check_steps(metadata["step"], config, source)
        tensors = checkpoint.to_device(tensors, device)
        scene = scene_from(tensors, metadata, device, source)
        nothing = torch.zeros(0, 3, device=device)
        try:
            state = TrainState(
                config,
                scene.gaussians,
                scene.motion,
                scene.normalisation,
                scene.overview,
                float(metadata["extent"]),
                tensors.get("points", nothing),
                tensors.get("colors", nothing),
                stage=metadata["stage"],
                fingerprint=data.fingerprint,
                frames=len(data),
                step=scene.step,
                data=data,
            )
            state.gaussian_optimizer.load_tensors("adam.gaussians", tensors)
            if state.motion_optimizer is not None:
                state.motion_optimizer.load_tensors("adam.motion", tensors)
            if len(state.cameras.twists):
                state.cameras.load_state_dict({"twists": tensors["cameras.twists"]})
                state.camera_optimizer.load_tensors("adam.cameras", tensors)
            if state.exposure_optimizer is not None:
                state.exposure.load_state_dict({"offsets": tensors[f"{frame_colors.PREFIX}offsets"]})
                state.exposure_optimizer.load_tensors("adam.exposure", tensors)
            state.motion.load_extra_state(checkpoint.strip(tensors, "extra."))
            stats = checkpoint.strip(tensors, "stats.")
            state.stats = Stats(stats["grad_norm"], stats["count"], stats["max_radii"], absolute=state.stats.absolute)
            state.failures = int(metadata["failures"])
            state.recalls = RecallPeriod(*map(int, metadata.get("recalls", ())))
        except (KeyError, IndexError, ValueError, RuntimeError, TypeError) as error:
            raise UserError(f"{source}: cannot be resumed ({reason(error)}); train again without --resume") from error
        state.motion.eval()
        check_motion(state.scene(), source, config.motion.chunks)
        state.motion.train()
        return state
