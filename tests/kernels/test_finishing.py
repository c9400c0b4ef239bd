"""What follows skinning, in one launch each way: against float64, and to the bit against the functions of its parts."""

from __future__ import annotations

import functools
import math

import pytest
import torch
from torch import Tensor

from reference.finishing import finish as finish_reference
from scgs_warp.gaussians import GaussianParameters
from scgs_warp.motion.control_points import _posed
from scgs_warp.ops import correctives, shading
from scgs_warp.ops import finishing as ops
from scgs_warp.ops.activations import exponential, sigmoid
from scgs_warp.runtime import environment
from scgs_warp.types import Pose

NAMES = (
    *("means", "quats_t", "rest means", "quats", "log_scales", "opacity_logits", "sh_dc", "correctives", "shading"),
    *("added log_scales", "tints", "quats_own"),
)
LEARNT = [name for name in NAMES if name not in ("quats_t", "rest means", "quats", "quats_own")]
OUTPUTS = ("means", "scales", "opacities", "sh_dc")
WIDTHS = {"means": 3, "quats_t": 4, "rest means": 3, "quats": 4, "log_scales": 3, "opacity_logits": 1, "sh_dc": 3}
SIZES = [0, 1, 15, 16, 257]
PARTS = [(corrected, shaded) for corrected in (False, True) for shaded in (False, True)]
EXTRAS = [None, "tints", "added log_scales"]


@pytest.fixture(params=["plain", "cpu"])
def finish(request, device):
    if request.param == "cpu" and device != "cpu":
        pytest.skip("SIMD is for the CPU")
    return functools.partial(ops.finish, form=request.param)


def draw(n: int, corrected=True, shaded=True, extras: str | None = "tints", edited=False) -> dict[str, Tensor | None]:
    """Draw the inputs by name; None for those that are not there."""
    g = torch.Generator().manual_seed(n + 1)
    widths = {**WIDTHS, "correctives": 27 * corrected, "shading": 10 * shaded}
    widths |= {"added log_scales": 3 * (extras == "added log_scales"), "tints": 3 * (extras == "tints")}
    found: dict[str, Tensor | None] = {name: torch.randn(n, width, generator=g) for name, width in widths.items()}
    for name in ("added log_scales", "tints"):
        found[name] = 1.7 * found[name] if name == extras else None  # tints beyond both limits
    own = torch.randn(n, 4, generator=g)
    return {**found, "opacity_logits": 3.0 * found["opacity_logits"][:, 0], "quats_own": own if edited else None}


def arguments(inputs: dict[str, Tensor | None]) -> tuple:
    """Return the arguments of ``finish`` in their order."""
    values = [inputs[name] for name in NAMES]
    return values[0], values[1], tuple(values[2:9]), *values[9:]


def results(finish, inputs: dict[str, Tensor | None], weights: dict[str, Tensor]) -> dict[str, Tensor | None]:
    """Return the outputs, and the gradients of their products with ``weights``, by name. All inputs ask for them."""
    leaves = {name: None if x is None else x.detach().clone().requires_grad_() for name, x in inputs.items()}
    found = dict(zip(OUTPUTS, finish(*arguments(leaves)), strict=True))
    torch.autograd.backward([found[name] for name in weights], [weights[name].to(found[name]) for name in weights])
    gradients = {f"gradient of {name}": None if x is None else x.grad for name, x in leaves.items()}
    return {name: value.detach() for name, value in found.items()} | gradients


def weights_of(n: int) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(99)
    return {name: torch.randn(n, 3, generator=g)[:, 0 if name == "opacities" else slice(3)] for name in OUTPUTS}


def in_parts(means, quats_t, rest, log_scales, tints, own):
    """Call the parts one by one, as they run on a CPU."""
    _, quats, rest_scales, logits, sh_dc, matrices, gains = rest
    if matrices.shape[1]:
        means = correctives.correct(means, matrices, quats, quats_t, own)
    if tints is not None:
        sh_dc = shading.tint(sh_dc, tints)
    if gains.shape[1]:
        sh_dc = shading.shade(sh_dc, gains, quats, quats_t if own is None else own)
    scales = exponential(rest_scales if log_scales is None else rest_scales + log_scales)
    return means, scales, sigmoid(logits), sh_dc


