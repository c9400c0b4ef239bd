"""Small corrections of the training cameras' poses, learnt with the scene: structure from motion is off by a pixel."""

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
    """One element of se(3) for each training frame: ``viewmat' = viewmat exp(twist)``.

    The twists act in the normalised world, about its centre, so that their mean is a motion of the scene as a whole,
    which no image can tell: :meth:`centre` takes it out after every step. Held-out frames keep the poses they were
    given: a correction that is learnt from a frame's own image must not reach the frames the scene is judged by.
    """

    def __init__(self, count: int) -> None:
        super().__init__()
        self.twists: nn.Parameter = nn.Parameter(torch.zeros(count, 6))
        """[V, 6] rotation vector (radians), then translation (normalised units)."""

    def matrices(self, index: Sequence[int] | Tensor) -> Tensor:
        """[n, 4, 4] rigid transforms of the frames ``index`` [n]; differentiable, at the identity too."""
        twists = self.twists[index]
        x, y, z = twists[:, 0], twists[:, 1], twists[:, 2]
        zero = torch.zeros_like(x)
        rows = [zero, -z, y, twists[:, 3], z, zero, -x, twists[:, 4], -y, x, zero, twists[:, 5], *[zero] * 4]
        return torch.linalg.matrix_exp(torch.stack(rows, dim=1).view(-1, 4, 4))

    def apply(self, camera: Camera, index: int) -> Camera:
        """The corrected camera of frame ``index``; ``camera`` sees the normalised scene."""
        return Camera(camera.viewmat @ self.matrices([index])[0], camera.K, camera.width, camera.height)

    def optimizer(self) -> Adam:
        return Adam(dict(self.named_parameters()), {"twists": 0.0})

    def centre(self) -> None:
        """Take out the mean correction."""
        with torch.no_grad():
            ones = torch.ones(1, len(self.twists), device=self.twists.device)
            self.twists.data -= ones @ self.twists / len(self.twists)


def refined(data: Dataset, folder: Path, normalisation: Normalisation) -> Dataset | None:
    """Training frames with the poses that the run in ``folder`` found for them, which are those its scene fits.

    Args:
        data: the split that was trained on, with the poses it was given.
        normalisation: of the run's scene.

    Returns:
        None where the run refined no poses, or those of other frames than these.

    Raises:
        UserError: there is no checkpoint, or it is damaged.
    """
    tensors, metadata = checkpoint.read(folder, ("cameras.",))
    twists = tensors.get("cameras.twists")
    if twists is None or metadata.get("frames") != data.fingerprint or twists.shape != (len(data), 6):
        return None
    found = CameraRefinement(len(data))
    found.twists.data[:] = twists
    cameras = []
    for index, given in enumerate(data.cameras):
        with torch.no_grad():
            camera = found.apply(normalisation.apply_camera(given), index)
        cameras.append(normalisation.undo_camera(camera))
    return data.with_cameras(cameras)


def camera_rate(step: int, optim: OptimConfig, start: int) -> float:
    """Learning rate at this main step: 0 until ``start``, when the scene is worth aligning to; then it decays with that
    of the Gaussians' positions, to a hundredth."""
    if step < start:
        return 0.0
    return log_linear(optim.cameras, 0.01 * optim.cameras, step - start, max(optim.means_until - start, 1))
