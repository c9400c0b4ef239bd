"""The deformation network on a CPU: a multilayer perceptron in three kernels instead of forty torch operations."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..kernels.cpu import network as kernels
from ..kernels.cpu import network_adjoint as kernels_adjoint
from ..kernels.cpu import network_pairs as kernels_pairs
from ..kernels.cpu import network_parts as kernels_parts
from ..kernels.types import NETWORK_ADJOINT_ROWS, NETWORK_BLOCK, NETWORK_PANEL
from ..runtime import environment
from ..runtime.launch import launch
from ..runtime.matrix_tiles import may_use_tiles

ROW_MULTIPLE = 8
"""Number to a multiple of which the rows of every matrix are rounded up."""
ROWS_AT_ONCE = 8192
"""Number of rows evaluated at once without gradients: hidden values stay in the cache from layer to layer."""
ADJOINT_ROWS_AT_ONCE = NETWORK_ADJOINT_ROWS
"""Number of rows of the adjoint evaluated at once. It does not affect the result."""
FLOAT_BYTES = 4
BFLOAT16_PARTS = 3
"""Number of bfloat16 numbers whose sum stands for a float32 number."""
LARGEST_TILED_BLOCK = 512
"""Largest number of rows that a thread takes through all layers by tiles at once."""
TASKS_PER_PANEL = 2
"""Number of tasks that share a panel of a layer's weight gradients."""


@functools.cache
def pair_products() -> int:
    """Return how the processor adds products of bfloat16: 0 singly, 1 in pairs (AVX512-BF16), 2 in tiles (AMX), too.

    Singly, rounding the factors of gradients saves no time.
    """
    found = torch.zeros(1, dtype=torch.int32)
    launch(kernels.find_pair_products, 1, found)
    return min(int(found), 2 if may_use_tiles() else 1)


class Layout(NamedTuple):
    """Where the layers' weights and gradients are in memory; it depends on their shapes alone."""

    table: np.ndarray
    """[layers, 9] int64, as the kernels read it, without addresses."""
    packed: int
    """Number of packed values."""
    gradients: np.ndarray
    """[layers] byte at which each layer's gradients begin: those of the weights, then those of the biases."""
    sizes: list[int]
    """Numbers of weights and of biases of each layer in turn."""


