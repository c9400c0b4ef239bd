"""The fused network against float64: values, gradients, bfloat16 products, and which networks it takes."""

from __future__ import annotations

import pytest
import torch

from helpers.networks import parameters, rows
from reference.network import gradients_in_bfloat16
from reference.network import network as twin
from scgs_warp.motion import network as motion_network
from scgs_warp.motion.network import DeformationNetwork
from scgs_warp.ops import network as ops
from scgs_warp.ops.network import Layers, evaluate, network, supported
from scgs_warp.runtime import environment, matrix_tiles

SHAPES = [  # inputs of position and time, hidden widths, layers that read the inputs again, outputs
    (63, 13, [256] * 8, {4}, 7),
    (5, 2, [32, 64], set(), 1),
    (30, 2, [64, 32, 96], {1, 2}, 40),
    (1, 0, [32], set(), 33),
]


@pytest.fixture(params=[1, 2], ids=["pairs", "tiles"])
def products(request, monkeypatch) -> int:
    """Products of bfloat16 in pairs, and in tiles where the processor has them."""
    if request.param == 2 and ops.pair_products() < 2:
        pytest.skip("needs AMX")
    monkeypatch.setattr(ops, "pair_products", lambda: request.param)
    return request.param


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("positions, times", [(1, 1), (7, 1), (13, 3), (70, 1)])
@pytest.mark.parametrize("shape", SHAPES)
def test_values_and_gradients(shape, positions, times, seed, products):
    weights, biases = parameters(shape, seed)
    where, when = rows(shape, positions, times, seed)
    where.requires_grad_()
    found = network(where, when, weights, biases)
    own = [p.detach().double().requires_grad_() for p in (where, *weights, *biases)]
    half = len(weights)
    expected = twin(own[0], when.double(), own[1 : half + 1], own[half + 1 :])
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-5)
    v = torch.randn(found.shape, generator=torch.Generator().manual_seed(seed))
    gradients = torch.autograd.grad(found, (where, *weights, *biases), v)
    truth = torch.autograd.grad(expected, own, v.double())
    for got, want in zip(gradients, truth):
        # Relative to the whole tensor: a value within rounding of 0 may lie on either side of the ReLU.
        assert float((got.double() - want).norm() / want.norm().clamp_min(1e-6)) < 2e-3


@pytest.mark.parametrize("positions, times", [(1, 1), (7, 1), (13, 3), (70, 1)])
@pytest.mark.parametrize("shape", SHAPES)
def test_gradients_of_factors_in_bfloat16(shape, positions, times, products):
    """Ten times closer to the twin that rounds than to the one that does not."""
    weights, biases = parameters(shape, 3)
    where, when = rows(shape, positions, times, 3)
    found = network(where, when, weights, biases, bfloat16=True)
    assert torch.equal(found, network(where, when, weights, biases))
    v = torch.randn(found.shape, generator=torch.Generator().manual_seed(3))
    gradients = torch.autograd.grad(found, (*weights, *biases), v)
    own = [p.detach().double().requires_grad_() for p in (*weights, *biases)]
    half = len(weights)
    exact = torch.autograd.grad(twin(where.double(), when.double(), own[:half], own[half:]), own, v.double())
    with torch.no_grad():
        expected = gradients_in_bfloat16(where.double(), when.double(), own[:half], own[half:], v.double())
    for got, want, unrounded in zip(gradients, expected, exact):
        size = want.norm().clamp_min(1e-6)
        assert float((got.double() - want).norm() / size) < 1e-3
        assert float((got.double() - unrounded).norm() / size) < 2e-2
    of_first, first = gradients[0].double(), (expected[0], exact[0])
    errors = [float((of_first - want).norm()) for want in first]
    assert errors[0] < 0.1 * errors[1], "nothing was rounded"


def test_with_a_gradient_of_the_inputs_nothing_is_rounded():
    weights, biases = parameters(SHAPES[2], 14)
    where, when = rows(SHAPES[2], 9, 2, 14)
    where.requires_grad_()
    results = [
        torch.autograd.grad(network(where, when, weights, biases, bfloat16=bfloat16).sum(), (where, *weights, *biases))
        for bfloat16 in (False, True)
    ]
    assert all(torch.equal(a, b) for a, b in zip(*results))


