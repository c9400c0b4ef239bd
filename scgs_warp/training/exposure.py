"""Exposure and white balance: an affine colour for each training frame, learnt with the scene."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ..config.presets import LossConfig
from ..data.dataset import Dataset, neighbors_in_time
from ..optim import Adam


class Exposure(nn.Module):
    """Affine colours [3, 4] of the training frames, as offsets from the identity.

    Their mean is a change of all colours of the scene, which the images do not determine; :meth:`centre` removes it
    after every step. The penalty keeps colours near the identity and near those of the frames before and after, so that
    motion is not explained by light.
    """

    def __init__(self, times: Tensor, neighbors: Tensor) -> None:
        """
        Args:
            times: [V] times of the frames.
            neighbors: [V, 2] indices of the frames before and after; a frame at an end has itself.
        """
        super().__init__()
        self.offsets: nn.Parameter = nn.Parameter(torch.zeros(len(times), 3, 4))
        """[V, 3, 4]"""
        self.times: Tensor
        self.neighbors: Tensor
        self.register_buffer("times", times.float(), persistent=False)
        self.register_buffer("neighbors", neighbors, persistent=False)

    @staticmethod
    def of(data: Dataset | None) -> Exposure:
        """Make identities for the frames of a data set; none without data."""
        if data is None:
            return Exposure(torch.zeros(0), torch.zeros(0, 2, dtype=torch.long))
        return Exposure(data.times.float(), neighbors_in_time(data))

    def __len__(self) -> int:
        return len(self.offsets)

    def color(self, index: int) -> Tensor:
        """Return the affine colour [3, 4] of a frame."""
        return torch.eye(3, 4, device=self.offsets.device) + self.offsets[index]

    def penalty(self, index: int, loss: LossConfig) -> Tensor:
        """Return the penalty on a frame's colour, a scalar."""
        own = self.offsets[index]
        around = self.offsets[self.neighbors[index]].mean(0)
        return loss.frame_colors * own.square().sum() + loss.frame_colors_smooth * (own - around).square().sum()

    def optimizer(self) -> Adam:
        """Make the optimiser; its learning rate is set at every step."""
        return Adam({"offsets": self.offsets}, {"offsets": 0.0})

    def centre(self) -> None:
        """Subtract the mean of all offsets."""
        with torch.no_grad():
            flat = self.offsets.view(len(self.offsets), -1)
            ones = torch.ones(1, len(flat), device=flat.device)
            self.offsets.data -= (ones @ flat / len(flat)).view(1, 3, 4)


def exposed(picture: Tensor, alpha: Tensor, background: Tensor, color: Tensor) -> Tensor:
    """Show a picture as a frame with an affine colour [3, 4] shows it: the background stays as it is.

    Args:
        picture: [3, H, W] on the background.
        alpha: [H, W]
        background: [3]
    """
    behind = (1.0 - alpha) * background[:, None, None]
    # One product, because its gradient to the colour has the same bits on any number of threads, unlike a sum.
    rows = torch.cat([picture - behind, alpha[None]]).flatten(1)
    return (color @ rows).view_as(picture) + behind
