"""Spherical harmonics against their definition in float64, and against gsplat's torch code."""

from __future__ import annotations

import functools

import pytest
import torch

from helpers.scenes import random_camera, random_gaussians
from reference.harmonics import spherical_harmonics as harmonics_reference
from scgs_warp.ops import harmonics
from scgs_warp.runtime import environment


def skip_elsewhere(form, device):
    if form in ("cpu", "cuda") and device != form:
        pytest.skip("SIMD is for the CPU" if form == "cpu" else "blocks of threads are for CUDA")


@pytest.fixture(params=["plain", "cpu", "cuda", "whole plain", "whole cuda"])
def spherical_harmonics(request, device):
    *of_whole, form = request.param.split()
    skip_elsewhere(form, device)
    return functools.partial(whole if of_whole else harmonics.spherical_harmonics, form=form)


def whole(dc, rest, means, camera, degree, form):
    """With all coefficients in one tensor."""
    return harmonics._WholeHarmonics.apply(torch.cat([dc[:, None], rest], 1), means, camera, degree, form)


CAMERA = (0.5, -3.0, 2.0)


def inputs_of(seed, n, device, degree=3):
    g = random_gaussians(seed, n, device, degree=degree)
    return [g.sh_dc, g.sh_rest, g.means, torch.tensor(CAMERA, device=device)]


def gradients(function, inputs, degree, weights):
    leaves = [x.detach().clone().requires_grad_() for x in inputs]
    output = function(*leaves, degree)
    (output * weights.to(output)).sum().backward()
    return output.detach(), [leaf.grad for leaf in leaves]


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize(("seed", "n"), [(0, 1), (1, 333), (2, 1024), (3, 16)])
def test_values_and_gradients(seed, n, degree, device, spherical_harmonics):
    inputs = inputs_of(seed, n, device)
    weights = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))
    ours, ours_grad = gradients(spherical_harmonics, inputs, degree, weights)
    twin, twin_grad = gradients(harmonics_reference, [x.double() for x in inputs], degree, weights)
    assert ours.device.type == device
    torch.testing.assert_close(ours.double(), twin, rtol=1e-5, atol=5e-6)
    # A channel that the two clamp differently may change its row; there is none this close to zero in these scenes.
    for name, a, b in zip(("sh_dc", "sh_rest", "means", "camera"), ours_grad, twin_grad):
        if a is None or b is None:  # degree 0 depends on no direction
            assert degree == 0 and (b is None or not b.any()), name
            continue
        torch.testing.assert_close(a.double(), b, rtol=1e-4, atol=2e-5, msg=lambda m, name=name: f"{name}: {m}")
    unused = ours_grad[1][:, (degree + 1) ** 2 - 1 :]
    assert torch.equal(unused, torch.zeros_like(unused))


def test_exact_size_and_empty(device, spherical_harmonics):
    for degree in range(4):
        dc, rest, means, camera = inputs_of(degree, 20, device, degree)
        more = inputs_of(degree, 20, device, 3)
        more[1] = torch.cat([rest, more[1][:, rest.shape[1] :]], dim=1)
        result = spherical_harmonics(dc, rest, means, camera, degree)
        assert torch.equal(result, spherical_harmonics(dc, more[1], means, camera, degree))
    empty = [x.detach().requires_grad_() for x in inputs_of(0, 0, device)]
    result = spherical_harmonics(*empty, 3)
    assert result.shape == (0, 3)
    result.sum().backward()
    assert not empty[3].grad.any()


def test_against_gsplat(device, spherical_harmonics):
    oracle = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is not installed")
    dc, rest, means, camera = inputs_of(5, 500, "cpu")
    directions = torch.nn.functional.normalize(means - camera, dim=-1)
    for degree in range(4):
        theirs = oracle._spherical_harmonics(degree, directions, torch.cat([dc[:, None], rest], 1))
        ours = spherical_harmonics(*(x.to(device) for x in (dc, rest, means, camera)), degree)
        torch.testing.assert_close(ours.cpu(), (theirs + 0.5).clamp_min(0.0), rtol=1e-5, atol=5e-6)


