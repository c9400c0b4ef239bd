"""Distances between spheres and a silhouette: against plain torch in float64, at borders, in ties, without sense."""

from __future__ import annotations

import functools
import math
from typing import Any

import pytest
import torch
from torch import Tensor

from helpers.gradients import value_and_gradients
from reference.silhouette import silhouette as reference
from scgs_warp.ops import silhouette as ops
from scgs_warp.runtime import environment
from scgs_warp.types import Camera

WIDTH = 40
BEHIND, NEAR, OUTSIDE = range(3)
"""The first spheres of a scene: behind the camera, nearer than the smallest depth, and beside the image."""


@pytest.fixture(params=["plain", "cpu"])
def silhouette(request, device):
    if request.param == "cpu" and device != "cpu":
        pytest.skip("SIMD is for the CPU")
    return functools.partial(ops.silhouette, form=request.param)


def straight(device: str = "cpu") -> Camera:
    """A camera at distance 1 before the plane z = 0, whose points (x, y) it sees at (x, y), in image widths."""
    view = torch.eye(4)
    view[2, 3] = 1.0
    return Camera(view, torch.diag(torch.tensor([WIDTH, WIDTH, 1.0])), WIDTH, WIDTH).to(device)


def oblique(device: str = "cpu") -> Camera:
    """A camera of general position and skewed pixels."""
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).double())
    view = torch.eye(4)
    view[:3, :3] = rotation.float()
    view[:3, 3] = torch.tensor([0.1, -0.2, 3.0])
    return Camera(view, torch.tensor([[44.0, 1.5, 19.0], [0.5, 41.0, 16.0], [0.0, 0.0, 1.0]]), WIDTH, 32).to(device)


def draw(seed: int, spheres: int, pixels: int, camera: Camera) -> list[Tensor]:
    """Return centres, distances, their size, and pixels; the first spheres are at places that are special."""
    g = torch.Generator().manual_seed(seed)
    local = torch.randn(spheres, 3, generator=g) * torch.tensor([1.2, 0.8, 0.5]) + torch.tensor([0.0, 0.0, 3.0])
    special = torch.tensor([[0.2, 0.1, -2.0], [0.001, -0.002, 0.004], [9.0, -8.0, 3.0]])[:spheres]
    local[: len(special)] = special
    view = camera.viewmat.cpu()
    means = (local - view[:3, 3]) @ view[:3, :3]
    table = torch.rand(11, 17, generator=g)
    return [x.to(means) for x in (means, table, torch.tensor([1.02, 0.66]), torch.rand(pixels, 2, generator=g))]


def run(op: Any, camera: Camera, inputs: list[Tensor], weight: float = 1.7) -> tuple[Tensor, Tensor]:
    """Return the term, and the gradient of ``weight`` times the term to the centres."""
    device = camera.K.device
    given = [inputs[0].to(device), camera, *(x.to(device) for x in inputs[1:])]
    value, (gradient,) = value_and_gradients(op, given, torch.tensor(weight, device=device), learnt=1)
    assert gradient is not None and value.shape == ()
    return value.cpu(), gradient.cpu()


def run_reference(camera: Camera, inputs: list[Tensor]) -> tuple[Tensor, Tensor]:
    means, *rest = (x.double() for x in inputs)
    view = camera.viewmat.cpu().double(), camera.K.cpu().double(), camera.width
    value, (gradient,) = value_and_gradients(reference, [means, *view, *rest], torch.tensor(1.7), learnt=1)
    assert gradient is not None
    return value, gradient


