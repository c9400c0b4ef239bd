"""Depth maps in training: the term against float64, what it moves, its schedule, and where maps come from."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from helpers.filmed_blobs import SIZE, film, film_camera, on_device, with_depth
from helpers.steps import check_same_bits
from helpers.tiny import blobs, tiny_config
from reference.compositing import composite
from reference.projection import project
from reference.render import tile_lists
from scgs_warp.config.presets import preset
from scgs_warp.data.dataset import Dataset
from scgs_warp.errors import UserError
from scgs_warp.geometry.cameras import scaled_camera
from scgs_warp.rendering.render import render
from scgs_warp.training import depth as module
from scgs_warp.training.depth import Depths, SeenDepth, depth_applies, depth_term, depth_weight, seen_depth
from scgs_warp.training.loop import fit
from scgs_warp.types import Gaussians, Splats

SMOOTH = 1e-3


def slow_term(posed: Gaussians, leaves: list[torch.Tensor], seen: SeenDepth) -> torch.Tensor:
    """The term in float64, from its definition; ``leaves`` are means, quats, scales and opacities."""
    camera = seen.camera.to("cpu")
    viewmat = camera.viewmat.double()
    splats = project(*leaves, viewmat, camera.K.double(), camera.width, camera.height)
    tiles = tile_lists(splats, camera.width, camera.height)
    listed = Splats(*splats, camera.width, camera.height, 0.0)
    inverse = 1.0 / (leaves[0] @ viewmat[2, :3] + viewmat[2, 3])
    image, alpha = composite(listed, torch.stack([inverse, inverse.square()], 1), tiles)
    here = seen.inverse.cpu().double()
    known = here > 0
    here = torch.where(known, here, 1.0)
    least = 0.25 * here[known].square().sum() / here[known].sum()
    squares = (image[1] - 2.0 * image[0] * here + alpha * here.square()) / here.clamp_min(float(least)).square()
    return ((squares.clamp_min(0.0) + SMOOTH**2).sqrt() - SMOOTH)[known].mean()


def test_the_term_and_its_gradients_are_those_of_the_definition(device):
    posed = on_device(blobs(0.2), device)
    posed = dataclasses.replace(posed, scales=posed.scales * posed.scales.new_tensor([1.0, 0.6, 0.3]))
    own = [t.requires_grad_() for t in (posed.means, posed.quats, posed.scales, posed.opacities)]
    generator = torch.Generator().manual_seed(3)
    depth = 3.0 + 2.0 * torch.rand(SIZE, SIZE, generator=generator)
    inverse = torch.where(torch.rand(SIZE, SIZE, generator=generator) > 0.3, 1.0 / depth, 0.0)
    camera = film_camera(0.2)
    term = depth_term(posed, SeenDepth(camera.to(device), inverse.to(device)))
    term.backward()

    leaves = [t.detach().cpu().double().requires_grad_() for t in own]
    slow = slow_term(posed, leaves, SeenDepth(camera, inverse))
    slow.backward()
    assert float(term.detach()) == pytest.approx(float(slow.detach()), rel=1e-4)
    for found, expected in zip(own, leaves):
        assert found.grad is not None and expected.grad is not None
        error = (found.grad.cpu().double() - expected.grad).abs().max() / expected.grad.abs().max()
        assert float(error) < 2e-3


def test_the_term_is_least_where_the_surface_is(device):
    """Gaussians nearer or farther than the depth cost more, by about their relative distance; so does fog before it."""
    camera, flat = film_camera(0.2), on_device(blobs(0.2), device)
    axis = camera.viewmat[2, :3].to(device)
    centre = flat.means.mean(0)
    flat = dataclasses.replace(flat, means=flat.means - ((flat.means - centre) @ axis)[:, None] * axis)
    with torch.no_grad():
        image = render(flat, camera.to(device), torch.zeros(3, device=device))
    seen = SeenDepth(camera.to(device), torch.where(image.alpha > 0.9, 1.0 / image.depth.clamp_min(1e-3), 0.0))
    assert int((seen.inverse > 0).sum()) > 100

    def cost(factor: float) -> float:
        eye = camera.position.to(device)
        return float(depth_term(dataclasses.replace(flat, means=eye + factor * (flat.means - eye)), seen))

    assert cost(1.0) < 2e-3
    assert cost(1.1) == pytest.approx(1 - 1 / 1.1, rel=0.1) and cost(0.9) == pytest.approx(1 / 0.9 - 1, rel=0.1)
    fog = dataclasses.replace(
        flat,
        **{
            name: torch.cat([getattr(flat, name), value])
            for name, value in (
                ("means", camera.position.to(device) + 0.5 * (flat.means - camera.position.to(device))),
                ("quats", flat.quats),
                ("scales", 0.5 * flat.scales),
                ("opacities", 0.2 * flat.opacities),
                ("sh_dc", flat.sh_dc),
                ("sh_rest", flat.sh_rest),
            )
        },
    )
    assert float(depth_term(fog, seen)) > 0.2


def test_unknown_depth_costs_nothing(device):
    posed = on_device(blobs(0.2), device)
    posed.means.requires_grad_()
    term = depth_term(posed, SeenDepth(film_camera(0.2).to(device), torch.zeros(SIZE, SIZE, device=device)))
    term.backward()
    assert float(term.detach()) == 0.0 and not posed.means.grad.any()


def test_what_is_behind_the_camera_does_no_harm(device):
    posed = on_device(blobs(0.2), device)
    behind = torch.where(torch.arange(len(posed.means), device=device)[:, None] % 2 == 0, 0.0, 1.0)
    means = (posed.means + behind * torch.tensor([0.0, -9.0, 0.0], device=device)).requires_grad_()
    seen = SeenDepth(film_camera(0.2).to(device), torch.full((SIZE, SIZE), 0.25, device=device))
    term = depth_term(dataclasses.replace(posed, means=means), seen)
    term.backward()
    assert bool(term.detach().isfinite()) and bool(means.grad.isfinite().all())


def test_maps_are_reduced_without_their_outlines():
    """A step of depth is unknown on both sides, as are pixels that are not finite; the camera sees the same view."""
    camera = scaled_camera(film_camera(0.0), 512, 512)
    depth = np.full((1024, 1024), 2.0)
    depth[:, 514:] = 4.0
    depth[:100] = np.nan
    depth[100:200] = 0.0
    depth[200:300, :100] = np.inf
    seen = seen_depth(depth, camera)
    assert seen.inverse.shape == (256, 256) and (seen.camera.width, seen.camera.height) == (256, 256)
    torch.testing.assert_close(seen.camera.K[:2], camera.K[:2] / 2)
    inverse = seen.inverse.numpy()
    assert not inverse[:50].any() and not inverse[52:74, :24].any()
    assert not inverse[80:, 127:129].any(), "the pixels that the step crosses or touches"
    assert (inverse[80:, 30:126] == 0.5).all() and (inverse[80:, 130:] == 0.25).all()
    smooth = seen_depth(np.tile(np.linspace(2.0, 4.0, 300), (300, 1)), camera)
    assert (smooth.inverse > 0).all(), "a slope is no outline"


def test_depths_are_in_units_of_the_normalised_cameras():
    data = with_depth(film(4), share=0.5)
    depths = Depths(data, data.cameras, 2.0)
    assert depths.of(3) is None and data.with_depth == [0, 1]
    found, given = depths.of(1), data.depth(1)
    assert found is not None and given is not None
    known = found.inverse > 0
    assert int(known.sum()) > 100
    torch.testing.assert_close(1.0 / found.inverse[known], 2.0 * given[known])


def test_maps_that_are_not_kept_are_read_again_with_the_same_bits(monkeypatch):
    data = with_depth(film(3))
    kept = Depths(data, data.cameras, 1.0)
    kept.read()
    one = kept.of(2)
    monkeypatch.setattr(module, "KEPT_MIB", 0)
    fresh = Depths(data, data.cameras, 1.0)
    fresh.read()
    for _ in range(2):
        two = fresh.of(2)
        assert one is not None and two is not None and torch.equal(one.inverse, two.inverse)
    assert not fresh._kept and len(kept._kept) == 3


def test_a_map_that_cannot_be_read_is_told_before_the_first_step(tmp_path):
    def broken() -> torch.Tensor:
        raise UserError("depths/000.png: no such image; restore it")

    data = with_depth(film(4))
    entry = data.entries[3]
    object.__setattr__(entry, "depth", broken)
    config = tiny_config(20, loss={"depth": 0.2}, pretrain={"with_points": True})
    with pytest.raises(UserError, match="restore it") as caught:
        fit(config, data, output=tmp_path / "run")
    assert "saved" not in str(caught.value) and not list(tmp_path.rglob("*.safetensors"))


def test_the_weight_fades_and_skips_steps():
    loss = dataclasses.replace(preset("cpu").loss, depth=0.5)
    config = dataclasses.replace(preset("cpu"), loss=loss)
    until = config.loss.depth_until * config.main_steps
    assert depth_weight(0, config) == pytest.approx(1.0) and depth_applies(0, config), "from the first main step"
    assert depth_weight(1, config) == 0.0 and depth_applies(1, config)
    assert depth_weight(4 * round(until / 8), config) == pytest.approx(0.5, rel=1e-3)
    assert depth_weight(4 * round(until / 4 + 1), config) == 0.0 and not depth_applies(round(until) + 1, config)
    off = dataclasses.replace(config, loss=dataclasses.replace(loss, depth=0.0))
    assert not any(depth_applies(step, off) for step in range(0, config.main_steps, 100))


def test_the_same_bits_on_any_number_of_threads_and_after_a_crash(tmp_path, device, all_threads, monkeypatch):
    """40 steps of a film with depth in the loss; a crash in the middle; and another result than without depth."""
    data = with_depth(film(6, 64), 64)
    config = tiny_config(40, loss={"depth": 1.0}, pretrain={"with_points": True}, freeze=2)
    checkpoint = check_same_bits(config, data, tmp_path, device, monkeypatch, 23)

    bare, off = film(6, 64), dataclasses.replace(config, loss=dataclasses.replace(config.loss, depth=0.0))
    fit(config, bare, output=tmp_path / "without", device=device)
    fit(off, data, output=tmp_path / "off", device=device)
    files = [tmp_path / name / "checkpoint.safetensors" for name in ("without", "off")]
    one, two, three = (load_file(file) for file in (*files, checkpoint))
    means = next(name for name in one if name.endswith("means"))
    assert torch.equal(one[means], two[means]) and not torch.equal(one[means], three[means])


def test_a_far_sky_does_not_outweigh_the_rest(device):
    """Depth beyond four times the mean distance is compared absolutely, whatever number stands for far away."""
    posed = on_device(blobs(0.2), device)
    camera = film_camera(0.2).to(device)
    with torch.no_grad():
        image = render(posed, camera, torch.zeros(3, device=device))
    costs = []
    for far in (100.0, 1e4, 1e10):
        depth = torch.where(image.alpha > 0.9, image.depth, far)
        costs.append(float(depth_term(posed, SeenDepth(camera, 1.0 / depth))))
    assert costs[2] == pytest.approx(costs[1], rel=0.01) and max(costs) < 2.0


def test_reduced_maps_are_where_the_compared_pixels_are():
    """The inverse depth of a plane is linear in the image: a map of any size gives it at the pixels' centres."""
    camera = scaled_camera(film_camera(0.0), 1920, 1080)
    for width, height in ((1920, 1080), (1280, 720), (480, 270), (256, 144)):
        columns, rows = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
        seen = seen_depth(1.0 / (0.2 + 0.1 * columns + 0.2 * rows), camera)
        columns, rows = np.meshgrid((np.arange(256) + 0.5) / 256, (np.arange(144) + 0.5) / 144)
        errors = (seen.inverse.numpy() - (0.2 + 0.1 * columns + 0.2 * rows))[seen.inverse.numpy() > 0]
        assert abs(float(errors.mean())) < 1e-5 and len(errors) > 30_000, (width, height)


def test_masked_and_transparent_pixels_are_not_compared():
    data = with_depth(film(3))
    mask = torch.ones(SIZE, SIZE, dtype=torch.bool)
    mask[:, : SIZE // 2] = False
    whole = Depths(data, data.cameras, 1.0).of(1)
    assert whole is not None and whole.inverse[:, : SIZE // 2].any()
    for changes in ({"mask": mask}, {"alpha": mask.float()}):
        frames = [dataclasses.replace(frame, **changes, depth=data.depth(i)) for i, frame in enumerate(data)]
        seen = Depths(Dataset(frames, folder=data.folder, split="train"), data.cameras, 1.0).of(1)
        assert seen is not None and not seen.inverse[:, : SIZE // 2].any()
        assert torch.equal(seen.inverse[:, SIZE // 2 + 1 :], whole.inverse[:, SIZE // 2 + 1 :])
