"""Adam groups, schedules, and keeping the optimiser's rows aligned while Gaussians come and go."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

ADAM_EPS = 1e-15


def log_linear(start: float, end: float, step: int, until: int) -> float:
    """From ``start`` at step 0 to ``end`` at step ``until``, straight in the logarithm, constant afterwards."""
    if step >= until:
        return end
    if start <= 0.0 or end <= 0.0:  # no logarithm: straight
        return start + (end - start) * step / until
    return math.exp(math.log(start) + (math.log(end) - math.log(start)) * step / until)


def generator(seed: int, *keys: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A random generator that depends on (seed, keys) alone: nothing has to be saved for a run to be resumed."""
    state = np.random.SeedSequence([seed, len(keys), *keys]).generate_state(1, np.uint64)[0]
    return torch.Generator(device=device).manual_seed(int(state) & (2**63 - 1))


def adam(parameters: Mapping[str, nn.Parameter], rates: Mapping[str, float]) -> torch.optim.Adam:
    """One group per parameter, named, so that its rate can be scheduled and its rows found. Fused: one pass a row."""
    groups = [{"params": [parameter], "lr": rates[name], "name": name} for name, parameter in parameters.items()]
    return torch.optim.Adam(groups, lr=0.0, eps=ADAM_EPS, fused=True)


def set_rate(optimizer: torch.optim.Adam, name: str, rate: float) -> None:
    """Set the learning rate of the groups called ``name``."""
    for group in optimizer.param_groups:
        if group["name"] == name:
            group["lr"] = rate


def regather(
    optimizer: torch.optim.Adam, owner: nn.Module, names: tuple[str, ...], index: Tensor, fresh: Tensor
) -> None:
    """New rows from old ones: row i of every named parameter becomes old row ``index[i]``.

    Args:
        optimizer: whose moments follow; rows marked ``fresh`` start with zero moments.
        owner: module that holds the parameters as attributes.
        names: parameters whose first dimension is to be re-gathered.
        index: [N'] int64 source rows; repeated to clone, left out to prune.
        fresh: [N'] bool.
    """
    for group in optimizer.param_groups:
        name = group["name"]
        if name not in names:
            continue
        old = group["params"][0]
        new = nn.Parameter(old.detach()[index])
        state = optimizer.state.pop(old, None)
        if state:
            keep = (~fresh).view(-1, *([1] * (old.ndim - 1))).to(old.dtype)
            for key in ("exp_avg", "exp_avg_sq"):
                state[key] = state[key][index] * keep
            optimizer.state[new] = state
        group["params"][0] = new
        setattr(owner, name, new)


def reset_moments(optimizer: torch.optim.Adam, name: str) -> None:
    """Forget the moments of one parameter after its values were overwritten."""
    for group in optimizer.param_groups:
        if group["name"] == name:
            state = optimizer.state.get(group["params"][0])
            if state:
                state["exp_avg"].zero_()
                state["exp_avg_sq"].zero_()


def optimizer_tensors(optimizer: torch.optim.Adam, prefix: str) -> dict[str, Tensor]:
    """The moments and step counts as named tensors, for a checkpoint."""
    tensors = {}
    for group in optimizer.param_groups:
        for key, value in optimizer.state.get(group["params"][0], {}).items():
            tensors[f"{prefix}.{group['name']}.{key}"] = torch.as_tensor(value).detach()
    return tensors


def load_optimizer_tensors(optimizer: torch.optim.Adam, prefix: str, tensors: Mapping[str, Tensor]) -> None:
    """Inverse of :func:`optimizer_tensors`; a parameter that had no state yet stays without."""
    for group in optimizer.param_groups:
        parameter = group["params"][0]
        start = f"{prefix}.{group['name']}."
        state = {
            key: tensors[start + key].clone() for key in ("step", "exp_avg", "exp_avg_sq") if start + key in tensors
        }
        if state:
            # Fused Adam keeps its step count beside the parameter.
            optimizer.state[parameter] = {key: value.to(parameter.device) for key, value in state.items()}