@pytest.mark.parametrize(("spheres", "pixels"), [(1, 1), (2, 16), (16, 5), (17, 37), (300, 512), (4100, 33)])
@pytest.mark.parametrize("seed", range(3))
def test_values_and_gradients(seed, spheres, pixels, device, silhouette):
    camera = oblique(device)
    inputs = draw(seed, spheres, pixels, camera)
    value, gradient = run(silhouette, camera, inputs)
    expected, twin = run_reference(camera, inputs)
    # The place of the sphere at NEAR, whose coordinates are divided by 0.01, is uncertain by 1e-5.
    torch.testing.assert_close(value.double(), expected, rtol=1e-5, atol=2e-4 / spheres)
    torch.testing.assert_close(gradient.double(), twin, rtol=1e-3, atol=2e-5 * float(twin.abs().max()))
    if spheres == 300:  # each kind is there, or the test says nothing of it
        local = inputs[0] @ camera.viewmat[:3, :3].T.cpu() + camera.viewmat[:3, 3].cpu()
        assert float(local[BEHIND, 2]) < 0.0 < float(local[NEAR, 2]) < 0.01
        assert not gradient[OUTSIDE].any() and gradient[OUTSIDE + 1 :].any()
        assert int((gradient.abs().sum(1) > 0).sum()) > 250


@pytest.mark.parametrize("special", [BEHIND, NEAR])
def test_spheres_that_are_too_near_learn_nothing_of_their_distance(special, device, silhouette):
    """What remains of a depth's gradient is that of the numerator, by the offset of the image's centre in K."""
    camera = oblique(device)
    inputs = draw(4, 3, 9, camera)
    inputs[0] = inputs[0][special : special + 1]
    value, gradient = run(silhouette, camera, inputs)
    expected, twin = run_reference(camera, inputs)
    assert twin.abs().max() > 1e-2
    torch.testing.assert_close(value.double(), expected, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(gradient.double(), twin, rtol=1e-3, atol=1e-3 * float(twin.abs().max()))
    local = (gradient @ camera.viewmat[:3, :3].T.cpu())[0]
    K = camera.K.cpu()
    along = torch.linalg.solve(K[:2, :2].T, local[:2])  # gradient to the numerators
    assert float(local[2]) == pytest.approx(float(along @ K[:2, 2]), rel=1e-3)


@pytest.mark.parametrize(
    ("x", "y", "distance", "slope"),
    [
        (0.375, 0.25, 1.5, (4.0, 0.0)),  # between two samples
        (0.5, 0.5, 4.0, (4.0, 4.0 * 2)),
        (0.1, 0.5, 2.5, (0.0, 4.0 * 2)),  # beyond the first column
        (0.95, 0.5, 5.5, (0.0, 4.0 * 2)),
        (0.5, 0.05, 2.0, (4.0, 0.0)),  # beyond the first row
        (0.5, 0.9, 6.0, (4.0, 0.0)),
        (0.125, 0.5, 2.5, (0.0, 4.0 * 2)),  # on the first sample: as beyond it
        (0.875, 0.5, 5.5, (0.0, 4.0 * 2)),
        (-50.0, 70.0, 4.5, (0.0, 0.0)),
    ],
)
def test_the_table_is_a_plane_within_its_samples_and_level_beyond(x, y, distance, slope, device, silhouette):
    """A table of 2 x 4 samples of x / 0.25 + 4 y / 0.5; the pixel lies on the centre and adds nothing."""
    table = torch.tensor([[0.5, 1.5, 2.5, 3.5], [4.5, 5.5, 6.5, 7.5]]) + 0.0
    inputs = [torch.tensor([[x, y, 0.0]]), table, torch.ones(2), torch.tensor([[x, y]])]
    value, gradient = run(silhouette, straight(device), inputs, weight=1.0)
    assert float(value) == pytest.approx(distance, abs=1e-5)
    assert gradient[0, :2].tolist() == pytest.approx(slope, abs=1e-5)


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (1, 5), (4, 1)])
def test_tables_of_one_row_or_column(rows, columns, device, silhouette):
    camera = oblique(device)
    inputs = draw(5, 20, 7, camera)
    inputs[1] = inputs[1][:rows, :columns]
    value, gradient = run(silhouette, camera, inputs)
    expected, twin = run_reference(camera, inputs)
    torch.testing.assert_close(value.double(), expected, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(gradient.double(), twin, rtol=1e-3, atol=2e-4 * float(twin.abs().max()))


def test_of_several_nearest_spheres_the_first_is_drawn(device, silhouette):
    """Spheres 1 and 2 are as far from the pixel, on both sides, and 3 lies on 2; sphere 20 lies on 1."""
    means = torch.tensor([[0.5, 0.9, 0.0]]).repeat(21, 1)
    means[1], means[2], means[3], means[20] = (
        torch.tensor([x, 0.25, 0.0]) for x in (0.375, 0.625, 0.625, 0.375)
    )  # fmt: skip
    inputs = [means, torch.zeros(3, 3), torch.ones(2), torch.tensor([[0.5, 0.25], [0.625, 0.125]])]
    value, gradient = run(silhouette, straight(device), inputs, weight=1.0)
    assert float(value) == pytest.approx(0.125)
    assert gradient[1, :2].tolist() == pytest.approx([-0.5, 0.0]) and gradient[2, :2].tolist() == pytest.approx(
        [0.0, 0.5]
    )
    assert not gradient[3:].any() and not gradient[0].any()


def test_a_sphere_on_its_pixel_is_not_drawn(device, silhouette):
    inputs = [torch.tensor([[0.25, 0.5, 0.0]]), torch.zeros(2, 2), torch.ones(2), torch.tensor([[0.25, 0.5]])]
    value, gradient = run(silhouette, straight(device), inputs)
    assert float(value) == 0.0 and not gradient.any()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 3e38, -3e38])