@pytest.mark.parametrize("found", [0, 1, 2])
def test_factors_are_rounded_where_that_saves_time(found, monkeypatch):
    """Not on a processor that multiplies bfloat16 one by one."""
    asked: list[bool] = []
    monkeypatch.setattr(motion_network, "pair_products", lambda: found)
    monkeypatch.setattr(motion_network, "network", lambda *a, bfloat16: asked.append(bfloat16) or network(*a))
    for wanted in (False, True):
        model = DeformationNetwork({"translations": 3}, width=32, bfloat16_adjoint=wanted)
        model(torch.rand(5, 3), torch.rand(2))
    assert asked == [False, found > 0]


@pytest.mark.parametrize("shape", SHAPES)
def test_values_have_the_precision_of_float32(shape, products):
    weights, biases = parameters(shape, 22)
    where, when = rows(shape, 300, 2, 22)
    with torch.no_grad():
        found = network(where, when, weights, biases).double()
        expected = twin(where.double(), when.double(), [w.double() for w in weights], [b.double() for b in biases])
        rounded = network(where.bfloat16().float(), when, weights, biases).double()
    assert float((found - expected).norm() / expected.norm()) < 1e-6
    assert float((rounded - expected).norm() / expected.norm()) > 1e-4


def test_a_row_has_the_same_bits_in_any_block(products):
    weights, biases = parameters(SHAPES[0], 23)
    where, when = rows(SHAPES[0], 700, 1, 23)
    with torch.no_grad():
        whole = network(where, when, weights, biases)
        for begin, end in ((0, 1), (0, 130), (65, 100), (300, 700)):
            assert torch.equal(network(where[begin:end], when, weights, biases), whole[begin:end])


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_position_that_is_not_finite_spoils_its_own_row_alone(bad, products):
    weights, biases = parameters(SHAPES[1], 24)
    where, when = rows(SHAPES[1], 40, 1, 24)
    clean = network(where, when, weights, biases)
    where[5] = bad
    found = network(where, when, weights, biases)
    assert not bool(found[5].isfinite().all())
    kept = torch.arange(40) != 5
    assert torch.equal(found[kept], clean[kept])


def test_weights_are_packed_only_as_the_kernels_need_them(products, monkeypatch):
    launched: list[str] = []
    launch = ops.launch
    monkeypatch.setattr(ops, "launch", lambda kernel, *a, **k: launched.append(kernel.key) or launch(kernel, *a, **k))
    weights, biases = parameters(SHAPES[0], 25)
    network(*rows(SHAPES[0], 9, 1, 25), weights, biases, bfloat16=True).sum().backward()
    assert launched.count("network_values_parts") == int(products == 2)
    assert launched.count("network_values") == launched.count("pack_weights") == int(products == 1)
    network(*rows(SHAPES[0], 9, 1, 25), weights, biases).sum().backward()
    assert launched.count("network_values_parts") == 2 * int(products == 2)
    assert launched.count("pack_weights") == 1 + int(products == 1)
    with torch.no_grad():
        network(*rows(SHAPES[0], 9, 1, 25), weights, biases)
    assert launched.count("pack_weights") == 1 + 2 * int(products == 1)


@pytest.mark.parametrize("of_inputs", [False, True])
@pytest.mark.parametrize("bfloat16", [False, True])
def test_gradients_are_those_of_the_weights_that_gave_the_values(bfloat16, of_inputs, products):
    gradients = []
    for changed in (False, True):
        weights, biases = parameters(SHAPES[1], 26)
        where, when = rows(SHAPES[1], 9, 1, 26)
        where.requires_grad_(of_inputs)
        out = network(where, when, weights, biases, bfloat16=bfloat16)
        if changed:
            for weight in weights:
                weight.data.mul_(-2.0)
        wanted = (where, *weights, *biases) if of_inputs else (*weights, *biases)
        gradients.append(torch.autograd.grad(out.sum(), wanted))
    assert all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))


def test_tiles_are_used_where_there_are_some(monkeypatch):
    """They add in another order than pairs: some bit differs."""
    found = torch.zeros(1, dtype=torch.int32)
    ops.launch(ops.kernels.find_pair_products, 1, found)
    if int(found) < 2 or not matrix_tiles.may_use_tiles():
        pytest.skip("needs AMX")
    assert ops.pair_products() == 2
    weights, biases = parameters(SHAPES[0], 21)
    where, when = rows(SHAPES[0], 70, 1, 21)
    gradients = []
    for products in (2, 1):
        monkeypatch.setattr(ops, "pair_products", lambda products=products: products)
        out = network(where, when, weights, biases, bfloat16=True)
        gradients.append(torch.autograd.grad(out.square().sum(), (*weights, *biases)))
    assert any(not torch.equal(a, b) for a, b in zip(*gradients, strict=True))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_gradient_that_is_not_finite_is_not_hidden_by_rounding(bad, products):
    weights, biases = parameters(SHAPES[1], 15)
    where, when = rows(SHAPES[1], 9, 1, 15)
    found = network(where, when, weights, biases, bfloat16=True)
    v = torch.ones_like(found)
    v[4] = bad
    if bad != bad:  # bits that a rounding by addition would carry into the sign
        v.view(torch.int32)[4] = 0x7FFFFFFF
    gradients = torch.autograd.grad(found, (*weights, *biases), v)
    assert not bool(gradients[len(weights) - 1].isfinite().all()) and not bool(gradients[-1].isfinite().all())


