"""Long films: one deformation network per chunk of time, blended around the borders between chunks.

All chunks share the control points and the Gaussians. Each network sees its chunk's time from 0 to 1, as the network of
a short film does, so that a film may be as long as one likes: neither the finest motion that can be learnt nor the
cost of a step depends on its length.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import torch
from torch import Tensor, nn

from .network import DeformationNetwork

OVERLAP = 0.05
"""Share of a chunk's length by which its network reaches beyond each border: at 250 frames a chunk, two networks are
blended over 25 frames."""


def shares_at(time: float, chunks: int) -> dict[int, float]:
    """Return the weights of the chunks at ``time``, by index: one that has all of it, or two neighbours that sum to 1.
    The weights and their first derivatives are continuous in time."""
    scaled = time * chunks
    own = min(max(int(scaled), 0), chunks - 1)
    after_border = (scaled - own) / OVERLAP
    before_border = (own + 1 - scaled) / OVERLAP
    if after_border < 1.0 and own > 0:
        other, distance = own - 1, after_border
    elif before_border < 1.0 and own < chunks - 1:
        other, distance = own + 1, before_border
    else:
        return {own: 1.0}
    across = 0.5 - 0.5 * distance
    share = across * across * (3.0 - 2.0 * across)
    return {own: 1.0 - share, other: share}


def empty_chunk(times: Sequence[float], chunks: int) -> int | None:
    """Return the index of the first chunk in which none of ``times`` lies; None if there is no such chunk."""
    filled = {min(int(time * chunks), chunks - 1) for time in times}
    return next((chunk for chunk in range(chunks) if chunk not in filled), None)


class ChunkedNetwork(nn.Module):
    """Networks of consecutive chunks of time, all of the same length; evaluated as :class:`DeformationNetwork` is.

    A step evaluates, and so trains, the networks of its times only.
    """

    def __init__(self, make: Callable[[int], DeformationNetwork], chunks: int) -> None:
        """``make`` gives the network of a chunk, by index."""
        super().__init__()
        self.chunks = nn.ModuleList([make(chunk) for chunk in range(chunks)])
        self.heads = cast(DeformationNetwork, self.chunks[0]).heads

    def forward(self, positions: Tensor, times: Tensor) -> dict[str, Tensor]:
        """Evaluate every position at every time; see :meth:`DeformationNetwork.forward`."""
        return dict(zip(self.heads, self.motion(positions, times).split(list(self.heads.values()), dim=-1)))

    def motion(self, positions: Tensor, times: Tensor) -> Tensor:
        """Return the heads' outputs side by side, [T, M, sum of their widths]. On a GPU this waits for the times."""
        instants = [float(time) for time in times.tolist()]
        shares = [shares_at(time, len(self.chunks)) for time in instants]
        parts: list[list[Tensor]] = [[] for _ in instants]
        for chunk in sorted({chunk for share in shares for chunk in share}):
            own = [i for i, share in enumerate(shares) if chunk in share]
            local = times.new_tensor([instants[i] * len(self.chunks) - chunk for i in own])
            for i, values in zip(own, cast(DeformationNetwork, self.chunks[chunk]).motion(positions, local).unbind()):
                weight = shares[i][chunk]
                parts[i].append(values if weight == 1.0 else weight * values)
        if not parts:
            return positions.new_zeros(0, len(positions), sum(self.heads.values()))
        return torch.stack([values[0] if len(values) == 1 else values[0] + values[1] for values in parts])
