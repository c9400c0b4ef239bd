"""Projection against plain torch in float64, and against gsplat's torch code."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.scenes import random_camera, random_gaussians
from reference.projection import project as project_reference
from reference.projection import rows_error
from scgs_warp.ops.projection import project
from scgs_warp.runtime import environment
from scgs_warp.types import Camera, Splats

FIELDS = ("means2d", "conics", "depths", "opacities")


def shape_of(g):
    return [g.means, g.quats, g.scales, g.opacities]


def forms(device):
    """SIMD has no gradient of the view matrix: the plain kernel stands in for it where that is asked for."""
    return ["plain", "cpu"] if torch.device(device).type == "cpu" else ["plain"]


def gradients(function, inputs, camera, weights, view=True, **options):
    """Splats, and gradients to the inputs and the view matrix of a weighted sum of all the splats' fields."""
    dtype = inputs[0].dtype
    leaves = [x.detach().clone().requires_grad_() for x in (*inputs, camera.viewmat.to(dtype))]
    leaves[4].requires_grad_(view)
    splats = function(*leaves, camera.K.to(dtype), camera.width, camera.height, **options)
    fields = [getattr(splats, name) for name in FIELDS]
    torch.autograd.backward(fields, [w.to(f) for w, f in zip(weights, fields)])
    return splats, [leaf.grad for leaf in leaves]


def compare(inputs, camera, seed, tolerance=1e-3, **options):
    for form in forms(inputs[0].device):
        ours = compare_form(form, inputs, camera, seed, tolerance, **options)
    return ours