def assert_same(found: dict, expected: dict, tolerance: float = 0.0) -> None:
    for name, value in expected.items():
        assert (found[name] is None) == (value is None), name
        if value is not None:
            torch.testing.assert_close(
                *(found[name], value),
                rtol=tolerance,
                atol=tolerance,
                equal_nan=True,
                msg=lambda text, name=name: f"{name}: {text}",
            )


def moved_to(inputs: dict[str, Tensor | None], device) -> dict[str, Tensor | None]:
    return {name: None if x is None else x.to(device) for name, x in inputs.items()}


@pytest.mark.parametrize("edited", [False, True])
@pytest.mark.parametrize("extras", EXTRAS)
@pytest.mark.parametrize(("corrected", "shaded"), PARTS)
@pytest.mark.parametrize("n", SIZES)
def test_values_and_gradients(n, corrected, shaded, extras, edited, device, finish):
    inputs = draw(n, corrected, shaded, extras, edited)
    doubles = moved_to(inputs, torch.float64)
    expected = results(finish_reference, doubles, weights_of(n))
    found = results(finish, moved_to(inputs, device), weights_of(n))
    for name in (*OUTPUTS, *(f"gradient of {name}" for name in LEARNT)):
        if expected[name] is None or not expected[name].numel():
            assert found[name] is None or not found[name].numel(), name
        else:
            assert found[name].device.type == device
            torch.testing.assert_close(
                found[name].cpu().double(), expected[name], rtol=1e-4, atol=2e-5, msg=lambda m, at=name: f"{at}: {m}"
            )
    for name in ("quats_t", "rest means", "quats", "quats_own"):
        assert found[f"gradient of {name}"] is None, "training must not turn surfaces"


@pytest.mark.parametrize("edited", [False, True])
@pytest.mark.parametrize("extras", EXTRAS)
@pytest.mark.parametrize(("corrected", "shaded"), PARTS)
@pytest.mark.parametrize("n", SIZES)
def test_the_bits_are_those_of_the_parts(n, corrected, shaded, extras, edited):
    inputs = draw(n, corrected, shaded, extras, edited)
    found, expected = (results(finish, inputs, weights_of(n)) for finish in (ops.finish, in_parts))
    assert_same(found, expected)


@pytest.mark.parametrize("extras", EXTRAS)
@pytest.mark.parametrize("edited", [False, True])
def test_extremes_are_left_out_as_in_the_parts(extras, edited):
    """Extreme and non-finite values, one kind in each row: what passes, and what learns nothing, is the same."""
    inputs, weights = draw(120, extras=extras, edited=edited), weights_of(120)
    names = [name for name in NAMES if inputs[name] is not None]
    values = (math.nan, math.inf, -math.inf, 3e38, -3e38, 1e30, 0.0)
    for number, value in enumerate(values):
        for offset, name in enumerate(names):
            row = inputs[name][len(names) * number + offset]
            row[... if name == "opacity_logits" else 2] = value
    if extras == "tints":  # at its limits, a tint learns nothing
        inputs["tints"][100], inputs["tints"][101] = -3.0, 1.0
    inputs["shading"][102, 9] = math.inf
    for number, name in enumerate(OUTPUTS):
        weights[name][104 + 2 * number], weights[name][105 + 2 * number] = math.nan, 3e38
    found, expected = (results(finish, inputs, weights) for finish in (ops.finish, in_parts))
    assert_same(found, expected)


def test_a_broken_gaussian_does_not_change_its_neighbours(device, finish):
    inputs, weights = moved_to(draw(35), device), weights_of(35)
    sound, broken = results(finish, inputs, weights), {}
    for number, (name, value) in enumerate(inputs.items()):
        broken[name] = None if value is None else value.clone()
        if value is not None:
            broken[name][17 + number % 3] = math.nan if number % 2 else math.inf
    others = torch.tensor([i for i in range(35) if not 17 <= i <= 19], device=device)
    found = results(finish, broken, weights)
    for name, value in sound.items():
        if value is not None:
            torch.testing.assert_close(found[name][others], value[others], rtol=0, atol=0)


@pytest.mark.parametrize("used", OUTPUTS)
def test_one_output_alone_has_the_gradients_of_its_parts(used):
    inputs, weights = draw(40), {used: weights_of(40)[used]}
    found, expected = (results(finish, inputs, weights) for finish in (ops.finish, in_parts))
    for name, value in found.items():
        other = expected[name]
        assert (value is None) == (other is None), name
        if value is not None and other is not None:
            assert torch.equal(value, other), name


