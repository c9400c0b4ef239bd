"""Adam with named parameters, learning-rate schedules, and row bookkeeping while Gaussians are added and pruned."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .ops.adam import Update, adam_step

ADAM_BETAS = (0.9, 0.999)
ADAM_EPS = 1e-15


def log_linear(start: float, end: float, step: int, until: int) -> float:
    """Interpolate log-linearly from ``start`` at step 0 to ``end`` at step ``until``, and stay constant afterwards."""
    if step >= until:
        return end
    if start <= 0.0 or end <= 0.0:  # no logarithm exists: interpolate linearly
        return start + (end - start) * step / until
    return math.exp(math.log(start) + (math.log(end) - math.log(start)) * step / until)


@dataclass
class Group:
    """One parameter and its Adam state."""

    parameter: nn.Parameter
    rate: float
    steps: int = 0
    exp_avg: Tensor | None = None
    """First moment. Both moments are None before the first step with a gradient."""
    exp_avg_sq: Tensor | None = None

    def begin(self) -> None:
        """Make the moments, unless they exist."""
        if self.exp_avg is None or self.exp_avg_sq is None:
            self.exp_avg, self.exp_avg_sq = (torch.zeros_like(self.parameter) for _ in range(2))


class Adam:
    """Adam with bias correction as in ``torch.optim.Adam``, on named parameters, in one kernel launch.

    Attributes: ``groups``, name to :class:`Group`. Rates are read at every step. A parameter without a gradient does
    not change. If a gradient is zero, the moments still decay.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], rates: Mapping[str, float]) -> None:
        self.groups = {name: Group(parameter, rates[name]) for name, parameter in parameters.items()}
        for parameter in parameters.values():
            parameter.data = parameter.data.contiguous()

    def gradients(self) -> list[tuple[str, Tensor]]:
        """Return the existing gradients, with the names of their parameters."""
        gradients = ((name, group.parameter.grad) for name, group in self.groups.items())
        return [(name, gradient) for name, gradient in gradients if gradient is not None]

    def step(self) -> None:
        """Update every parameter that has a gradient."""
        updates = []
        for group in self.groups.values():
            gradient = group.parameter.grad
            if gradient is None:
                continue
            group.begin()
            assert group.exp_avg is not None and group.exp_avg_sq is not None
            group.steps += 1
            moments = group.exp_avg, group.exp_avg_sq
            updates.append(Update(group.parameter, gradient.contiguous(), *moments, group.rate, group.steps))
        adam_step(updates, betas=ADAM_BETAS, eps=ADAM_EPS)

    def zero_grad(self) -> None:
        """Drop all gradients."""
        for group in self.groups.values():
            group.parameter.grad = None

    def regather(self, owner: nn.Module, names: tuple[str, ...], index: Tensor, fresh: Tensor) -> None:
        """Rebuild rows: row i of every named parameter becomes the former row ``index[i]``.

        Args:
            owner: module that holds the parameters as attributes.
            names: parameters whose first dimension is gathered anew.
            index: [N'] int64 source rows. Repeated rows are cloned, missing rows are pruned.
            fresh: [N'] bool, True for rows that start with zero moments.
        """
        for name in names:
            group = self.groups.get(name)
            if group is None:
                continue
            old = group.parameter.detach()
            group.parameter = nn.Parameter(old[index])
            setattr(owner, name, group.parameter)
            if group.exp_avg is not None and group.exp_avg_sq is not None:
                keep = (~fresh).view(-1, *([1] * (old.ndim - 1))).to(old.dtype)
                group.exp_avg, group.exp_avg_sq = group.exp_avg[index] * keep, group.exp_avg_sq[index] * keep

    def reset_moments(self, name: str) -> None:
        """Zero the moments of a parameter whose values were overwritten; its step count continues."""
        for moment in (self.groups[name].exp_avg, self.groups[name].exp_avg_sq):
            if moment is not None:
                moment.zero_()

    def tensors(self, prefix: str) -> dict[str, Tensor]:
        """Return moments and step counts for a checkpoint, as ``prefix.name.exp_avg``, ``.exp_avg_sq`` and ``.step`` (a
        float32 scalar). A parameter that never had a gradient is left out."""
        tensors = {}
        for name, group in self.groups.items():
            if group.steps > 0 and group.exp_avg is not None and group.exp_avg_sq is not None:
                tensors[f"{prefix}.{name}.step"] = torch.tensor(float(group.steps))
                tensors[f"{prefix}.{name}.exp_avg"] = group.exp_avg
                tensors[f"{prefix}.{name}.exp_avg_sq"] = group.exp_avg_sq
        return tensors

    def load_tensors(self, prefix: str, tensors: Mapping[str, Tensor]) -> None:
        """Restore the result of :meth:`tensors`. Parameters missing from it stay without state.

        Raises:
            KeyError: a part of a parameter's state is missing.
            ValueError: a moment does not have the shape of its parameter.
        """
        for name, group in self.groups.items():
            start = f"{prefix}.{name}."
            if f"{start}step" not in tensors:
                continue
            moments = []
            for key in ("exp_avg", "exp_avg_sq"):
                moment = tensors[start + key].to(group.parameter.device).clone(memory_format=torch.contiguous_format)
                if moment.shape != group.parameter.shape:
                    raise ValueError(f"{start}{key} must be {list(group.parameter.shape)}, got {list(moment.shape)}")
                moments.append(moment)
            group.exp_avg, group.exp_avg_sq = moments
            group.steps = int(tensors[f"{start}step"])
