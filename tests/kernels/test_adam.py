"""One launch of Adam against torch's, in float64; and values that are not finite."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from scgs_warp.ops.adam import Update, adam_step, first_not_finite, first_not_finite_by_norm
from scgs_warp.optim import ADAM_EPS, Adam
from scgs_warp.runtime import environment

SHAPES = {"a": (37, 3), "b": (1,), "c": (0, 4), "d": (16,), "e": (700, 15, 3), "f": (4096,), "g": (3, 4099)}
RATES = {"a": 1e-2, "b": 0.0, "c": 1e-3, "d": 1e-3, "e": 2.5e-3, "f": 1e-1, "g": 1e-4}
FORMS = ["auto", "plain"]


def values(seed: int, device: str, shapes=SHAPES) -> dict[str, torch.Tensor]:
    random = torch.Generator().manual_seed(seed)
    return {name: torch.randn(shape, generator=random).to(device) for name, shape in shapes.items()}


def torch_adam(start: dict[str, torch.Tensor]) -> tuple[dict[str, nn.Parameter], torch.optim.Adam]:
    twins = {name: nn.Parameter(value.double()) for name, value in start.items()}
    groups = [{"params": [twin], "lr": RATES[name]} for name, twin in twins.items()]
    return twins, torch.optim.Adam(groups, eps=ADAM_EPS)


@pytest.mark.parametrize("seed", [0, 1])
def test_fifty_steps_as_torch_takes_them(seed, device):
    """Different rates, one of them on a schedule; gradients of all magnitudes, zero now and then, or missing."""
    start = values(seed, device)
    parameters = {name: nn.Parameter(value.clone()) for name, value in start.items()}
    optimizer = Adam(parameters, RATES)
    twins, reference = torch_adam(start)
    for step in range(50):
        gradients = values(1000 * seed + step + 100, device)
        for index, name in enumerate(SHAPES):
            gradient = gradients[name] * 10.0 ** (index - 4)
            gradient = gradient * 0.0 if step in (5, 6) or (step > 10 and index % 2) else gradient
            missing = (step + index) % 7 == 0
            parameters[name].grad = None if missing else gradient
            twins[name].grad = None if missing else gradient.double()
        optimizer.groups["f"].rate = reference.param_groups[5]["lr"] = 0.1 / (1 + step)
        optimizer.step()
        reference.step()
    for index, (name, twin) in enumerate(twins.items()):
        group, state, scale = optimizer.groups[name], reference.state[twin], 10.0 ** (index - 4)
        assert group.exp_avg is not None and group.exp_avg_sq is not None
        assert group.steps == int(state["step"]) < 50
        torch.testing.assert_close(group.parameter.double(), twin, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(group.exp_avg.double(), state["exp_avg"], rtol=1e-5, atol=1e-6 * scale)
        torch.testing.assert_close(group.exp_avg_sq.double(), state["exp_avg_sq"], rtol=1e-5, atol=1e-6 * scale**2)
    assert not torch.equal(parameters["a"], start["a"]) and torch.equal(parameters["b"], start["b"])


@pytest.mark.parametrize("form", FORMS)
def test_each_form_is_adam_and_touches_nothing_else(form, device):
    """Sizes around registers and chunks; nothing beside a tensor is touched."""
    for size in (1, 15, 16, 17, 4095, 4096, 4097, 8193):
        buffers = [torch.randn(size + 8, generator=torch.Generator().manual_seed(i)).to(device) for i in range(4)]
        buffers[3].abs_()
        before = [buffer.clone() for buffer in buffers]
        tensors = [buffer[3 : 3 + size] for buffer in buffers]
        adam_step([Update(*tensors, 0.01, 3)], form=form)
        value, gradient, average, square = (buffer[3 : 3 + size].double() for buffer in before)
        average = 0.9 * average + 0.1 * gradient
        square = 0.999 * square + 0.001 * gradient**2
        value = value - 0.01 / (1 - 0.9**3) * average / (square.sqrt() / math.sqrt(1 - 0.999**3) + 1e-15)
        for ours, exact in zip(tensors, (value, gradient, average, square)):
            torch.testing.assert_close(ours.double(), exact, rtol=1e-5, atol=1e-6)
        for ours, old in zip(buffers, before):
            assert torch.equal(ours[:3], old[:3]) and torch.equal(ours[3 + size :], old[3 + size :])


def test_same_bits_for_any_thread_count(all_threads):
    results = []
    for threads in (1, 2, 3):
        environment.configure(threads=threads)
        optimizer = Adam({name: nn.Parameter(value) for name, value in values(0, "cpu").items()}, RATES)
        for step in range(3):
            for name, gradient in values(step + 1, "cpu").items():
                optimizer.groups[name].parameter.grad = gradient
            optimizer.step()
        results.append([group.parameter.detach() for group in optimizer.groups.values()])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_gradients_and_parameters_with_strides(device):
    start = torch.arange(6.0, device=device).view(2, 3)
    parameter = nn.Parameter(start.T.clone())  # keeps its strides
    optimizer = Adam({"a": parameter}, {"a": 0.5})
    parameter.grad = torch.tensor([[1.0, -1.0]], device=device).expand(3, 2)
    optimizer.step()
    expected = start.T + torch.tensor([-0.5, 0.5], device=device)
    torch.testing.assert_close(parameter.detach(), expected)
    optimizer.zero_grad()
    assert parameter.grad is None
    optimizer.step()
    torch.testing.assert_close(parameter.detach(), expected)


def test_changed_values_are_told_from_old_ones(device):
    parameter = nn.Parameter(torch.ones(3, device=device))
    optimizer = Adam({"a": parameter}, {"a": 0.5})
    versions = [parameter._version]
    for _ in range(2):
        result = (parameter * parameter).sum()
        parameter.grad = torch.ones_like(parameter)
        optimizer.step()
        versions.append(parameter._version)
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            result.backward()
    assert len(set(versions)) == 3


def test_what_torch_saved_is_read(device):
    """Names and contents of a checkpoint are those that torch's optimiser gave."""
    shapes = {name: SHAPES[name] for name in ("a", "d")}
    start = values(0, device, shapes)
    twins, reference = torch_adam(start)
    for name, gradient in values(1, device, shapes).items():
        twins[name].grad = gradient.double()
    reference.step()
    saved = {f"x.{name}.{key}": v.float() for name in shapes for key, v in reference.state[twins[name]].items()}
    optimizer = Adam({name: nn.Parameter(value) for name, value in start.items()}, RATES)
    optimizer.load_tensors("x", {**saved, "x.other.step": torch.ones(())})
    again = optimizer.tensors("x")
    assert again.keys() == saved.keys()
    for name, value in again.items():
        assert value.dtype == torch.float32
        torch.testing.assert_close(value.cpu(), saved[name].cpu(), rtol=0, atol=0)
    assert optimizer.groups["a"].steps == 1
    with pytest.raises(ValueError, match=r"x\.a\.exp_avg"):
        optimizer.load_tensors("x", {**saved, "x.a.exp_avg": torch.zeros(5)})
    with pytest.raises(KeyError):
        optimizer.load_tensors("x", {"x.a.step": torch.ones(())})