def test_broken_inputs_stay_where_they_are(device, spherical_harmonics):
    inputs = inputs_of(3, 6, device)
    inputs[0][1] = float("nan")
    inputs[1][2] = float("nan")
    inputs[2][3] = float("nan")
    inputs[2][4] = inputs[3]  # no direction
    inputs[2][5] = float("inf")
    weights = torch.ones(6, 3)
    ours, grads = gradients(spherical_harmonics, inputs, 3, weights)
    assert ours[[0, 3, 4, 5]].isfinite().all()
    assert ours[1].isnan().all() and ours[2].isnan().all()  # so that compositing leaves them out
    assert all(g.isfinite().all() for g in grads)
    assert not any(g[[1, 2]].any() for g in grads[:3])
    assert not grads[2][4].any()


def test_same_bits_for_any_thread_count(all_threads):
    inputs, weights = inputs_of(4, 5000, "cpu"), torch.randn(5000, 3, generator=torch.Generator().manual_seed(0))
    results = []
    for threads in (1, 2, 3):
        environment.configure(threads=threads)
        ours, grads = gradients(harmonics.spherical_harmonics, inputs, 3, weights)
        results.append([ours, *grads])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_wrong_arguments_are_named():
    dc, rest, means, camera = inputs_of(0, 4, "cpu", degree=1)
    with pytest.raises(ValueError, match="degree"):
        harmonics.spherical_harmonics(dc, rest, means, camera, 2)
    with pytest.raises(ValueError, match="degree"):
        harmonics.spherical_harmonics(dc, rest, means, camera, -1)
    with pytest.raises(ValueError, match="sh_rest"):
        harmonics.spherical_harmonics(dc, rest[:3], means, camera, 1)
    with pytest.raises(ValueError, match="camera_position"):
        harmonics.spherical_harmonics(dc, rest, means, camera[None], 1)
    with pytest.raises(ValueError, match="means"):
        harmonics.spherical_harmonics(dc, rest, means[:2], camera, 1)
    with pytest.raises(ValueError, match="form must be auto, plain, cpu or cuda, got 'pixel'"):
        harmonics.spherical_harmonics(dc, rest, means, camera, 1, form="pixel")  # type: ignore[arg-type]


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("n", [0, 1, 333])
@pytest.mark.parametrize("form", ["plain", "cpu", "cuda"])
def test_colours_beside_depths(form, n, degree, device):
    skip_elsewhere(form, device)
    dc, rest, means, _ = inputs_of(4, n, device)
    camera = random_camera(4, 60, 40, device)
    depths = torch.rand(n, generator=torch.Generator().manual_seed(n)).to(device)
    channels = harmonics.colors_and_depths(dc, rest, means, camera.viewmat, depths, degree, form=form)
    expected = harmonics_reference(dc.double(), rest.double(), means.double(), camera.position.double(), degree)
    torch.testing.assert_close(channels[:, :3].double(), expected, rtol=1e-5, atol=5e-6)
    assert torch.equal(channels[:, 3], depths)


def test_arguments_of_colours_beside_depths(device):
    dc, rest, means, camera = inputs_of(4, 5, device)
    viewmat, depths = torch.eye(4, device=device), torch.ones(5, device=device)
    for wrong in ((viewmat[:3], depths, 3), (viewmat, depths[:4], 3), (viewmat, depths, 4)):
        with pytest.raises(ValueError, match=r"viewmat|depths|degree"):
            harmonics.colors_and_depths(dc, rest, means, *wrong)
    whole_of = torch.cat([dc[:, None], rest], 1)
    assert torch.equal(
        harmonics.whole_harmonics(whole_of, means, camera, 3), harmonics.spherical_harmonics(dc, rest, means, camera, 3)
    )
    for wrong in ((means, camera[None], 3), (means, camera, 4), (means[:2], camera, 1)):
        with pytest.raises(ValueError, match=r"camera_position|degree|means"):
            harmonics.whole_harmonics(whole_of, *wrong)
