"""Protocol of motion models: Gaussians at an instant, an optimiser, and an optional regulariser."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Literal, NamedTuple

import torch
from torch import Tensor, nn

from ..config.presets import OptimConfig, TrainConfig
from ..gaussians import GaussianParameters
from ..ops.activations import exponential
from ..optim import Adam, log_linear
from ..types import Gaussians
from .pose_track import PoseTrack


class MotionStep(NamedTuple):
    """What a training step asks of the motion, decided on the host."""

    times: tuple[float, ...]
    """The view's instant, followed by those at which the regulariser compares."""
    weight: float = 0.0
    """Weight of the regulariser; 0: the step has none."""
    phase: Literal["rest", "frozen", "moving"] = "moving"
    """``rest``: the Gaussians are not moved; ``frozen``: the motion does not learn."""


class TrainingPose(NamedTuple):
    """Posed Gaussians and regulariser of one training view."""

    gaussians: Gaussians
    regulariser: Tensor | None
    """Weighted scalar to add to the loss; None in steps without the term."""


def decay_steps(step: int, still: int, optim: OptimConfig) -> int:
    """Return the number of steps for which the learning rates of the motion have decayed, at this step of a stage that
    trains the motion after ``still`` steps."""
    return step if optim.network_from == "stage" else max(0, step - still)


def network_rate(step: int, still: int, optim: OptimConfig) -> float:
    """Return the network's learning rate at this step of a stage that trains the network after ``still`` steps."""
    rate = log_linear(optim.network, optim.network_end, decay_steps(step, still, optim), optim.network_until)
    return rate * (optim.network_scale or 1.0)


def moved_by(gaussians: GaussianParameters, means: Tensor, quats: Tensor, log_scales: Tensor) -> Gaussians:
    """Activate Gaussians with a change of each one's mean [N, 3], quaternion [N, 4] and log scales [N, 3]."""
    return Gaussians(
        gaussians.means + means,
        gaussians.quats + quats,
        exponential(gaussians.log_scales + log_scales),
        gaussians.opacities(),
        gaussians.sh_dc,
        gaussians.sh_rest,
        gaussians.sharpness,
    )


class Motion(nn.Module):
    """Base class of the motion models.

    Times are floats in [0, 1]; positions are in the normalised scene.
    """

    name: ClassVar[str]
    moves: ClassVar[bool] = True
    takes_time_tensor: bool = False
    """True if :meth:`gaussians_at` also accepts the time as a tensor [1] on the model's device and then copies nothing
    between host and device. Such a frame can be recorded once and replayed (``FrameGraph``)."""

    def gaussians_at(self, gaussians: GaussianParameters, time: float | Tensor) -> Gaussians:
        """Activate the Gaussians and pose them at ``time``; differentiable."""
        raise NotImplementedError

    def means_at(self, gaussians: GaussianParameters, time: float) -> Tensor:
        """Return the Gaussians' means [N, 3] at ``time``; differentiable."""
        return self.gaussians_at(gaussians, time).means

    def plan(
        self, gaussians: GaussianParameters, time: float, step: int, config: TrainConfig, view: int = 0
    ) -> MotionStep:
        """Decide what a view at ``time`` asks for at ``step`` of the stage, and bring the regulariser up to date.

        Args:
            view: index in the step's batch; random draws differ between views.
        """
        return MotionStep((time,))

    def refresh_due(self, step: int, config: TrainConfig) -> bool:
        """Return True if :meth:`plan` reads the trained parameters at this step."""
        return False

    def train_at(
        self,
        gaussians: GaussianParameters,
        plan: MotionStep,
        times: Tensor,
        weight: float | Tensor,
        config: TrainConfig,
    ) -> TrainingPose:
        """Pose the Gaussians for training.

        Args:
            plan: result of :meth:`plan`. It says the phase and whether there is a weight.
            times: [T] the plan's times, on the model's device or on the host.
            weight: the plan's weight, a number or a scalar on the model's device.
        """
        return TrainingPose(self.gaussians_at(gaussians, times[:1]), None)

    def control_points_at(self, time: float) -> Tensor:
        """Return the control points [M, 3] at ``time``; [0, 3] for models without control points."""
        return torch.zeros(0, 3)

    def cache_binding(self, gaussians: GaussianParameters | None) -> None:
        """Keep what the Gaussians' posing has in common at all times, for rendering; with None, discard it. Does
        nothing in models without control points."""

    def keep_poses(
        self,
        gaussians: GaussianParameters,
        tolerance: float,
        tell: Callable[[int, int], None] = lambda done, total: None,
    ) -> bool:
        """Sample the motion once, so that later poses are interpolated; return whether this is done (False: as in
        models without control points).

        Args:
            gaussians: those that the control points move.
            tolerance: largest error of a position, as a share of the control points' extent.
            tell: called with the numbers of instants sampled and of all.
        """
        return False

    @property
    def kept_poses(self) -> PoseTrack | None:
        """The track that poses are interpolated from, if they are kept."""
        return None

    def rates(self, step: int, config: TrainConfig) -> dict[str, float]:
        """Return the learning rate of every named parameter at this main step."""
        return {}

    def optimizer(self, config: TrainConfig) -> Adam | None:
        """Make an Adam optimiser over all parameters, with one named group each; None for a model without
        parameters."""
        parameters = dict(self.named_parameters())
        return Adam(parameters, self.rates(0, config)) if parameters else None

    def extra_state(self) -> dict[str, Tensor]:
        """Return the tensors that a resumed run needs in addition to the parameters."""
        return {}

    def load_extra_state(self, tensors: dict[str, Tensor]) -> None:
        """Restore the tensors returned by :meth:`extra_state`."""