@functools.lru_cache(maxsize=32)
def _layout(shapes: tuple[tuple[int, int], ...], inputs: int, inputs_adjoint: bool) -> Layout:
    """Lay out layers of ``shapes`` (out, in); the other arguments are those of :class:`Layers`."""
    rows, sizes, at, before = [], [], 0, 0
    for out, columns in shapes:
        own = columns - before
        panels = -(-out // NETWORK_PANEL)
        adjoint = at + panels * NETWORK_PANEL * columns
        to_inputs = adjoint + before * panels * NETWORK_PANEL
        wanted = inputs_adjoint and own > 0
        rows.append([0, 0, own, before, out, at, adjoint if before else -1, to_inputs if wanted else -1, 0])
        at = to_inputs + (-(-own // NETWORK_PANEL) * NETWORK_PANEL * out if wanted else 0)
        sizes += [out * columns, out]
        before = out
    begins = np.cumsum([0, *sizes])[:-1:2] * FLOAT_BYTES
    return Layout(np.array(rows, np.int64), at, begins, sizes)


class PositionSums(NamedTuple):
    """What fixed positions contribute to the layers that read the inputs, at every time."""

    columns: int
    """Number of inputs that depend on the position."""
    sums: Tensor
    """[layers that read the inputs, rows, width] the biases and the products of these inputs, in panels."""
    order: Tensor
    """[M] int32, the position of each row. Neighbours in space are often zero together, and a tile of rows leaves out
    what is zero in all of them."""


NO_ORDER = torch.empty(0, dtype=torch.int32)


class Layers:
    """Weights of all layers, packed in the kernels' layout where they are needed so; valid until a parameter changes.

    Args:
        weights: [out, in] of every layer, float32, contiguous, on the CPU; the first layer reads only the inputs.
        biases: [out] of every layer.
        inputs: number of input columns. A layer whose ``in`` exceeds its predecessor's ``out`` by this number reads the
            inputs again, before the predecessor's outputs (a skip connection).
        adjoint: whether :meth:`gradients` will be called; its weights are then those of now.
        inputs_adjoint: whether it will compute the gradient of the inputs.
        bfloat16: whether it rounds its factors to bfloat16; not with ``inputs_adjoint``.
    """

    def __init__(
        self,
        weights: list[Tensor],
        biases: list[Tensor],
        inputs: int,
        adjoint: bool = False,
        inputs_adjoint: bool = False,
        bfloat16: bool = False,
    ) -> None:
        self.weights, self.biases = [w.detach() for w in weights], [b.detach() for b in biases]
        self.inputs = inputs
        self.panels = max(-(-w.shape[0] // NETWORK_PANEL) for w in weights)
        self.outputs = weights[-1].shape[0]
        shapes = tuple((out, columns) for out, columns in (w.shape for w in weights))
        self.layout = _layout(shapes, inputs, inputs_adjoint)
        table = self.layout.table.copy()
        table[:, 0], table[:, 1] = [w.data_ptr() for w in weights], [b.data_ptr() for b in biases]
        self.table = torch.from_numpy(table)
        self._widest = max(self.panels, -(-inputs // NETWORK_PANEL)) if inputs_adjoint else self.panels
        self.pairs = torch.empty(self.layout.packed // 2 if bfloat16 and not inputs_adjoint else 0, dtype=torch.int32)
        """Weights in pairs of bfloat16, for the adjoint; empty: it is computed in float32."""
        self.tiled = pair_products() > 1
        """Whether the values are computed by tiles, from the weights as they are."""
        if len(self.pairs):
            launch(kernels_pairs.pack_weight_pairs, *self._tasks(), self.table, self.pairs, grain=1)
        wanted = not self.tiled or (adjoint and not len(self.pairs))
        self.finite = torch.empty(len(weights), self._widest, dtype=torch.int32)
        """Whether all weights of a panel are finite: 0 or 1, written with ``packed``."""
        self.packed = self._pack() if wanted else torch.empty(0)

    def _tasks(self) -> tuple[int, int]:
        """Return the number of panels of all matrices, each counted as the widest, and that of the widest."""
        return len(self.weights) * self._widest, self._widest

    def _pack(self) -> Tensor:
        """Return the weights packed in float32, with those for the adjoint unless there are pairs."""
        packed = torch.empty(self.layout.packed)
        adjoint = int(not len(self.pairs))
        launch(kernels.pack_weights, *self._tasks(), adjoint, self.table, packed, self.finite, grain=1)
        return packed

    def values(self, where: Tensor, when: Tensor, keep: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Return the inputs and the hidden values in panels, and the outputs [T M, out]."""
        count = where.shape[0] * when.shape[0]
        rows = -(-count // ROW_MULTIPLE) * ROW_MULTIPLE
        inputs = torch.empty(-(-self.inputs // NETWORK_PANEL), rows, NETWORK_PANEL)
        launch(kernels.pack_inputs, rows, where, when, inputs)
        out = torch.empty(count, self.outputs)
        if self.tiled:
            hidden = torch.empty(len(self.weights) if keep else 0, rows, self.panels * NETWORK_PANEL)
            self._values_in_parts(inputs, hidden, out)
            return inputs, hidden, out
        hidden = torch.empty(len(self.weights) if keep else 2, rows, self.panels * NETWORK_PANEL)
        read = NETWORK_BLOCK, int(keep), 0, self.table, self.packed, self.finite, inputs, None, NO_ORDER
        launch(kernels.network_values, -(-rows // NETWORK_BLOCK), *read, hidden, out, grain=1)
        return inputs, hidden, out

    def position_sums(self, where: Tensor, order: Tensor) -> PositionSums:
        """Sum what positions contribute at every time; not on a processor with tiles.

        Args:
            where: [M, A] inputs that depend on the position, M > 0.
            order: [M] int32, the position of each row.
        """
        rows = -(-len(where) // ROW_MULTIPLE) * ROW_MULTIPLE
        inputs = torch.zeros(-(-self.inputs // NETWORK_PANEL), rows, NETWORK_PANEL)
        launch(kernels.pack_inputs, rows, where[order.long()], torch.zeros(1, self.inputs - where.shape[1]), inputs)
        readers = int((self.layout.table[:, 2] > 0).sum())
        sums = torch.empty(readers, rows, self.panels * NETWORK_PANEL)
        read = NETWORK_BLOCK, where.shape[1], self.table, self.packed, inputs
        launch(kernels.network_sums, -(-rows // NETWORK_BLOCK), *read, sums, grain=1)
        return PositionSums(where.shape[1], sums, order)

    def values_at(self, positions: PositionSums, when: Tensor) -> Tensor:
        """Return the outputs [M, out] for all positions at one time, given its inputs [1, B]: the same bits as
        :meth:`values`."""
        inputs = torch.zeros(-(-self.inputs // NETWORK_PANEL), 1, NETWORK_PANEL)
        inputs.view(-1)[positions.columns : self.inputs] = when[0]
        rows, width = positions.sums.shape[1:]
        hidden, out = torch.empty(2, rows, width), torch.empty(len(positions.order), self.outputs)
        read = NETWORK_BLOCK, 0, positions.columns, self.table, self.packed, self.finite, inputs
        shared = positions.sums, positions.order
        launch(kernels.network_values, -(-rows // NETWORK_BLOCK), *read, *shared, hidden, out, grain=1)
        return out

    def _values_in_parts(self, inputs: Tensor, hidden: Tensor, out: Tensor) -> None:
        """Write the outputs, and the hidden values if ``hidden`` has room for them."""
        rows, keep = inputs.shape[1], int(len(hidden) > 0)
        # One block for each thread at a time: a block cuts all weights into parts, and its scratch stays in the cache.
        slots = environment.thread_count()
        shared = -(-rows // (slots * NETWORK_BLOCK)) * NETWORK_BLOCK
        size = max(min(shared, LARGEST_TILED_BLOCK), NETWORK_BLOCK)
        blocks, pairs = -(-rows // size), BFLOAT16_PARTS * NETWORK_PANEL // 2
        reads = len(inputs) + self.panels
        words = pairs * len(inputs) * size, 2 * pairs * self.panels * size, pairs * reads * NETWORK_PANEL
        scratch = [torch.empty(min(slots, blocks), count, dtype=torch.int32) for count in words]
        arguments = size, keep, self.table, inputs, *scratch, hidden, out
        for begin in range(0, blocks, slots):
            count = min(slots, blocks - begin)
            launch(kernels_parts.network_values_parts, count, *arguments, grain=1, begin=begin)

    def gradients(
        self, inputs: Tensor, hidden: Tensor, v_out: Tensor, sizes: tuple[int, int, int] | None
    ) -> tuple[Tensor | None, list[Tensor]]:
        """Return the gradient of ``where``, and a list of the gradients of all weights, then of all biases.

        Args:
            sizes: M, T and A of ``where`` [M, A] at T times. None: the gradient of ``where`` is not needed.
        """
        count = v_out.shape[0]
        flat = (torch.empty if count else torch.zeros)(sum(self.layout.sizes))
        rows = self.table.numpy().copy()
        rows[:, 8] = self.layout.gradients + flat.data_ptr()
        table = torch.from_numpy(rows)
        v_inputs = None if sizes is None else torch.empty(count, sizes[2])
        if len(self.pairs):
            assert v_inputs is None
            self._backward_in_pairs(table, inputs, hidden, v_out)
        else:
            self._backward(table, inputs, hidden, v_out, v_inputs)
        v_where = None if v_inputs is None or sizes is None else _over_times(v_inputs, *sizes)
        parts = flat.split(self.layout.sizes)
        return v_where, [*(v.view_as(w) for v, w in zip(parts[::2], self.weights)), *parts[1::2]]

    def _backward(self, table: Tensor, inputs: Tensor, hidden: Tensor, v_out: Tensor, v_inputs: Tensor | None) -> None:
        """Write the gradients of the parameters to the table's addresses, and those of the inputs to ``v_inputs``."""
        layers, rows, width = hidden.shape
        v_hidden = torch.empty(layers, min(rows, ADJOINT_ROWS_AT_ONCE), width)
        for begin in range(0, rows, ADJOINT_ROWS_AT_ONCE):
            own = min(ADJOINT_ROWS_AT_ONCE, rows - begin)
            grid, where = -(-own // NETWORK_BLOCK), (NETWORK_BLOCK, begin, table, self.packed)
            launch(kernels_adjoint.network_adjoint, grid, *where, self.finite, hidden, v_out, v_hidden, grain=1)
            if v_inputs is not None:
                launch(kernels_adjoint.network_inputs_adjoint, grid, *where, v_hidden, v_inputs, grain=1)
            shared = self.panels, TASKS_PER_PANEL, begin, min(own, len(v_out) - begin), table, inputs, hidden, v_hidden
            launch(kernels_adjoint.network_weights_adjoint, layers * self.panels * TASKS_PER_PANEL, *shared, grain=1)

    def _backward_in_pairs(self, table: Tensor, inputs: Tensor, hidden: Tensor, v_out: Tensor) -> None:
        """Write the gradients of the parameters, from factors in bfloat16, to the table's addresses."""
        layers, rows, width = hidden.shape
        # Whole blocks: a tile of registers holds rows behind the last one, which count nowhere.
        most, tiles = -(-min(rows, ADJOINT_ROWS_AT_ONCE) // NETWORK_BLOCK) * NETWORK_BLOCK, int(pair_products() > 1)
        columns, input_rows, hidden_rows, v_rows = (
            torch.empty(shape, dtype=torch.int32)
            for shape in (
                (2, most, width // 2),
                (inputs.shape[0], most // 2, NETWORK_PANEL),
                (layers - 1, most // 2, width),
                (layers, most // 2, width),
            )
        )
        for begin in range(0, rows, ADJOINT_ROWS_AT_ONCE):
            own = min(ADJOINT_ROWS_AT_ONCE, rows - begin)
            read = NETWORK_BLOCK, begin, tiles, table, self.pairs, self.finite, inputs, hidden, v_out
            pairs = input_rows, hidden_rows, v_rows
            launch(kernels_pairs.network_adjoint_pairs, -(-own // NETWORK_BLOCK), *read, columns, *pairs, grain=1)
            shared = self.panels, TASKS_PER_PANEL, begin, min(own, len(v_out) - begin), tiles, table, *pairs
            launch(
                kernels_pairs.network_weights_adjoint_pairs, layers * self.panels * TASKS_PER_PANEL, *shared, grain=1
            )


def _over_times(v_inputs: Tensor, positions: int, times: int, columns: int) -> Tensor:
    """Sum [T M, A] over the times, in their order, to [M, A]."""
    if times == 0:
        return torch.zeros(positions, columns)
    instants = v_inputs.view(times, positions, columns)
    total = instants[0]
    for own in instants[1:]:
        total += own
    return total


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, bfloat16, where, when, *parameters):
        half = len(parameters) // 2
        columns = where.shape[1] + when.shape[1]
        weights, biases = list(parameters[:half]), list(parameters[half:])
        layers = Layers(weights, biases, columns, True, ctx.needs_input_grad[1], bfloat16)
        inputs, hidden, out = layers.values(where, when, keep=True)
        ctx.layers, ctx.sizes = layers, (where.shape[0], when.shape[0], where.shape[1])
        ctx.save_for_backward(inputs, hidden)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients):  # type: ignore[override]
        sizes = ctx.sizes if ctx.needs_input_grad[1] else None
        v_where, of_parameters = ctx.layers.gradients(*ctx.saved_tensors, gradients[0].contiguous(), sizes)
        return None, v_where, None, *of_parameters


def supported(weights: list[Tensor], biases: list[Tensor]) -> bool:
    """Return whether :func:`network` accepts the parameters: float32 on a CPU, hidden widths multiples of 32."""
    return all(
        p.device.type == "cpu" and p.dtype == torch.float32 and p.is_contiguous() for p in (*weights, *biases)
    ) and all(w.shape[0] % NETWORK_PANEL == 0 for w in weights[:-1])


def network(
    where: Tensor, when: Tensor, weights: list[Tensor], biases: list[Tensor], *, bfloat16: bool = False
) -> Tensor:
    """Evaluate hidden layers with ReLU and a last layer without, for every position at every time.

    Args:
        where: [M, A] inputs that depend on the position.
        when: [T, B] inputs that depend on the time. No gradient.
        weights: [out, in] of every layer. ``in`` is A + B for the first layer and the previous layer's ``out`` for the
            others; A + B more make a skip connection, which reads the inputs again, before the previous outputs.
        biases: [out] of every layer.
        bfloat16: round the factors of the parameters' gradients to bfloat16, unless ``where`` has a gradient. Sums stay
            in float32.

    Returns:
        [T M, out of the last layer], with time t and position m in row ``t M + m``. Gradients reach weights, biases and
        ``where``, summed in a fixed order.

    Raises:
        ValueError: a shape is wrong, or the parameters are not :func:`supported`.
    """
    _validate(where, when, weights, biases)
    where, when = where.contiguous(), when.detach().contiguous()
    if torch.is_grad_enabled() and any(p.requires_grad for p in (where, *weights, *biases)):
        return _Network.apply(bfloat16, where, when, *weights, *biases)  # type: ignore[return-value]
    return evaluate(Layers(weights, biases, where.shape[1] + when.shape[1]), where, when)


def evaluate(layers: Layers, where: Tensor, when: Tensor) -> Tensor:
    """Evaluate :func:`network` without gradients, with packed weights."""
    if where.shape[0] * when.shape[0] <= ROWS_AT_ONCE:
        return layers.values(where, when, keep=False)[2]
    parts = [
        layers.values(rows, when[t : t + 1], keep=False)[2]
        for t in range(when.shape[0])
        for rows in where.split(ROWS_AT_ONCE)
    ]
    return torch.cat(parts)


def _validate(where: Tensor, when: Tensor, weights: list[Tensor], biases: list[Tensor]) -> None:
    if where.ndim != 2 or when.ndim != 2:
        raise ValueError(f"where and when must be matrices, got {tuple(where.shape)} and {tuple(when.shape)}")
    if len(weights) < 2 or len(weights) != len(biases):
        raise ValueError(f"weights and biases must be two or more layers, got {len(weights)} and {len(biases)}")
    if not supported(weights, biases):
        raise ValueError("weights and biases must be contiguous float32 on the CPU, hidden widths multiples of 32")
    inputs, before = where.shape[1] + when.shape[1], 0
    for layer, (weight, bias) in enumerate(zip(weights, biases)):
        fits = (before, inputs + before) if layer else (inputs,)
        if weight.ndim != 2 or weight.shape[1] not in fits or tuple(bias.shape) != (weight.shape[0],):
            raise ValueError(
                f"weights[{layer}] and biases[{layer}] must be [out, {' or '.join(map(str, fits))}] and [out], "
                f"got {tuple(weight.shape)} and {tuple(bias.shape)}"
            )
        before = weight.shape[0]
