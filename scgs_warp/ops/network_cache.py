"""What evaluations of one network on a CPU have in common: its packed weights, and the sums over its positions."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from ..geometry.morton import morton_order
from .network import Layers, PositionSums


class NetworkCache:
    """Packed weights and position sums, valid until a tensor is replaced or changed in place.

    The cache does not notice changes that torch does not count (edits through ``.data``, writes of other libraries).
    Call :meth:`forget` after such changes.
    """

    def __init__(self) -> None:
        self._layers: tuple[list[tuple[int, int]], Layers] | None = None
        self._sums: tuple[Layers, Tensor, int, PositionSums] | None = None

    def forget(self) -> None:
        self._layers = self._sums = None

    def layers(self, parameters: Iterable[Tensor], make: Callable[[], Layers]) -> Layers:
        """Return the packed layers; call ``make`` to pack ``parameters`` if the cache is out of date."""
        parameters = list(parameters)
        if any(p.is_inference() for p in parameters):  # torch does not count changes of inference tensors
            return make()
        key, kept = [(p.data_ptr(), p._version) for p in parameters], self._layers
        if kept is None or kept[0] != key:
            kept = self._layers = key, make()
        return kept[1]

    def position_sums(
        self, layers: Layers, positions: Tensor, encode: Callable[[Tensor], Tensor]
    ) -> PositionSums | None:
        """Return the sums over ``positions`` [M, 3]; call ``encode`` if the cache is out of date.

        Returns None where torch does not count changes of the positions, or where there are none.
        """
        if positions.is_inference() or not len(positions):
            return None
        kept = self._sums
        # The kept positions keep their memory, so those of another tensor are elsewhere.
        if kept is None or kept[0] is not layers or not _same(kept[1], positions) or kept[2] != positions._version:
            sums = layers.position_sums(encode(positions), _along_a_curve(positions))
            kept = self._sums = layers, positions, positions._version, sums
        return kept[3]


def _same(a: Tensor, b: Tensor) -> bool:
    return a.data_ptr() == b.data_ptr() and a.shape == b.shape and a.stride() == b.stride()


def _along_a_curve(positions: Tensor) -> Tensor:
    """Return [M] int32, an order in which neighbours in space follow one another."""
    return torch.from_numpy(morton_order(positions.nan_to_num(0.0, 0.0, 0.0).numpy())).int()
