"""Optical flow in training: the term against float64, what it finds, its schedule, and the films it suits."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from helpers.filmed_blobs import SIZE, film, film_camera, on_device
from helpers.steps import check_same_bits
from helpers.tiny import blobs, tiny_config, tiny_dataset
from reference.compositing import composite
from reference.projection import project
from reference.render import tile_lists
from scgs_warp.config.presets import preset
from scgs_warp.geometry.cameras import scaled_camera
from scgs_warp.rendering.render import render
from scgs_warp.training import flow as module
from scgs_warp.training.automatic import resolve_auto
from scgs_warp.training.flow import (
    SPANS,
    FlowNumbers,
    Flows,
    flow_applies,
    flow_term,
    flow_weight,
    follow_each_other,
    measured,
)
from scgs_warp.training.loop import fit
from scgs_warp.types import Camera, Frame, Gaussians, Splats


def numbers(camera: Camera, other: Camera, vectors: torch.Tensor, certain: torch.Tensor, device: str) -> FlowNumbers:
    return FlowNumbers(camera.to(device), other.to(device), vectors.to(device), certain.to(device), 1.0)


def slow_term(here: Gaussians, means: torch.Tensor, there: torch.Tensor, seen: FlowNumbers) -> torch.Tensor:
    """The term in float64, from the definitions of projection and compositing; ``means`` and ``there`` are leaves."""

    def pixels(points: torch.Tensor, camera: Camera) -> torch.Tensor:
        local = points @ camera.viewmat[:3, :3].double().cpu().T + camera.viewmat[:3, 3].double().cpu()
        flat = local @ camera.K.double().cpu().T
        return flat[:, :2] / flat[:, 2:]

    camera = seen.camera.to("cpu")
    own = [t.detach().cpu().double() for t in (here.means, here.quats, here.scales, here.opacities)]
    splats = project(*own, camera.viewmat.double(), camera.K.double(), camera.width, camera.height)
    tiles = tile_lists(splats, camera.width, camera.height)
    listed = Splats(*splats, camera.width, camera.height, 0.0)
    image, alpha = composite(listed, pixels(there, seen.other) - pixels(means, seen.camera), tiles)
    compared = seen.certain.cpu() & (alpha > 0.5)
    apart = (image / alpha.clamp_min(0.5) - seen.vectors.cpu().double()).square().sum(0)
    distances = (apart + 1e-4).sqrt() - 1e-2
    return distances[compared].sum() / (compared.sum() * max(camera.width, camera.height))


def test_the_term_and_its_gradients_are_those_of_the_definition(device):
    here = on_device(blobs(0.2), device)
    here.means.requires_grad_()
    there = on_device(blobs(0.3), device).means.requires_grad_()
    generator = torch.Generator().manual_seed(3)
    vectors = 2.0 * torch.randn(2, SIZE, SIZE, generator=generator)
    certain = torch.rand(SIZE, SIZE, generator=generator) > 0.3
    seen = numbers(film_camera(0.2), film_camera(0.3), vectors, certain, device)
    term = flow_term(here, there, seen)
    term.backward()

    means, target = (t.detach().cpu().double().requires_grad_() for t in (here.means, there))
    slow = slow_term(here, means, target, seen)
    slow.backward()
    assert float(term.detach()) == pytest.approx(float(slow.detach()), rel=1e-4)
    for found, expected in ((here.means.grad, means.grad), (there.grad, target.grad)):
        assert found is not None and expected is not None
        error = (found.cpu().double() - expected).abs().max() / expected.abs().max()
        assert float(error) < 1e-3


def test_the_term_moves_and_covers_nothing(device):
    """Only the ends of displacements have gradients: quats, scales and opacities would pay with transparency."""
    here = on_device(blobs(0.2), device)
    leaves = [here.quats.requires_grad_(), here.scales.requires_grad_(), here.opacities.requires_grad_()]
    there = (here.means + 0.1).requires_grad_()
    everywhere = torch.ones(SIZE, SIZE, dtype=torch.bool)
    seen = numbers(film_camera(0.2), film_camera(0.2), torch.zeros(2, SIZE, SIZE), everywhere, device)
    flow_term(here, there, seen).backward()
    assert there.grad is not None and float(there.grad.abs().max()) > 0
    assert all(leaf.grad is None for leaf in leaves)


def test_no_certain_pixel_costs_nothing_and_points_behind_the_camera_do_no_harm(device):
    here = on_device(blobs(0.2), device)
    there = here.means.detach().clone().requires_grad_()
    nowhere = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    seen = numbers(film_camera(0.2), film_camera(0.3), torch.zeros(2, SIZE, SIZE), nowhere, device)
    assert float(flow_term(here, there, seen).detach()) == 0.0
    behind = (here.means.detach() + torch.tensor([0.0, -9.0, 0.0], device=device)).requires_grad_()
    seen = numbers(film_camera(0.2), film_camera(0.3), torch.zeros(2, SIZE, SIZE), ~nowhere, device)
    term = flow_term(here, behind, seen)
    term.backward()
    assert bool(term.detach().isfinite()) and bool(behind.grad.isfinite().all())


def test_the_flow_of_a_film_is_that_of_its_points():
    """The composed flow of every span agrees with the true displacement of the points that it shows."""
    data = film(36)
    flows = Flows(data, data.cameras)
    for path in ([3, 4], [3, 4, 5, 6, 7], [9, 8, 7]):
        vectors, certain = flows.along(path)
        assert certain.mean() > 0.03
        first, last = data.entries[path[0]], data.entries[path[-1]]
        here, there = blobs(first.time).means, blobs(last.time).means
        expected, alpha = displacement(blobs(first.time), there - here, first.camera, last.camera)
        chosen = torch.from_numpy(certain) & (alpha > 0.9)
        error = (torch.from_numpy(vectors) - expected).norm(dim=2)[chosen]
        assert int(chosen.sum()) > 100 and float(error.median()) < 0.25, path


def displacement(here: Gaussians, moved: torch.Tensor, camera: Camera, other: Camera) -> tuple[torch.Tensor, ...]:
    """Render the true displacement in the image [H, W, 2], and alpha."""

    def pixels(points: torch.Tensor, camera: Camera) -> torch.Tensor:
        flat = (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T
        return flat[:, :2] / flat[:, 2:]

    shift = pixels(here.means + moved, other) - pixels(here.means, camera)
    colors = torch.cat([shift / 100 + 0.5, torch.zeros(len(shift), 1)], 1)
    shown = dataclasses.replace(here, sh_dc=(colors - 0.5) / 0.28209479177387814)
    with torch.no_grad():
        image = render(shown, camera, torch.zeros(3))
    return (image.rgb[..., :2] / image.alpha[..., None].clamp_min(1e-6) - 0.5) * 100, image.alpha


def test_draws_reach_all_spans_and_both_directions():
    data = film()
    flows, seen = Flows(data, data.cameras), set()
    for seed in range(80):
        found = flows.between(5, torch.Generator().manual_seed(seed))
        assert found is not None and found.time == data.entries[found.other].time
        seen.add(found.other - 5)
    assert seen == {1, 2, 4, 6, -1, -2, -4, -5}, "up to the ends of the film"
    ends = {flows.between(0, torch.Generator().manual_seed(seed)).other for seed in range(40)}
    assert ends == set(SPANS), "from an end, the only way leads inwards"
    same = flows.between(5, torch.Generator().manual_seed(0)), flows.between(5, torch.Generator().manual_seed(0))
    assert torch.equal(same[0].vectors, same[1].vectors) and same[0].other == same[1].other


def test_flow_that_is_not_kept_is_measured_again_with_the_same_bits(monkeypatch):
    data = film(5)
    kept = Flows(data, data.cameras)
    monkeypatch.setattr(module, "KEPT_MIB", 0)
    fresh = Flows(data, data.cameras)
    for _ in range(2):
        one, two = (flows.between(2, torch.Generator().manual_seed(1)) for flows in (kept, fresh))
        assert torch.equal(one.vectors, two.vectors) and torch.equal(one.certain, two.certain)
    assert not fresh._kept


def test_masked_and_transparent_pixels_are_not_certain():
    data = film(4)
    one, two = data[1], data[2]
    mask = torch.ones(SIZE, SIZE, dtype=torch.bool)
    mask[:, : SIZE // 2] = False
    whole = measured(one, two)[0][1]
    assert whole[:, : SIZE // 2].any()
    for changed in (dataclasses.replace(one, mask=mask), dataclasses.replace(one, alpha=mask.float())):
        certain = measured(changed, two)[0][1]
        assert not certain[:, : SIZE // 2].any() and (certain[:, SIZE // 2 + 1 :] == whole[:, SIZE // 2 + 1 :]).all()


def test_large_images_are_compared_at_a_reduced_size():
    image = torch.rand(40, 60, 3, generator=torch.Generator().manual_seed(0))
    large = torch.nn.functional.interpolate(image.permute(2, 0, 1)[None], scale_factor=16, mode="bicubic")[0]
    one = large.permute(1, 2, 0).clamp(0, 1)
    two = one.roll(16, 1)
    camera = dataclasses.replace(film_camera(0, 960), height=640)
    (vectors, certain), _ = measured(Frame(camera, 0.0, one), Frame(camera, 1.0, two))
    assert vectors.shape == (171, 256, 2), "960 x 640 pixels to 256"
    assert float(abs(float(vectors[certain][:, 0].mean()) - 16 * 256 / 960)) < 0.1
    reduced = scaled_camera(camera, 256, 171)
    torch.testing.assert_close(reduced.K[0], camera.K[0] * 256 / 960)
    torch.testing.assert_close(reduced.K[1], camera.K[1] * 171 / 640)


def test_the_weight_fades_and_skips_steps():
    config = dataclasses.replace(preset("cpu"), loss=dataclasses.replace(preset("cpu").loss, flow=2.0, flow_every=4))
    until = config.loss.flow_until * config.main_steps
    assert flow_weight(0, config) == 0.0 and not flow_applies(0, config), "the motion does not learn yet"
    assert flow_weight(config.freeze, config) == pytest.approx(8.0 * (1 - config.freeze / until))
    assert flow_weight(config.freeze + 1, config) == 0.0 and flow_applies(config.freeze + 1, config)
    assert flow_weight(4 * round(until / 8), config) == pytest.approx(4.0, rel=1e-3)
    assert flow_weight(4 * round(until / 4 + 1), config) == 0.0
    off = dataclasses.replace(config, loss=dataclasses.replace(config.loss, flow=0.0))
    assert not any(flow_applies(step, off) for step in range(0, config.main_steps, 100))


def test_films_have_flow_and_cameras_that_jump_have_none():
    assert follow_each_other(film())
    assert not follow_each_other(tiny_dataset(12, SIZE))
    assert not follow_each_other(film(2))
    config = tiny_config(40, loss={"flow": 1.0})
    assert resolve_auto(config, film()).loss.flow == 1.0
    assert resolve_auto(config, tiny_dataset(12, SIZE)).loss.flow == 0.0


def test_the_same_bits_on_any_number_of_threads_and_after_a_crash(tmp_path, device, all_threads, monkeypatch):
    """40 steps of a film with flow in the loss; a crash in the middle; and another result than without flow."""
    data = film(6, 64)
    config = tiny_config(40, loss={"flow": 1.0}, pretrain={"with_points": True}, freeze=2)
    checkpoint = check_same_bits(config, data, tmp_path, device, monkeypatch, 23)

    without = dataclasses.replace(config, loss=dataclasses.replace(config.loss, flow=0.0))
    fit(without, data, output=tmp_path / "without", device=device)
    assert (tmp_path / "without" / "checkpoint.safetensors").read_bytes() != checkpoint.read_bytes()
