"""What every motion model offers: Gaussians at an instant, its own optimiser, and (optionally) a regulariser."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from ..config.presets import TrainConfig
from ..gaussians import GaussianParameters
from ..optim import Adam
from ..types import Gaussians


class TrainingPose(NamedTuple):
    """One training instant."""

    gaussians: Gaussians
    regulariser: Tensor | None
    """Weighted scalar to add to the loss; None: nothing this step."""


class Motion(nn.Module):
    """A scene's motion: the one protocol behind which the seed's four models stand.

    Times are floats in [0, 1]; positions are in the normalised scene.
    """

    name: ClassVar[str]
    moves: ClassVar[bool] = True
    takes_time_tensor: ClassVar[bool] = False
    """Whether :meth:`gaussians_at` also takes the time as a tensor [1] on its device and then neither reads from the
    device nor writes to it: such a frame can be recorded once and replayed (``FrameGraph``)."""

    def gaussians_at(self, gaussians: GaussianParameters, time: float | Tensor) -> Gaussians:
        """Activated Gaussians, posed at ``time``; differentiable."""
        raise NotImplementedError

    def train_at(
        self, gaussians: GaussianParameters, time: float, step: int, config: TrainConfig, seed: int, view: int = 0
    ) -> TrainingPose:
        """As :meth:`gaussians_at`, with what belongs to training: the frozen phase and the regulariser at ``step``.
        ``view``: which one of the step's batch; random draws differ between them."""
        return TrainingPose(self.gaussians_at(gaussians, time), None)

    def control_points_at(self, time: float) -> Tensor:
        """[M, 3] control points at ``time``; [0, 3] for models without."""
        return torch.zeros(0, 3)

    def rates(self, step: int, config: TrainConfig) -> dict[str, float]:
        """Learning rate of every named parameter at this main step."""
        return {}

    def optimizer(self, config: TrainConfig) -> Adam | None:
        """Adam over all parameters, one named group each; None for a model without parameters."""
        parameters = dict(self.named_parameters())
        return Adam(parameters, self.rates(0, config)) if parameters else None

    def extra_state(self) -> dict[str, Tensor]:
        """Tensors beside the parameters that a resumed run needs."""
        return {}

    def load_extra_state(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of :meth:`extra_state`."""
