"""States of tensors and modules, by which a result made of them is known to hold."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

TensorState = tuple[Tensor, int, int]
"""What tells whether a tensor was replaced or changed in place."""


def states_of(tensors: Sequence[Tensor]) -> list[TensorState]:
    """Return the states of tensors: a result made of them stays equal as long as the states do."""
    return [(x, x.data_ptr(), 0 if x.is_inference() else x._version) for x in tensors]


def same_states(before: list[TensorState], now: list[TensorState]) -> bool:
    return len(before) == len(now) and all(a[0] is b[0] and a[1:] == b[1:] for a, b in zip(before, now))


class NetworkModules:
    """The modules of a network, found once."""

    def __init__(self, network: nn.Module) -> None:
        self.network = network
        self._modules = [(module, tuple(module._modules.values())) for module in network.modules()]

    def hold(self) -> bool:
        """Return whether every module still has the children that it had."""
        return all(tuple(module._modules.values()) == children for module, children in self._modules)

    def parameters(self) -> list[Tensor]:
        return [x for module, _ in self._modules for x in module._parameters.values() if x is not None]
