"""Extreme values for kernels and their seeded placement in tensors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


def _around(*values: float) -> list[float]:
    """Return each value and its two neighbours in float32."""
    found = []
    for value in values:
        own = np.float32(value)
        found += [float(np.nextafter(own, np.float32(0))), float(own), float(np.nextafter(own, np.float32(np.inf)))]
    return found


BROKEN = (np.nan, np.inf, -np.inf)
"""Values that make a Gaussian invalid: it alone is left out."""

DENORMAL = np.array([1, 0x80000001, 0x007FFFFF, 0x807FFFFF, 0x00400000], np.uint32).view(np.float32)
"""Bit patterns of denormals; a literal would be flushed to zero."""

ODD = (
    *(0.0, -0.0, 1.1754944e-38, -1.1754944e-38),  # zeros, least normals
    *(3.4028235e38, -3.4028235e38, 1e30, -1e30, 1e20, -1e20, 1e10, -1e10, 2147483648.0, -2147483648.0),
    *_around(1 / 255, 0.999, 1e-4, 0.01, 0.3, 1.0),  # alpha, its bound, transmittance, near plane, eps2d
    *(-1.0, -0.5, -1e-3, 1e-12, 1e-20, 1e-30, 1000.0, 0.5),
)
"""Finite values at thresholds and at the ends of float32."""

TABLE = np.concatenate([np.array([*BROKEN, *ODD], np.float32), DENORMAL])


@dataclass
class Draw:
    """Random choices of one case, from its seed."""

    seed: int

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def pick(self, values: Sequence):
        return values[int(self.rng.integers(len(values)))]

    def chance(self, share: float = 0.5) -> bool:
        return bool(self.rng.random() < share)

    def count(self) -> int:
        """Return a count: 0, 1, around a register's width, a few, sometimes many."""
        if self.chance(0.01):
            return int(self.rng.integers(1000, 5000))
        few = (0, 1, 2, 3, 15, 16, 17, 31, 32, 33, 40, 64, 65, 100, 200, int(self.rng.integers(1, 600)))
        return int(self.pick(few))

    def size(self) -> tuple[int, int]:
        """Return width and height from 1 to 257, mostly small or near multiples of a tile."""
        sides = (1, 2, 3, 7, 15, 16, 17, 31, 32, 33, 47, 48, 49, 64)
        if self.chance(0.05):
            sides = (100, 127, 128, 129, 255, 256, 257, int(self.rng.integers(1, 258)))
        return int(self.pick(sides)), int(self.pick(sides))

    def normal(self, *shape: int, scale: float = 1.0) -> Tensor:
        return torch.from_numpy((scale * self.rng.standard_normal(shape)).astype(np.float32))

    def uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return torch.from_numpy(self.rng.uniform(low, high, shape).astype(np.float32))

    def share(self) -> float:
        """Return the share of poisoned rows."""
        return float(self.pick((0.0, 0.02, 0.1, 0.3, 0.6, 0.95)))

    def values(self, count: int) -> Tensor:
        """Return values from the table, sometimes of one kind, sometimes arbitrary bit patterns."""
        kind = self.pick(("any", "any", "broken", "odd", "one", "bits"))
        if kind == "bits":
            bits = self.rng.integers(0, 2**32, count, dtype=np.uint64).astype(np.uint32)
            return torch.from_numpy(bits.view(np.float32).copy())
        table = {"any": TABLE, "broken": TABLE[: len(BROKEN)], "odd": TABLE[len(BROKEN) :]}.get(kind)
        if table is None:
            table = TABLE[[int(self.rng.integers(len(TABLE)))]]
        return torch.from_numpy(table[self.rng.integers(len(table), size=count)])

    def poison(self, tensor: Tensor, rows: Tensor | None = None) -> None:
        """Put values into single elements or whole rows of ``tensor``, in place, in the marked rows (None: anywhere).

        A tensor of one row (a camera, a background) is hit as a whole or in one element.
        """
        if tensor.numel() == 0:
            return
        flat = tensor.view(len(tensor), -1) if tensor.ndim > 1 else tensor.view(-1, 1)
        hit = torch.zeros(flat.shape, dtype=torch.bool)
        marked = torch.arange(len(flat)) if rows is None else torch.where(rows)[0]
        if not len(marked):
            return
        if self.chance(0.3):
            hit[marked] = True
        else:
            columns = torch.from_numpy(self.rng.integers(0, flat.shape[1], len(marked)))
            hit[marked, columns] = True
        flat[hit] = self.values(int(hit.sum()))

    def rows(self, count: int) -> Tensor:
        """[count] which rows are poisoned."""
        return torch.from_numpy(self.rng.random(count) < self.share())


def finite_rows(*tensors: Tensor) -> Tensor:
    """[N] rows without NaN and infinities in any of the tensors [N, ...]."""
    found = torch.ones(len(tensors[0]), dtype=torch.bool)
    for tensor in tensors:
        found &= tensor.detach().cpu().isfinite().reshape(len(tensor), math.prod(tensor.shape[1:])).all(1)
    return found