@pytest.mark.parametrize("extras", EXTRAS)
def test_rows_that_are_not_contiguous(extras, device, finish):
    inputs = moved_to(draw(40, extras=extras, edited=True), device)
    apart = {name: None if x is None else torch.stack([x, x], -1)[..., 0] for name, x in inputs.items()}
    leaves = {name: None if x is None else x.requires_grad_() for name, x in apart.items()}
    weights = weights_of(40)
    spread = [torch.stack([x, x], -1).to(device)[..., 0] for x in weights.values()]
    assert not leaves["means"].is_contiguous() and not spread[0].is_contiguous()
    found = finish(*arguments(leaves))
    names = [name for name in LEARNT if leaves[name] is not None]
    gradients = torch.autograd.grad(found, [leaves[name] for name in names], spread)
    expected = results(finish, inputs, weights)
    ours = zip((*OUTPUTS, *(f"gradient of {name}" for name in names)), (*found, *gradients), strict=True)
    for name, value in ours:  # torch's exponential of strided values rounds otherwise
        assert_same({name: value.detach()}, {name: expected[name]}, 0.0 if device == "cpu" else 2e-6)


def test_what_is_not_there_costs_nothing(device):
    inputs = moved_to(draw(20, corrected=False, shaded=False, extras=None), device)
    leaves = {name: None if x is None else x.requires_grad_() for name, x in inputs.items()}
    means, scales, opacities, sh_dc = ops.finish(*arguments(leaves))
    assert means is leaves["means"] and sh_dc is leaves["sh_dc"]
    (scales.sum() + opacities.sum()).backward()
    assert leaves["correctives"].grad is None and leaves["shading"].grad is None


def test_what_asks_for_no_gradient_gets_none():
    inputs = draw(20, corrected=False)
    inputs["quats_t"].requires_grad_()
    inputs["means"].requires_grad_()
    assert [x.requires_grad for x in ops.finish(*arguments(inputs))] == [True, False, False, False]
    inputs["tints"].requires_grad_()
    with torch.no_grad():
        assert not any(x.requires_grad for x in ops.finish(*arguments(inputs))[1:])


@pytest.mark.parametrize("form", ["cuda", "CPU", ""])
def test_an_unknown_form_is_refused(form):
    with pytest.raises(ValueError, match="form must be"):
        ops.finish(*arguments(draw(5)), form=form)


def test_a_cpu_takes_one_node():
    """The SIMD form is chosen, by training as well."""
    inputs = {name: None if x is None else x.requires_grad_() for name, x in draw(50, edited=True).items()}
    found = ops.finish(*arguments(inputs))
    assert len({x.grad_fn for x in found}) == 1
    assert all(torch.equal(a, b) for a, b in zip(found, ops.finish(*arguments(inputs), form="cpu"), strict=True))
    assert len({x.grad_fn for x in ops.finish(*arguments(inputs), form="plain")}) == 4
    made = GaussianParameters(torch.zeros(9, 3), torch.zeros(9, 3), torch.zeros(9, 3), shaded=True, corrected=True)
    pose = Pose(torch.zeros(4, 3), torch.ones(4, 4), tints=torch.zeros(4, 3))
    posed = _posed(made, (torch.zeros(9, 3), torch.ones(9, 4), torch.zeros(9, 3)), pose, masked=False)
    assert len({x.grad_fn for x in (posed.means, posed.scales, posed.opacities, posed.sh_dc)}) == 1


def test_same_bits_for_any_thread_count(all_threads):
    inputs, weights, found = draw(5000, edited=True), weights_of(5000), []
    for threads in (1, 2, 3):
        environment.configure(threads=threads)
        found.append(results(ops.finish, inputs, weights))
    for other in found[1:]:
        assert_same(other, found[0])


@pytest.mark.parametrize("name", [name for name in NAMES if name != "rest means"])
def test_wrong_shapes_are_named(name, device, finish):
    inputs = moved_to(
        draw(5, extras="added log_scales" if name == "added log_scales" else "tints", edited=True), device
    )
    inputs[name] = inputs[name][:-1]
    with pytest.raises(ValueError, match=f"{name} must be"):
        finish(*arguments(inputs))


def test_log_scales_and_tints_are_refused_together(device):
    inputs = moved_to(draw(5), device)
    inputs["added log_scales"] = inputs["tints"]
    with pytest.raises(ValueError, match="not both"):
        ops.finish(*arguments(inputs))
