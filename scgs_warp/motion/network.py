"""The deformation network Psi: positional encoding and an MLP with one skip (paper section 4.1)."""

from __future__ import annotations

from functools import cache
from typing import cast

import torch
from torch import Tensor, nn

from ..ops.encoding import encode_rows
from ..ops.network import ROWS_AT_ONCE, Layers, evaluate, network, pair_products, supported
from ..ops.network_cache import NetworkCache
from ..runtime.environment import one_piece


def encode(values: Tensor, frequencies: int) -> Tensor:
    """Encode [..., D] as [..., D (1 + 2 F)]: the values, then sin and cos of 2^k times the values, k = 0 .. F - 1."""
    angles = (values[..., None, :] * _octaves(frequencies, values.device, values.dtype)).flatten(-2)
    with one_piece():
        return torch.cat([values, angles.sin(), angles.cos()], dim=-1)


def rows_of(where: Tensor, when: Tensor) -> Tensor:
    """Combine every position [M, A] with every time [T, B], giving [T M, A + B]."""
    both = [where[None].expand(len(when), -1, -1), when[:, None].expand(-1, len(where), -1)]
    return torch.cat(both, dim=-1).reshape(len(when) * len(where), where.shape[1] + when.shape[1])


@cache
def _octaves(count: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Return the powers of two from 1 on, [count, 1]; made once, because a step on a GPU is many small operations."""
    with torch.inference_mode(False):
        return 2.0 ** torch.arange(count, device=device, dtype=dtype)[:, None]


class _Bfloat16Linear(torch.autograd.Function):
    """A linear layer in bfloat16. The parameters' gradients, which are sums over the rows, are computed in one piece,
    because oneDNN's partition of a sum depends on the number of threads (observed with AMX at 9,999 rows)."""

    @staticmethod
    def forward(ctx, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        weight = weight.bfloat16()
        ctx.save_for_backward(x, weight)
        return nn.functional.linear(x, weight, bias.bfloat16())

    @staticmethod
    def backward(ctx, *v: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        (v_y,) = v
        x, weight = ctx.saved_tensors
        v_x = v_y @ weight if ctx.needs_input_grad[0] else None
        with one_piece():
            return v_x, (v_y.T @ x).float(), v_y.sum(0, dtype=torch.float32)


def _bfloat16_linear(x: Tensor, layer: nn.Module) -> Tensor:
    """Apply the layer to [N, in], giving [N, out] in bfloat16."""
    return cast(Tensor, _Bfloat16Linear.apply(x, layer.weight, layer.bias))


class DeformationNetwork(nn.Module):
    """Network from position and time to the channels of a rigid motion; ``heads`` name the outputs and their widths.

    The default has eight layers of 256 channels. The output of layer ``skip`` is concatenated with the input. The
    heads' initial outputs are almost zero, so the scene starts at rest.
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
        bfloat16_adjoint: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.position_frequencies, self.time_frequencies = position_frequencies, time_frequencies
        self.skip, self.low_precision, self.low_precision_adjoint = skip, bfloat16, bfloat16_adjoint
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
        self._cache = NetworkCache()

    def train(self, mode: bool = True) -> DeformationNetwork:
        self._cache.forget()  # the optimiser writes without raising torch's version counters
        return super().train(mode)

    def forward(self, positions: Tensor, times: Tensor) -> dict[str, Tensor]:
        """Evaluate every position at every time.

        Args:
            positions: [M, 3] rest positions in the normalised scene.
            times: [T] in [0, 1].

        Returns:
            One tensor [T, M, width] per head.
        """
        return dict(zip(self.heads, self.motion(positions, times).split(list(self.heads.values()), dim=-1)))

    def motion(self, positions: Tensor, times: Tensor) -> Tensor:
        """Return the heads' outputs side by side, [T, M, sum of their widths]; arguments as in :meth:`forward`."""
        if positions.is_cuda and not (positions.requires_grad or times.requires_grad):
            inputs = encode_rows(positions, times, self.position_frequencies, self.time_frequencies)
            out = self._layered(inputs)
        else:
            out = self._fused(positions, times)
            if out is None:
                out = self._layered(rows_of(self._where(positions), self._when(times)))
        return out.reshape(times.shape[0], positions.shape[0], out.shape[-1])

    def _layered(self, inputs: Tensor) -> Tensor:
        """Evaluate [N, in] layer by layer in torch: used on CUDA, in bfloat16, and if positions or times need a
        gradient."""
        if self.low_precision and self.training:
            inputs = inputs.bfloat16()
        hidden = inputs
        for i, layer in enumerate(self.layers):
            if i == self.skip:
                hidden = torch.cat([inputs, hidden], dim=-1)
            hidden = self._hidden(hidden, cast(nn.Linear, layer))
        return self.head(hidden.float())

    def _hidden(self, inputs: Tensor, layer: nn.Linear) -> Tensor:
        """Apply one hidden layer to [N, in], with its ReLU; on a GPU without gradients as one operation."""
        if inputs.dtype is torch.bfloat16:
            return _bfloat16_linear(inputs, layer).relu()
        if inputs.is_cuda and not torch.is_grad_enabled():
            fused = torch._addmm_activation  # pyright: ignore[reportPrivateImportUsage]
            return fused(layer.bias, inputs, layer.weight.T)
        return layer(inputs).relu()

    def _where(self, positions: Tensor) -> Tensor:
        return encode(positions, self.position_frequencies)

    def _when(self, times: Tensor) -> Tensor:
        return encode(times[:, None], self.time_frequencies)

    def _fused(self, positions: Tensor, times: Tensor) -> Tensor | None:
        """Evaluate all layers in one kernel; return None if no kernel fits them."""
        layers = [cast(nn.Linear, layer) for layer in (*self.layers, self.head)]
        weights: list[Tensor] = [layer.weight for layer in layers]
        biases: list[Tensor] = [layer.bias for layer in layers]
        wants_inputs = torch.is_grad_enabled() and (positions.requires_grad or times.requires_grad)
        if (self.low_precision and self.training) or wants_inputs or not supported(weights, biases):
            return None
        if self.training or torch.is_grad_enabled():
            rounded = self.low_precision_adjoint and pair_products() > 0
            return network(self._where(positions), self._when(times), weights, biases, bfloat16=rounded)
        return self._without_gradients(positions, times, weights, biases)

    def _without_gradients(
        self, positions: Tensor, times: Tensor, weights: list[Tensor], biases: list[Tensor]
    ) -> Tensor:
        """Evaluate with what earlier evaluations left in the cache."""
        when = self._when(times)
        columns = 3 * (1 + 2 * self.position_frequencies) + when.shape[1]
        layers = self._cache.layers((*weights, *biases), lambda: Layers(weights, biases, columns))
        if len(times) == 1 and len(positions) <= ROWS_AT_ONCE and not layers.tiled:
            sums = self._cache.position_sums(layers, positions, self._where)
            if sums is not None:
                return layers.values_at(sums, when)
        return evaluate(layers, self._where(positions), when)