@pytest.mark.parametrize("column", range(3))
def test_what_is_not_finite_is_told_and_disturbs_no_other_sphere(bad, column, device, silhouette):
    camera = oblique(device)
    inputs = draw(6, 20, 35, camera)
    _, sound = run(silhouette, camera, inputs)
    inputs[0][18, column] = bad
    value, gradient = run(silhouette, camera, inputs)
    assert bool(value.isnan()) or not math.isnan(bad)
    assert gradient[:18].isfinite().all() and gradient[19].isfinite().all()
    unchanged = (gradient == sound).all(1)
    assert int(unchanged.sum()) >= 12, "only those that take over its pixels change"


@pytest.mark.parametrize("column", range(2))
def test_a_place_of_which_one_coordinate_is_not_a_number_is_told(column, device, silhouette):
    """It is infinite in the camera's frame; K multiplies it by 0 for one coordinate, and by 1 for the other."""
    camera = straight(device)
    camera.viewmat[column, column] = 2.0
    camera.K[column, column], camera.K[1 - column, column] = 0.0, 1.0
    means = torch.full((3, 3), 0.25)
    means[1, column] = 3e38
    value, gradient = run(silhouette, camera, [means, torch.ones(3, 2), torch.ones(2), torch.rand(20, 2)])
    assert value.isnan() and gradient[[0, 2]].isfinite().all()


def test_nothing_behind_the_table_is_read(device, silhouette):
    memory = torch.full((60,), math.nan, device=device)
    table = memory[20:40].view(4, 5).fill_(0.25)
    means = torch.tensor([[9.0, 9.0, 0.0], [-9.0, -9.0, 0.0], [0.1, 9.0, 0.0], [9.0, 0.1, 0.0], [0.9, 0.875, 0.0]])
    inputs = [means, table, torch.ones(2), torch.tensor([[0.9, 0.875]])]
    value, gradient = run(silhouette, straight(device), inputs)
    assert float(value) == 0.25 and not gradient.any()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_nothing_finite_at_all(bad, device, silhouette):
    """No sphere is nearest; nothing is read out of bounds."""
    camera = oblique(device)
    inputs = [torch.full((18, 3), bad), torch.ones(3, 2), torch.ones(2), torch.rand(20, 2)]
    value, _ = run(silhouette, camera, inputs)
    assert not value.isfinite()
    inputs[1:] = [torch.ones(3, 2), torch.full((2,), bad), torch.full((20, 2), bad)]
    run(silhouette, camera, inputs)


