"""Camera refinement: small pose corrections learnt with the scene, because poses from structure from motion are off by
about a pixel."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from ..config.presets import OptimConfig
from ..data.dataset import Dataset
from ..geometry.normalisation import Normalisation
from ..optim import Adam, log_linear
from ..storage import checkpoint
from ..types import Camera


class CameraRefinement(nn.Module):
    """Pose corrections: one element of se(3) for each training frame, ``viewmat' = viewmat exp(twist)``.

    The twists act in the normalised world, about its centre. Their mean is a motion of the whole scene, which the
    images do not determine; :meth:`centre` removes it after every step. Held-out frames keep their given poses: a
    correction learnt from a frame's own image must not affect the frames that judge the scene.
    """

    def __init__(self, count: int) -> None:
        super().__init__()
        self.twists: nn.Parameter = nn.Parameter(torch.zeros(count, 6))
        """[V, 6] rotation vector (radians), then translation (normalised units)."""

    def matrices(self, index: Sequence[int] | Tensor) -> Tensor:
        """Return the rigid transforms [n, 4, 4] of the frames ``index`` [n]; differentiable, also at the identity."""
        twists = self.twists[index]
        x, y, z = twists[:, 0], twists[:, 1], twists[:, 2]
        zero = torch.zeros_like(x)
        rows = [zero, -z, y, twists[:, 3], z, zero, -x, twists[:, 4], -y, x, zero, twists[:, 5], *[zero] * 4]
        return torch.linalg.matrix_exp(torch.stack(rows, dim=1).view(-1, 4, 4))

    def apply(self, camera: Camera, index: int) -> Camera:
        """Correct the camera of frame ``index``; the camera is in the normalised scene."""
        return Camera(camera.viewmat @ self.matrices([index])[0], camera.K, camera.width, camera.height)

    def optimizer(self) -> Adam:
        """Make the optimiser of the twists; its learning rate is set at every step."""
        return Adam(dict(self.named_parameters()), {"twists": 0.0})

    def centre(self) -> None:
        """Subtract the mean of all corrections."""
        with torch.no_grad():
            ones = torch.ones(1, len(self.twists), device=self.twists.device)
            self.twists.data -= ones @ self.twists / len(self.twists)


def refined(data: Dataset, folder: Path, normalisation: Normalisation) -> Dataset | None:
    """Replace the poses of training frames by those refined in the run in ``folder``, because its scene fits these.

    Args:
        data: the training split, with its given poses.
        normalisation: normalisation of the run's scene.

    Returns:
        the data with refined poses; None if the run refined no poses, or the poses of other frames.

    Raises:
        UserError: the checkpoint is missing or damaged.
    """
    tensors, metadata = checkpoint.read(folder, ("cameras.",))
    twists = tensors.get("cameras.twists")
    if twists is None or metadata.get("frames") != data.fingerprint or twists.shape != (len(data), 6):
        return None
    refinement = CameraRefinement(len(data))
    refinement.twists.data[:] = twists
    cameras = []
    for index, given in enumerate(data.cameras):
        with torch.no_grad():
            camera = refinement.apply(normalisation.apply_camera(given), index)
        cameras.append(normalisation.undo_camera(camera))
    return data.with_cameras(cameras)


def camera_rate(step: int, optim: OptimConfig, start: int) -> float:
    """Return the learning rate at this main step: 0 until ``start``, when the scene has taken shape, then decaying
    log-linearly to a hundredth at ``means_until``."""
    if step < start:
        return 0.0
    return log_linear(optim.cameras, 0.01 * optim.cameras, step - start, max(optim.means_until - start, 1))
