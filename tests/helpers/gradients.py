"""Values and gradients of a function of tensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import Tensor


def value_and_gradients(
    function: Callable[..., Tensor], inputs: Sequence[Tensor], weights: Tensor, learnt: int | None = None
) -> tuple[Tensor, list[Tensor | None]]:
    """Return ``function(*inputs)`` and the gradients of its product with ``weights``, summed, to the first ``learnt``
    inputs (None: to all)."""
    learnt = len(inputs) if learnt is None else learnt
    leaves = [x.detach().clone().requires_grad_() for x in inputs[:learnt]]
    output = function(*leaves, *inputs[learnt:])
    (output * weights.to(output)).sum().backward()
    return output.detach(), [leaf.grad for leaf in leaves]
