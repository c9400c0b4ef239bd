"""The launches that CUDA gets, made on the CPU, where Warp's recorded launches work alike."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import warp as wp

from scgs_warp.kernels import projection, reduction, skinning
from scgs_warp.kernels.cuda.slots import sum_slots
from scgs_warp.runtime import launch
from scgs_warp.runtime.cuda_launch import RecordedKernel
from scgs_warp.runtime.kernel_arguments import parameters_of, warp_arguments

CPU = torch.device("cpu")


def recorded(kernel: wp.Kernel, dim: int, args: tuple) -> RecordedKernel:
    return RecordedKernel(kernel, args, dim, CPU)


def slot_arguments(count: int, seed: int, absolute: bool) -> tuple[Any, ...]:
    generator = torch.Generator().manual_seed(seed)
    offsets = torch.arange(count + 1) * 2
    slots = torch.randn(2 * count, 16, generator=generator)
    outputs = [torch.zeros(count, *shape) for shape in ((2,), (3,), (), (4,), (2,))]
    if not absolute:
        outputs[4] = None  # type: ignore[call-overload]
    return offsets, slots, 0, *outputs


def test_other_shapes_and_missing_arrays():
    ready = recorded(sum_slots, 1, slot_arguments(1, 0, True))
    for count, seed, absolute in ((5, 1, True), (70, 2, False), (70, 3, True), (5, 4, False), (1, 5, True)):
        got, expected = (slot_arguments(count, seed, absolute) for _ in range(2))
        ready.launch(16 * count, got, None)
        launch.launch(sum_slots, 16 * count, *expected)
        for a, b in zip(got[3:], expected[3:]):
            if a is not None:
                assert torch.equal(a, b) and b.any()


def test_a_grid_may_begin_later():
    """As windows of tiles do: what lies before stays as it was."""
    got, expected = (slot_arguments(10, 3, True) for _ in range(2))
    ready = recorded(sum_slots, 1, slot_arguments(1, 0, True))
    ready.launch(16 * 4, got, None, 16 * 6)
    launch.launch(sum_slots, 16 * 4, *expected, begin=16 * 6)
    for a, b in zip(got[3:], expected[3:]):
        assert torch.equal(a, b) and b[6:].any() and not b[:6].any()


def projection_arguments(count: int, width: int, eps2d: float) -> tuple[Any, ...]:
    generator = torch.Generator().manual_seed(count)
    means = torch.randn(count, 3, generator=generator) * 0.3 + torch.tensor([0.0, 0.0, 3.0])
    shape = torch.randn(count, 4, generator=generator), torch.full((count, 3), 0.1), torch.full((count,), 0.8)
    K = torch.tensor([[[60.0, 0.0, 32.0], [0.0, 60.0, 32.0], [0.0, 0.0, 1.0]]])
    outputs = [torch.zeros(count, *tail) for tail in ((2,), (3,), (), ())]
    radii = torch.zeros(count, 2, dtype=torch.int32)
    return means, *shape, torch.eye(4)[None], K, width, 64, 0.01, 1e10, 0.0, eps2d, 0, 0.5, *outputs, radii


def test_numbers_between_arrays():
    first = projection_arguments(9, 64, 0.3)
    ready = recorded(projection.project, 9, first)
    results = []
    for count, width, eps2d in ((9, 64, 0.3), (30, 64, 0.3), (30, 48, 2.0)):
        got, expected = (projection_arguments(count, width, eps2d) for _ in range(2))
        ready.launch(count, got, None)
        launch.launch(projection.project, count, *expected)
        assert all(torch.equal(a, b) for a, b in zip(got[-5:], expected[-5:])) and got[-1].any()
        results.append(got[-4])
    assert not torch.equal(results[1], results[2])


def test_mistakes_name_the_argument():
    arguments = slot_arguments(4, 0, True)
    ready = recorded(sum_slots, 64, arguments)
    for place, wrong, error in (
        (0, arguments[0].int(), ValueError),
        (1, arguments[1].T, ValueError),
        (1, arguments[1].flatten(), ValueError),
        (4, torch.zeros(3, 4, device="meta"), ValueError),
    ):
        changed = [*arguments]
        changed[place] = wrong
        with pytest.raises(error, match="sum_slots"):
            ready.launch(64, tuple(changed), None)
    with pytest.raises(TypeError, match="arguments"):
        ready.launch(64, arguments[:-1], None)
    other = projection_arguments(9, 64, 0.3)
    ready = recorded(projection.project, 9, other)
    with pytest.raises(TypeError, match="project"):
        ready.launch(9, (*other[:6], torch.zeros(3), *other[7:]), None)
    with pytest.raises(TypeError, match="project"):
        ready.launch(9, (*other[:6], "wide", *other[7:]), None)


def test_every_kernel_can_be_settled():
    """Arguments of every kind that the kernels have find their place."""
    for module in (projection, reduction, skinning):
        for kernel in (value for value in vars(module).values() if isinstance(value, wp.Kernel)):
            RecordedKernel(kernel, [None if p is not None else 0 for p in parameters_of(kernel)], 1, CPU)


@pytest.mark.parametrize(("shape", "fits"), [((2, 2**29 - 1), True), ((2, 2**29), False), ((1, 2**29), False)])
def test_strides_beyond_int32_are_refused(shape, fits):
    """Tensors without memory are enough: what is refused is their description."""
    args = [torch.empty(size, device="meta") for size in (shape, (1, 1))]
    if fits:
        warp_arguments(reduction.sum_rows, args)
    else:
        with pytest.raises(ValueError, match=r"values_in of shape .* has a stride of 2147483648 bytes"):
            warp_arguments(reduction.sum_rows, args)