def test_inputs_without_a_gradient_cost_nothing_and_change_no_bit(monkeypatch):
    weights, biases = parameters(SHAPES[2], 11)
    where, when = rows(SHAPES[2], 13, 2, 11)
    launched: list[str] = []
    launch = ops.launch
    monkeypatch.setattr(ops, "launch", lambda kernel, *a, **k: launched.append(kernel.key) or launch(kernel, *a, **k))
    results = []
    for wanted in (False, True):
        out = network(where.clone().requires_grad_(wanted), when, weights, biases)
        results.append([out, *torch.autograd.grad(out.sum(), (*weights, *biases))])
        assert launched.count("network_inputs_adjoint") == wanted
    assert all(torch.equal(a, b) for a, b in zip(*results))


@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("largest", [32, 64])
def test_the_adjoint_in_parts_gives_the_same_bits(largest, bfloat16, monkeypatch, products):
    weights, biases = parameters(SHAPES[2], 13)
    where, when = rows(SHAPES[2], 51, 2, 13)
    where.requires_grad_(not bfloat16)
    wanted = (*weights, *biases) if bfloat16 else (where, *weights, *biases)
    v = torch.randn(102, 40, generator=torch.Generator().manual_seed(13))
    whole = torch.autograd.grad(network(where, when, weights, biases, bfloat16=bfloat16), wanted, v)
    monkeypatch.setattr(ops, "ADJOINT_ROWS_AT_ONCE", largest)
    parts = torch.autograd.grad(network(where, when, weights, biases, bfloat16=bfloat16), wanted, v)
    assert all(torch.equal(a, b) for a, b in zip(whole, parts))


def test_gradient_of_the_inputs_alone():
    weights, biases = ([p.detach() for p in group] for group in parameters(SHAPES[1], 12))
    where, when = rows(SHAPES[1], 5, 1, 12)
    where.requires_grad_()
    (found,) = torch.autograd.grad(network(where, when, weights, biases).sum(), where)
    own = where.detach().double().requires_grad_()
    expected = twin(own, when.double(), [w.double() for w in weights], [b.double() for b in biases])
    torch.testing.assert_close(found.double(), torch.autograd.grad(expected.sum(), own)[0], rtol=1e-4, atol=1e-6)


def test_without_gradient_in_parts_and_packed_gives_the_same_bits():
    weights, biases = parameters(SHAPES[0], 3)
    where, when = rows(SHAPES[0], 8200, 2, 3)  # more rows than are evaluated at once
    trained = network(where, when, weights, biases).detach()
    with torch.no_grad():
        assert torch.equal(network(where, when, weights, biases), trained)
        assert torch.equal(evaluate(Layers(weights, biases, 76), where, when), trained)


@pytest.mark.parametrize("bfloat16", [False, True])
def test_same_bits_on_any_number_of_threads(bfloat16, products):
    weights, biases = parameters(SHAPES[0], 4)
    where, when = rows(SHAPES[0], 101, 3, 4)
    where.requires_grad_(not bfloat16)
    wanted = (*weights, *biases) if bfloat16 else (where, *weights, *biases)
    results = []
    before = environment.thread_count()
    try:
        for threads in (1, 2, 3):
            environment.configure(threads)
            out = network(where, when, weights, biases, bfloat16=bfloat16)
            results.append([out, *torch.autograd.grad(out, wanted, torch.ones_like(out))])
    finally:
        environment.configure(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_no_positions():
    weights, biases = parameters(SHAPES[1], 5)
    where, when = rows(SHAPES[1], 0, 2, 5)
    rounded = network(where, when, weights, biases, bfloat16=True)
    assert not any(bool(g.any()) for g in torch.autograd.grad(rounded.sum(), (*weights, *biases)))
    where.requires_grad_()
    out = network(where, when, weights, biases)
    assert out.shape == (0, 1)
    gradients = torch.autograd.grad(out.sum(), (where, *weights, *biases))
    assert gradients[0].shape == where.shape and all(not bool(g.any()) for g in gradients)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 3e38])
