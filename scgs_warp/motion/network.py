"""The deformation network Psi: positional encoding and an MLP with one skip (paper section 4.1; seed S4)."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def encode(values: Tensor, frequencies: int) -> Tensor:
    """[..., D] -> [..., D (1 + 2 F)]: the values, then sin and cos of 2^k times them, k = 0 .. F - 1."""
    octaves = 2.0 ** torch.arange(frequencies, device=values.device, dtype=values.dtype)
    angles = (values[..., None, :] * octaves[:, None]).flatten(-2)
    return torch.cat([values, angles.sin(), angles.cos()], dim=-1)


class DeformationNetwork(nn.Module):
    """Position and time to the channels of a rigid motion: ``heads`` name the outputs and their widths.

    Eight layers of 256 by default; the output of layer ``skip`` is concatenated with the input. The heads start at
    almost zero, so the scene starts at rest.
    """

    def __init__(
        self,
        heads: dict[str, int],
        *,
        layers: int = 8,
        width: int = 256,
        skip: int = 4,
        position_frequencies: int = 10,
        time_frequencies: int = 6,
        bfloat16: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.position_frequencies, self.time_frequencies = position_frequencies, time_frequencies
        self.skip, self.low_precision = skip, bfloat16
        inputs = 3 * (1 + 2 * position_frequencies) + 1 + 2 * time_frequencies
        self.layers = nn.ModuleList()
        for i in range(layers):
            fan_in = inputs if i == 0 else width + (inputs if i == skip else 0)
            layer = nn.Linear(fan_in, width)
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
            nn.init.zeros_(layer.bias)
            self.layers.append(layer)
        self.heads = dict(heads)
        self.head = nn.Linear(width, sum(heads.values()))
        nn.init.normal_(self.head.weight, std=1e-5, generator=generator)
        nn.init.zeros_(self.head.bias)

    def forward(self, positions: Tensor, times: Tensor) -> dict[str, Tensor]:
        """Every position at every time.

        Args:
            positions: [M, 3] rest positions in the normalised scene.
            times: [T] in [0, 1].

        Returns:
            one tensor [T, M, width] per head.
        """
        count, instants = positions.shape[0], times.shape[0]
        where = encode(positions, self.position_frequencies)[None].expand(instants, -1, -1)
        when = encode(times[:, None], self.time_frequencies)[:, None].expand(-1, count, -1)
        inputs = torch.cat([where, when], dim=-1).reshape(instants * count, -1)
        with torch.autocast(inputs.device.type, torch.bfloat16, enabled=self.low_precision and self.training):
            hidden = inputs
            for i, layer in enumerate(self.layers):
                if i == self.skip:
                    hidden = torch.cat([inputs, hidden], dim=-1)
                hidden = layer(hidden).relu()
        out = self.head(hidden.float()).reshape(instants, count, -1)
        return dict(zip(self.heads, out.split(list(self.heads.values()), dim=-1)))