def test_views_of_tensors(device, silhouette):
    camera = oblique(device)
    inputs = draw(7, 30, 19, camera)
    expected = run(silhouette, camera, inputs)
    strided = [torch.stack([x, x], -1)[..., 0] for x in inputs]
    assert not any(x.is_contiguous() for x in strided)
    seen = Camera(camera.viewmat.T.contiguous().T, camera.K.T.contiguous().T, camera.width, camera.height)
    for found, known in zip(run(silhouette, seen, strided), expected):
        assert torch.equal(found, known)


def test_a_camera_gets_no_gradient_and_values_need_none(device, silhouette):
    camera = oblique(device)
    inputs = [x.to(device) for x in draw(8, 5, 5, camera)]
    camera.viewmat.requires_grad_()
    assert not silhouette(inputs[0], camera, *inputs[1:]).requires_grad
    silhouette(inputs[0].requires_grad_(), camera, *inputs[1:]).backward()
    assert inputs[0].grad is not None and camera.viewmat.grad is None


@pytest.mark.parametrize(
    ("which", "shape"),
    [
        ("means", (3, 2)), ("means", (0, 3)), ("means", (3,)), ("viewmat", (3, 4)), ("K", (3, 4)),
        ("distances", (4,)), ("distances", (0, 4)), ("distances", (1, 3, 4)), ("size", (3,)),
        ("pixels", (4, 3)), ("pixels", (0, 2)), ("pixels", ()),
    ],
)  # fmt: skip
def test_wrong_shapes_are_named(which, shape):
    given = {"means": (3, 3), "viewmat": (4, 4), "K": (3, 3), "distances": (4, 4), "size": (2,), "pixels": (5, 2)}
    values = {name: torch.ones(shape if name == which else usual) for name, usual in given.items()}
    camera = Camera(values["viewmat"], values["K"], WIDTH, WIDTH)
    with pytest.raises(ValueError, match=which):
        ops.silhouette(values["means"], camera, values["distances"], values["size"], values["pixels"])


@pytest.mark.parametrize("form", ["cuda", "CPU", ""])
def test_an_unknown_form_is_refused(form):
    camera = oblique()
    with pytest.raises(ValueError, match="form must be"):
        run(functools.partial(ops.silhouette, form=form), camera, draw(9, 5, 4, camera))


def test_forms_agree_in_every_bit_of_the_gradients():
    """Both round each operation by itself; the values are the same sums. Extreme centres are among them."""
    camera = oblique()
    inputs = draw(9, 333, 100, camera)
    extremes = (math.nan, math.inf, -math.inf, 3e38, -3e38, 1e30, 1e-30, 0.0)
    for row, value in enumerate(extremes):
        inputs[0][40 * row + 10, row % 3] = value
    (value, gradient), (lanes, of_lanes) = (
        run(functools.partial(ops.silhouette, form=form), camera, inputs) for form in ("plain", "cpu")
    )
    torch.testing.assert_close(lanes, value, rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(of_lanes, gradient, rtol=0, atol=0, equal_nan=True)
    assert gradient.isfinite().all(1).sum() >= 325


@pytest.mark.parametrize("form", ["auto", "cpu", "plain"])
def test_the_cpu_takes_the_simd_form(form, monkeypatch):
    launched = []
    monkeypatch.setattr(ops, "launch", lambda kernel, *_, **__: launched.append(kernel.module.name.split(".")[-2:]))
    monkeypatch.setattr(ops, "sum_rows", lambda parts: parts.new_zeros(1))
    run(functools.partial(ops.silhouette, form=form), oblique(), draw(1, 4, 4, oblique()))
    folder = "kernels" if form == "plain" else "cpu"
    assert launched == 3 * [[folder, "silhouette"]]


def test_same_bits_for_any_thread_count(all_threads):
    camera = oblique()
    inputs, results = draw(2, 5000, 3001, camera), []
    for threads in (1, 2, 3):
        environment.configure(threads=threads)
        results.append(run(ops.silhouette, camera, inputs))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))