def compare_form(form, inputs, camera, seed, tolerance, **options):
    n = len(inputs[0])
    generator = torch.Generator().manual_seed(seed)
    weights = [torch.randn(n, *s, generator=generator) for s in ((2,), (3,), (), ())]
    twin_inputs = [x.double() for x in inputs]
    probe = project_reference(
        *twin_inputs, camera.viewmat.double(), camera.K.double(), camera.width, camera.height, **options
    )
    # A conic of a thin splat is large; weighted by its size, no row outshines the others.
    weights[1] /= probe.conics.cpu().float().norm(dim=1, keepdim=True).clamp_min(1e-3)
    ours, ours_grad = gradients(project, inputs, camera, weights, form == "plain", form=form, **options)
    twin, twin_grad = gradients(project_reference, twin_inputs, camera, weights, **options)
    same = (ours.radii == twin.radii).all(1)
    assert (~same).sum() <= max(1, n // 500)  # rounding may move a ceil, or a splat over the edge
    assert ((ours.radii - twin.radii)[(ours.radii[:, 0] > 0) & (twin.radii[:, 0] > 0)].abs() <= 1).all()
    seen = (ours.radii[:, 0] > 0) & (twin.radii[:, 0] > 0)
    for name in FIELDS:
        a, b = getattr(ours, name).double(), getattr(twin, name)
        torch.testing.assert_close(a[seen], b[seen], rtol=2e-4, atol=2e-4, msg=lambda m, name=name: f"{name}: {m}")
        assert not a[ours.radii[:, 0] == 0].any()
    for name, a, b in zip(("means", "quats", "scales", "opacities"), ours_grad, twin_grad):
        error = rows_error(a[seen], b[seen])
        assert error.max() < tolerance, f"{name}: row {error.argmax()} is off by {error.max():.2e}"
        assert not a[ours.radii[:, 0] == 0].any()
    if same.all() and form == "plain":
        error = (ours_grad[4].double() - twin_grad[4]).norm() / twin_grad[4].norm()
        assert error < 1e-4, f"viewmat: {error:.2e}"
    return ours


@pytest.mark.parametrize("sharpness", [0.0, 0.5])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize(("seed", "n", "size"), [(0, 300, (64, 48)), (1, 1000, (33, 65)), (2, 1000, (320, 200))])
def test_values_and_gradients(seed, n, size, antialiased, sharpness, device):
    g, camera = random_gaussians(seed, n, device), random_camera(seed, *size, device)
    ours = compare(shape_of(g), camera, seed, antialiased=antialiased, sharpness=sharpness)
    assert ours.sharpness == sharpness
    visible = (ours.radii[:, 0] > 0).float().mean()
    assert 0.2 < visible < 0.99  # both branches are met


@pytest.mark.parametrize("seed", range(2))
def test_close_to_the_camera_where_the_jacobian_is_clamped(seed, device):
    """Wide splats whose means lie outside the widened frustum still reach the image."""
    g = random_gaussians(seed, 2000, device, spread=3.0, scale=(0.3, 1.0))
    camera = random_camera(seed, 40, 30, device, distance=1.0)
    ours = compare(shape_of(g), camera, seed, near_plane=0.2)
    clamped = (ours.means2d[:, 0] - 20).abs() > 0.5 * 40 * 1.3 + 8
    assert (clamped & (ours.radii[:, 0] > 0)).sum() > 10


@pytest.mark.parametrize(
    "options",
    [
        {"radius_clip": 5.0},
        {"eps2d": 0.0},
        {"eps2d": 2.0},
        {"near_plane": 4.0},
        {"far_plane": 3.5},
        {"sharpness": 2.0},
    ],
)
def test_options(options, device):
    g, camera = random_gaussians(3, 800, device), random_camera(3, 100, 80, device)
    ours = compare(shape_of(g), camera, 3, **options)
    default = project(*shape_of(g), camera.viewmat, camera.K, 100, 80)
    assert not torch.equal(ours.radii, default.radii)


@pytest.mark.parametrize("sharpness", [-0.1, 101.0, float("nan"), float("inf")])
def test_a_sharpness_out_of_range_is_refused(sharpness):
    g, camera = random_gaussians(3, 5), random_camera(3, 10, 8)
    with pytest.raises(ValueError, match=r"sharpness must be in 0 \.\. 100"):
        project(*shape_of(g), camera.viewmat, camera.K, 10, 8, sharpness=sharpness)


def test_against_gsplat():
    oracle = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is not installed")
    g, camera = random_gaussians(4, 2000), random_camera(4, 160, 120)
    covariances, _ = oracle._quat_scale_to_covar_preci(g.quats, g.scales, compute_preci=False)
    radii, means2d, depths, conics, compensations = oracle._fully_fused_projection(
        g.means, covariances, camera.viewmat[None], camera.K[None], 160, 120, calc_compensations=True
    )
    for antialiased in (False, True):
        ours = project(*shape_of(g), camera.viewmat, camera.K, 160, 120, antialiased=antialiased)
        seen = ours.radii[:, 0] > 0
        assert seen.sum() > 500 and (radii[0][seen] > 0).all()
        torch.testing.assert_close(ours.means2d[seen], means2d[0][seen], rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(ours.depths[seen], depths[0][seen], rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(ours.conics[seen], conics[0][seen], rtol=1e-3, atol=1e-4)
        opacities = g.opacities * compensations[0] if antialiased else g.opacities
        torch.testing.assert_close(ours.opacities[seen], opacities[seen], rtol=1e-3, atol=1e-4)
        # Theirs are those of opacity 1 and more: ours end where alpha is 1 / 255.
        assert (ours.radii <= radii[0]).all()
        left_out = (radii[0] > 0).all(1) & ~seen
        ratio = (2 * torch.log((255 * opacities).clamp_min(1.0))).sqrt() / 3.33
        shrunk = torch.ceil(radii[0] * ratio[:, None])
        outside = (means2d[0] + shrunk <= 1) | (means2d[0] - shrunk >= torch.tensor([159, 119]))
        assert (outside.any(1) | (opacities < 1 / 255))[left_out].all()


def test_radius_ends_where_alpha_is_one_255th(device):
    g, camera = random_gaussians(5, 500, device), random_camera(5, 200, 150, device)
    ours = project(*shape_of(g), camera.viewmat, camera.K, 200, 150)
    seen = ours.radii[:, 0] > 0
    a, b, c = ours.conics[seen].double().unbind(1)
    for axis, (along, across) in enumerate(((a, c), (c, a))):
        for side, wanted in ((0, False), (-1, True)):
            # The largest alpha on the line at this distance from the mean, along the other axis.
            distance = (ours.radii[seen][:, axis] + side).double()
            sigma = 0.5 * (along - b * b / across) * distance**2
            alpha = ours.opacities[seen].double() * torch.exp(-sigma)
            reached = alpha >= (1 - 1e-4 if side else 1 + 1e-4) / 255
            assert (reached == wanted).all()


def test_what_is_culled_is_zero_and_passes_no_gradient(device):
    g, camera = random_gaussians(6, 24, device, spread=0.1), random_camera(6, 64, 64, device)
    inputs = [x.clone() for x in shape_of(g)]
    inputs[3][:] = 0.5
    nan, inf = float("nan"), float("inf")
    for row, (field, value) in enumerate(
        [(f, v) for f in range(4) for v in (nan, inf, -inf)] + [(1, 0.0), (3, 0.0), (3, 1 / 256), (3, -1.0), (0, 1e20)]
    ):
        if inputs[field].ndim == 2:
            inputs[field][row, :] = value
        else:
            inputs[field][row] = value
    inputs[0][17] = 3 * camera.position  # behind
    inputs[2][18] = 1e25
    inputs[0][19, 1] = nan  # one component alone
    inputs[1][20, 3] = nan
    inputs[2][21, 2] = inf
    weights = [torch.ones(24, *s) for s in ((2,), (3,), (), ())]
    for form in forms(device):
        view = form == "plain"
        ours, grads = gradients(project, inputs, camera, weights, view, form=form)
        culled = ours.radii[:, 0] == 0
        assert culled.tolist() == [True] * 22 + [False] * 2
        for name in FIELDS:
            assert getattr(ours, name).isfinite().all() and not getattr(ours, name)[culled].any()
        for grad in grads[:4]:
            assert grad.isfinite().all() and not grad[culled].any() and grad[~culled].any()
        rest = [x[22:] for x in inputs], camera, [w[22:] for w in weights], view
        alone, alone_grads = gradients(project, *rest, form=form)
        assert torch.equal(alone.means2d, ours.means2d[22:])
        if view:
            assert grads[4].isfinite().all()
            torch.testing.assert_close(alone_grads[4], grads[4])


def test_empty_and_one(device):
    camera = random_camera(7, 31, 17, device)
    for n in (0, 1, 15, 17):
        g = random_gaussians(7, n, device, spread=0.0)
        ours, grads = gradients(project, shape_of(g), camera, [torch.ones(n, *s) for s in ((2,), (3,), (), ())])
        assert isinstance(ours, Splats) and ours.radii.shape == (n, 2) and ours.radii.dtype == torch.int32
        assert grads[4].shape == (4, 4) and bool(grads[4].any()) == (n > 0)


def test_only_what_is_asked_for_has_a_gradient(device):
    g, camera = random_gaussians(8, 50, device), random_camera(8, 64, 48, device)
    splats = project(*shape_of(g), camera.viewmat, camera.K, 64, 48)
    assert not splats.means2d.requires_grad
    opacities = g.opacities.clone().requires_grad_()
    splats = project(g.means, g.quats, g.scales, opacities, camera.viewmat, camera.K, 64, 48)
    splats.opacities.sum().backward()
    assert torch.equal(opacities.grad, (splats.radii[:, 0] > 0).float())


def test_same_bits_for_any_thread_count(all_threads):
    g, camera = random_gaussians(9, 5000), random_camera(9, 128, 128)
    weights = [torch.randn(5000, *s, generator=torch.Generator().manual_seed(9)) for s in ((2,), (3,), (), ())]
    results = []
    for threads in (1, 2, 3):
        environment.configure(threads=threads)
        splats, grads = gradients(project, shape_of(g), camera, weights)
        _, lanes_grads = gradients(project, shape_of(g), camera, weights, view=False)
        results.append([splats.means2d, splats.conics, splats.radii, *grads, *lanes_grads[:4]])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


@settings(deadline=None, max_examples=20)
@given(*(st.integers(*bounds) for bounds in ((5, 200), (1, 10), (5, 100), (-90, 90), (-90, 90))))
def test_ball_on_the_axis_and_off_it(z, scale, opacity, u, v):
    """A ball projects to the ellipse of the linearised camera, whose conic is known in closed form."""
    # Integers: hypothesis refuses to draw floats in a process that flushes denormals to zero.
    z, opacity, u, v = z / 10, opacity / 100, u / 100, v / 100
    scale = scale / 200 * z
    f, size = 100.0, 200
    camera = Camera(torch.eye(4), torch.tensor([[f, 0, 100.0], [0, f, 100.0], [0, 0, 1]]), size, size)
    ones, quat = torch.ones(1), torch.tensor([[0.3, -0.5, 0.7, 0.2]])
    splats = project(
        torch.tensor([[u * z, v * z, z]]), quat, scale * torch.ones(1, 3), opacity * ones,
        camera.viewmat, camera.K, size, size, eps2d=0.0,
    )  # fmt: skip
    s2 = (f * scale / z) ** 2
    covariance = s2 * torch.tensor([[1 + u * u, u * v], [u * v, 1 + v * v]])
    conic = torch.linalg.inv(covariance.double())
    torch.testing.assert_close(
        splats.conics[0].double(), torch.stack([conic[0, 0], conic[0, 1], conic[1, 1]]), rtol=1e-4, atol=1e-4
    )
    expected = math.ceil(math.sqrt(2 * math.log(255 * opacity) * s2 * (1 + u * u)) - 1e-4)
    assert abs(int(splats.radii[0, 0]) - expected) <= 1


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "viewmat", "K", "width"])
def test_wrong_arguments_are_named(name):
    g, camera = random_gaussians(0, 5), random_camera(0, 20, 10)
    arguments = dict(
        means=g.means, quats=g.quats, scales=g.scales, opacities=g.opacities,
        viewmat=camera.viewmat, K=camera.K, width=20, height=10,
    )  # fmt: skip
    arguments[name] = 0 if name == "width" else arguments[name][..., None]
    with pytest.raises(ValueError, match=name):
        project(**arguments)