@pytest.mark.parametrize("bad", [math.nan, -math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", [0, 15, 4095, 4096, 8200])
def test_the_first_tensor_that_is_not_finite(bad, place, device):
    tensors = [torch.full((size,), 3e38, device=device) for size in (5, 0, 8201, 16, 8201)]
    assert first_not_finite(tensors) is None, "large values are finite"
    tensors[4][place] = bad
    assert first_not_finite(tensors) == 4
    tensors[2][place] = bad
    assert first_not_finite(tensors) == 2


@pytest.mark.parametrize("find", [first_not_finite, first_not_finite_by_norm])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_tensors_without_elements_keep_their_place(find, bad, device):
    """Stage 1's spheres have an empty gradient (``sh_rest``), of which torch has no infinity norm."""
    tensors = [torch.zeros(0, 15, 3), torch.ones(7), torch.zeros(0), torch.ones(3, 2)]
    tensors = [tensor.to(device) for tensor in tensors]
    assert find(tensors) is None
    tensors[3][1, 1] = bad
    assert find(tensors) == 3
    tensors[1][6] = bad
    assert find(tensors) == 1


def test_no_tensors_are_no_work():
    adam_step([])
    for find in (first_not_finite, first_not_finite_by_norm):
        assert find([]) is None
        assert find([torch.zeros(0)]) is None
    adam_step([Update(*(torch.zeros(0, 3) for _ in range(4)), 1.0, 1)])


def test_tensors_that_do_not_fit_are_refused():
    good = [torch.zeros(4) for _ in range(4)]
    for index, name in enumerate(Update._fields[1:4], start=1):
        for wrong in (torch.zeros(5), torch.zeros(4, dtype=torch.float64)):
            tensors = [wrong if i == index else tensor for i, tensor in enumerate(good)]
            with pytest.raises(ValueError, match=name):
                adam_step([Update(*tensors, 1.0, 1)])
    with pytest.raises(ValueError, match="contiguous"):
        adam_step([Update(*(torch.zeros(8)[::2] for _ in range(4)), 1.0, 1)])
    with pytest.raises(ValueError, match="form"):
        adam_step([Update(*good, 1.0, 1)], form="fast")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="float32"):
        first_not_finite([torch.zeros(3, dtype=torch.float64)])