def test_what_is_not_finite_stays_in_its_row_and_is_not_hidden(bad):
    weights, biases = parameters(SHAPES[1], 6)
    where, when = rows(SHAPES[1], 20, 1, 6)
    clean = network(where, when, weights, biases)
    where[11, 2] = bad
    out = network(where, when, weights, biases)
    others = torch.arange(20) != 11
    assert torch.equal(out[others], clean[others])
    own = [p.detach() for p in (*weights, *biases)]
    expected = twin(where[11:12].double(), when.double(), [p.double() for p in own[:3]], [p.double() for p in own[3:]])
    if bad != bad:
        assert bool(out[11].isnan().all()) and bool(expected.isnan().all())
    if bad == 3e38:
        assert not bool((out[11] == clean[11]).any())


def test_a_column_of_ones_gives_back_the_bias():
    weights, biases = parameters(SHAPES[2], 7)
    with torch.no_grad():
        for weight in weights:
            weight.zero_()
    where, when = rows(SHAPES[2], 3, 2, 7)
    assert torch.equal(network(where, when, weights, biases), biases[-1].expand(6, -1))


def test_refuses_what_does_not_fit():
    weights, biases = parameters(SHAPES[1], 8)
    where, when = rows(SHAPES[1], 3, 1, 8)
    with pytest.raises(ValueError, match=r"weights\[0\]"):
        network(where[:, :-1], when, weights, biases)
    with pytest.raises(ValueError, match="two or more layers"):
        network(where, when, weights[:1], biases[:1])
    odd = [torch.zeros(30, 7), torch.zeros(1, 30)]
    assert not supported(odd, [torch.zeros(30), torch.zeros(1)])
    with pytest.raises(ValueError, match="multiples of 32"):
        network(where, when, odd, [torch.zeros(30), torch.zeros(1)])


@pytest.mark.parametrize("training", [True, False])
def test_deformation_network_agrees_with_its_layers_in_torch(training):
    random = torch.Generator().manual_seed(9)
    model = DeformationNetwork({"rotations": 4, "translations": 3}, generator=random).train(training)
    torch.nn.init.normal_(model.head.weight, std=0.05, generator=random)
    positions, times = torch.randn(50, 3, generator=random), torch.rand(2, generator=random)
    with torch.set_grad_enabled(training):
        fused = model(positions, times)
        layered = model(positions.clone().requires_grad_(), times) if training else None
    assert fused["rotations"].shape == (2, 50, 4) and fused["translations"].shape == (2, 50, 3)
    if layered is not None:
        for name, value in fused.items():
            torch.testing.assert_close(value, layered[name], rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_packed_weights_are_not_kept_when_they_change():
    random = torch.Generator().manual_seed(10)
    model = DeformationNetwork({"translations": 3}, generator=random).eval()
    positions, times = torch.randn(9, 3, generator=random), torch.tensor([0.3])
    first = model(positions, times)["translations"]
    assert torch.equal(model(positions, times)["translations"], first)
    model.head.bias.add_(1.0)  # counted by torch
    second = model(positions, times)["translations"]
    torch.testing.assert_close(second, first + 1.0)
    model.train()
    model.head.bias.numpy()[:] += 1.0  # not counted, as an optimiser's kernel writes
    model.eval()
    torch.testing.assert_close(model(positions, times)["translations"], first + 2.0)


def test_times_and_positions_get_a_gradient_where_they_want_one():
    random = torch.Generator().manual_seed(12)
    model = DeformationNetwork({"translations": 3}, generator=random)
    torch.nn.init.normal_(model.head.weight, std=0.05, generator=random)
    times = torch.tensor([0.2, 0.7], requires_grad=True)
    model(torch.randn(5, 3, generator=random), times)["translations"].sum().backward()
    assert times.grad is not None and bool(times.grad.any())


def test_under_inference_mode_nothing_is_kept():
    random = torch.Generator().manual_seed(13)
    with torch.inference_mode():
        model = DeformationNetwork({"translations": 3}, generator=random).eval()
        positions, times = torch.randn(9, 3, generator=random), torch.tensor([0.3])
        first = model(positions, times)["translations"]
        model.head.bias.add_(1.0)
        torch.testing.assert_close(model(positions, times)["translations"], first + 1.0)
