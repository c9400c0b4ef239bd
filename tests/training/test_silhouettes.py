"""Silhouettes of stage 1: distances, the term against float64, spheres drawn to far parts; and thin subjects."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.config.presets import from_dict, preset, to_dict
from scgs_warp.data.dataset import Dataset
from scgs_warp.ops.pooled import pooled_residual
from scgs_warp.training import silhouettes
from scgs_warp.training.automatic import resolve_auto
from scgs_warp.training.frames import Frames
from scgs_warp.training.initial_models import initial_gaussians, initial_spheres
from scgs_warp.training.silhouettes import Silhouettes, silhouette_of, silhouette_term
from scgs_warp.training.state import TrainState
from scgs_warp.training.step import training_step
from scgs_warp.types import Camera, Frame

WIDTH, HEIGHT = 48, 32


def camera(width: int = WIDTH, height: int = HEIGHT) -> Camera:
    """Make a camera at distance 4 from the origin."""
    view = torch.eye(4)
    view[2, 3] = 4.0
    K = torch.tensor([[60.0, 0.0, width / 2], [0.0, 60.0, height / 2], [0.0, 0.0, 1.0]])
    return Camera(view, K, width, height)


def alpha_of(rows: slice, columns: slice, height: int = HEIGHT, width: int = WIDTH) -> torch.Tensor:
    alpha = torch.zeros(height, width)
    alpha[rows, columns] = 1.0
    return alpha


def slow_term(means: torch.Tensor, view: Camera, alpha: np.ndarray, chosen: np.ndarray) -> torch.Tensor:
    """Compute the term pixel by pixel in float64; ``chosen`` indexes the covered pixels, row by row."""
    rows, columns = np.nonzero(alpha >= 0.3)
    inside = np.stack([columns, rows], axis=1)
    grid_y, grid_x = np.mgrid[: alpha.shape[0], : alpha.shape[1]]
    grid = np.stack([grid_x, grid_y], axis=-1).reshape(-1, 1, 2)
    distances = np.sqrt(((grid - inside[None]) ** 2).sum(-1)).min(1).reshape(alpha.shape) / alpha.shape[1]
    table = torch.from_numpy(distances)
    local = means @ view.viewmat[:3, :3].double().T + view.viewmat[:3, 3].double()
    pixels = (local @ view.K.double().T)[:, :2] / local[:, 2:]
    total = torch.zeros((), dtype=torch.float64)
    for x, y in pixels:
        u, v = (x - 0.5).clamp(0, alpha.shape[1] - 1), (y - 0.5).clamp(0, alpha.shape[0] - 1)
        i, j = min(int(u), alpha.shape[1] - 2), min(int(v), alpha.shape[0] - 2)
        a, b = u - i, v - j
        top = (1 - a) * table[j, i] + a * table[j, i + 1]
        bottom = (1 - a) * table[j + 1, i] + a * table[j + 1, i + 1]
        total = total + ((1 - b) * top + b * bottom) / len(pixels)
    targets = torch.from_numpy(inside[chosen] + 0.5)
    nearest = torch.stack([(pixels - target).norm(dim=1).min() for target in targets])
    return total + nearest.mean() / alpha.shape[1]


def test_distances_are_zero_in_the_silhouette_and_grow_with_the_distance_in_image_widths():
    found = silhouette_of(alpha_of(slice(10, 20), slice(8, 16)))
    assert found is not None
    distances = found.distances
    assert bool((distances[10:20, 8:16] == 0).all())
    assert float(distances[12, 40]) == pytest.approx(25 / WIDTH, abs=1e-6)
    assert float(distances[25, 20]) == pytest.approx(math.hypot(5, 6) / WIDTH, abs=1e-3)
    assert len(found.pixels) == 80 and found.size.tolist() == pytest.approx([1.0, HEIGHT / WIDTH])
    torch.testing.assert_close(found.pixels[0] * WIDTH, torch.tensor([8.5, 10.5]))
    assert silhouette_of(torch.zeros(4, 4)) is None
    assert silhouette_of(torch.ones(4, 4)) is None, "a filled image with an alpha channel has no silhouette"


def test_lines_of_half_a_pixel_stay_in_reduced_silhouettes():
    alpha = torch.zeros(700, 1200)
    alpha[:, 601] = 0.4
    found = silhouette_of(alpha)
    assert found is not None
    distances = found.distances
    assert max(distances.shape) <= silhouettes.LONGEST_SIDE
    assert bool((distances == 0).any(1).all())
    assert float(distances[0, 0]) == pytest.approx(0.5, abs=0.01)


def test_a_reduced_silhouette_lies_where_the_image_s_does():
    """1030 x 730 is no multiple of the reduction by 5; the last reduced pixels reach beyond the image."""
    alpha = alpha_of(slice(700, 730), slice(1000, 1030), 730, 1030)
    found = silhouette_of(alpha)
    assert found is not None and found.size.tolist() == pytest.approx([206 * 5 / 1030, 146 * 5 / 1030])
    assert found.distances.shape == (146, 206)
    centre = found.pixels.mean(0) * 1030
    assert centre.tolist() == pytest.approx([1015.0, 715.0], abs=0.01)
    view = camera(1030, 730)

    def strayed(x: float, y: float) -> float:
        mean = torch.tensor([[(x - 515.0) * 4 / 60, (y - 365.0) * 4 / 60, 0.0]])
        term = float(silhouette_term(mean, view, found.sample(torch.Generator().manual_seed(1))))
        pixels = found.pixels[torch.randint(len(found.pixels), (512,), generator=torch.Generator().manual_seed(1))]
        return 1030 * (term - float((pixels - mean[:, :2].new_tensor([x, y]) / 1030).norm(dim=1).mean()))

    assert strayed(1002.5, 702.5) == pytest.approx(0.0, abs=1e-2)
    assert strayed(502.5, 702.5) == pytest.approx(500.0, abs=1e-2)


def test_term_and_gradients_agree_with_float64(device):
    random = torch.Generator().manual_seed(5)
    means = torch.randn(40, 3, generator=random) * torch.tensor([1.2, 0.8, 0.5])
    alpha = alpha_of(slice(6, 17), slice(20, 31)).to(device)
    silhouette = silhouette_of(alpha, str(device))
    assert silhouette is not None
    chosen = torch.randint(11 * 11, (silhouettes.PIXELS,), generator=torch.Generator().manual_seed(9)).numpy()
    fast = means.clone().to(device).requires_grad_()
    term = silhouette_term(fast, camera().to(device), silhouette.sample(torch.Generator().manual_seed(9)))
    term.backward()
    slow = means.double().requires_grad_()
    expected = slow_term(slow, camera(), alpha.cpu().numpy(), chosen)
    expected.backward()
    assert float(term.detach()) == pytest.approx(float(expected.detach()), rel=2e-5)
    assert fast.grad is not None and slow.grad is not None
    torch.testing.assert_close(fast.grad.cpu().double(), slow.grad, rtol=2e-4, atol=2e-6)


def test_a_far_part_draws_the_nearest_centre(device):
    """The centre and the part are 20 standard deviations of any splat apart; the gradient still points there."""
    alpha = alpha_of(slice(14, 18), slice(4, 8)) + alpha_of(slice(14, 18), slice(40, 44))
    silhouette = silhouette_of(alpha, str(device))
    assert silhouette is not None
    means = torch.tensor([[-1.2, 0.0, 0.0], [-1.1, 0.0, 0.0], [0.2, 0.0, 0.0]], device=device, requires_grad=True)
    term = silhouette_term(means, camera().to(device), silhouette.sample(torch.Generator().manual_seed(1)))
    (gradient,) = torch.autograd.grad(term, means)
    assert float(gradient[2, 0]) < 0.0  # descent moves it to the right, where nothing is covered yet
    assert float(gradient[2, 0].abs()) > 2 * float(gradient[:2, 0].abs().max())


def test_descent_covers_two_parts_and_leaves_no_stray(device):
    alpha = alpha_of(slice(4, 8), slice(4, 10)) + alpha_of(slice(24, 28), slice(38, 44))
    silhouette = silhouette_of(alpha, str(device))
    assert silhouette is not None
    start = torch.randn(30, 3, generator=torch.Generator().manual_seed(2)) * 0.4
    means = start.to(device).requires_grad_()
    optimizer = torch.optim.Adam([means], 2e-2)
    random, view = torch.Generator().manual_seed(3), camera().to(device)
    for _ in range(300):
        optimizer.zero_grad()
        silhouette_term(means, view, silhouette.sample(random)).backward()
        optimizer.step()
    local = means.detach().cpu() + torch.tensor([0.0, 0.0, 4.0])
    x = 60.0 * local[:, 0] / local[:, 2] + WIDTH / 2
    assert int((x < 14).sum()) >= 5 and int((x > 34).sum()) >= 5
    assert int(((x > 14) & (x < 34)).sum()) == 0


def test_a_silhouette_is_found_once_and_none_without_a_subject():
    found = Silhouettes("cpu")
    assert found.of(1, lambda: torch.zeros(HEIGHT, WIDTH)) is None
    first = found.of(2, lambda: alpha_of(slice(0, 4), slice(0, 4)))
    assert first is not None and found.of(2, lambda: pytest.fail("read again")) is first


def test_silhouettes_beyond_their_room_are_found_again(monkeypatch):
    alphas = [alpha_of(slice(0, 4 + index), slice(0, 4)) for index in range(3)]
    sizes = [found.bytes for found in map(silhouette_of, alphas) if found is not None]
    monkeypatch.setattr(silhouettes, "KEPT_MIB", (sizes[0] + sizes[1]) / 2**20)
    kept, read = Silhouettes("cpu"), []
    for _ in range(2):
        for index, alpha in enumerate(alphas):
            found = kept.of(index, lambda index=index, alpha=alpha: read.append(index) or alpha)
            expected = silhouette_of(alpha)
            assert found is not None and expected is not None
            assert all(torch.equal(*pair) for pair in zip(found, expected))
    assert read == [0, 1, 2, 2]


def strips(size: int, width: int, count: int = 1) -> Dataset:
    """Frames of a vertical strip ``width`` pixels wide."""
    alpha = alpha_of(slice(0, size), slice(20, 20 + width), size, size)
    frames = [Frame(camera(size, size), 0.1 * i, torch.zeros(size, size, 3), alpha=alpha) for i in range(count)]
    return Dataset(frames, folder=Path("strips"), split="train")


@pytest.mark.parametrize("half_width", [1.5, 3.0, 6.0])
def test_half_thickness_of_a_strip(half_width):
    data = strips(64, round(2 * half_width))

    class Same:
        def apply_camera(self, view):
            return view

    found = silhouettes.half_thickness(data, Same())  # type: ignore[arg-type]
    assert found * 60.0 / 4.0 == pytest.approx(half_width, abs=0.6)


def test_thin_subjects_are_told_by_their_silhouettes():
    assert silhouettes.is_thin(strips(200, 6)) and not silhouettes.is_thin(strips(200, 12))
    assert not silhouettes.is_thin(strips(200, 0)), "nothing is covered"
    assert not silhouettes.is_thin(strips(64, 64)), "filled images"


@pytest.mark.parametrize(
    ("width", "changes", "pooled", "fade"),
    [
        (4, {}, "always", "always"),
        (30, {}, "never", "always"),
        (4, {"loss": {"pooled": "never"}, "pretrain": {"fade": "never"}}, "never", "never"),
        (30, {"loss": {"pooled": "always"}, "pretrain": {"fade": "never"}}, "always", "never"),
    ],
)
def test_thinness_decides_what_is_left_to_the_data(width, changes, pooled, fade):
    resolved = resolve_auto(tiny_config(**changes), strips(200, width, 3))
    assert (resolved.loss.pooled, resolved.pretrain.fade) == (pooled, fade)


@pytest.mark.parametrize(("changes", "fade"), [({}, "never"), ({"pretrain": {"silhouette": 0.0}}, "always")])
def test_spheres_of_separate_parts_are_led_back(changes, fade):
    """One of two parts is hidden in one frame of three; specks do not count."""
    whole, both = strips(200, 30).entries[0], []
    for index, columns in enumerate((slice(100, 140), slice(100, 140), slice(30, 70))):
        alpha = whole.alpha.clone()
        alpha[50:90, columns] = 1.0
        both.append(dataclasses.replace(whole, time=0.3 * index, alpha=alpha))
    data = Dataset(both, folder=Path("parts"), split="train")
    assert silhouettes.is_in_parts(data) and not silhouettes.is_thin(data)
    resolved = resolve_auto(tiny_config(**changes), data)
    assert (resolved.loss.pooled, resolved.pretrain.fade) == ("never", fade)
    speck = whole.alpha.clone()
    speck[50:55, 100:105] = 1.0
    alone = dataclasses.replace(whole, alpha=speck)
    assert not silhouettes.is_in_parts(Dataset([alone], folder=Path("speck"), split="train"))


@pytest.mark.parametrize(("apart", "one"), [(0, True), (2, True), (3, False), (20, False)])
def test_a_body_of_one_piece_hardly_ever_shows_two(apart, one):
    """Of 50 images, two may show two regions; all are looked at."""
    frames = []
    for index in range(50):
        alpha = torch.zeros(HEIGHT, WIDTH)
        alpha[30:60, 20:60] = 1.0
        if index in range(1, 2 * apart, 2):
            alpha[:, 38:42] = 0.0
        frames.append(Frame(camera(), 0.01 * index, torch.rand(HEIGHT, WIDTH, 3), alpha))
    assert silhouettes.is_one_piece(Dataset(frames, folder=Path("body"), split="train")) == one


def test_without_silhouettes_nothing_is_known_to_be_one_piece():
    filled = Dataset([Frame(camera(), 0.0, torch.rand(HEIGHT, WIDTH, 3))], folder=Path("filled"), split="train")
    assert not silhouettes.is_one_piece(filled)


def test_images_without_alpha_have_neither():
    frames = [Frame(camera(), 0.1 * i, torch.rand(HEIGHT, WIDTH, 3)) for i in range(3)]
    resolved = resolve_auto(tiny_config(), Dataset(frames, folder=Path("filled"), split="train"))
    assert (resolved.loss.pooled, resolved.pretrain.fade) == ("never", "always")


@pytest.mark.parametrize(("fade", "least"), [("never", 0.09), ("always", 0.0)])
def test_spheres_fade_only_where_they_may(fade, least, device):
    config = tiny_config(600, pretrain={"fade": fade})
    data = tiny_dataset(4)
    state = TrainState.begin(config, data, device)
    frames = Frames(data, state.normalisation, state.config, device)
    state.gaussians.opacity_logits.data[:] = -6.0
    training_step(state, frames)
    opacities = state.gaussians.opacities().detach()
    assert float(opacities.min()) == pytest.approx(least, abs=5e-3)
    state.step = state.config.pretrain_steps
    state.begin_main()
    state.gaussians.opacity_logits.data[:] = -6.0
    training_step(state, frames)
    assert float(state.gaussians.opacities().detach().min()) < 0.01, "Gaussians may fade"


def test_each_stage_has_its_own_pooled_residual():
    data, losses, pooled = tiny_dataset(4), {}, {}
    for first, main in ((False, "never"), (True, "never"), (False, "always")):
        changes = {"pretrain": {"pooled": first}, "loss": {"pooled": main}}
        state = TrainState.begin(tiny_config(600, **changes), data, "cpu")
        frames = Frames(data, state.normalisation, state.config, "cpu")
        results = [training_step(state, frames)]
        state.step = state.config.pretrain_steps
        state.begin_main()
        results.append(training_step(state, frames))
        losses[first, main] = [float(result.loss) for result in results]
        pooled[first, main] = [float(pooled_residual(result.render, result.truth)) for result in results]
    neither, first, main = losses.values()
    assert first[0] == pytest.approx(neither[0] + pooled[True, "never"][0], rel=1e-5)
    assert pooled[True, "never"][0] > 1e-3
    assert main[1] == pytest.approx(neither[1] + pooled[False, "always"][1], rel=1e-5)
    assert pooled[False, "always"][1] > 1e-3 and main[0] == neither[0]


def test_spheres_and_gaussians_are_no_larger_than_thin_subjects(device):
    points = torch.rand(400, 3, generator=torch.Generator().manual_seed(1)).to(device)
    config = tiny_config()
    gaussians, spheres = initial_spheres(config, points, points, device, largest=0.01)
    assert float(spheres.log_radius.detach().exp()) == pytest.approx(0.01, rel=1e-5)
    made = initial_gaussians(config, points, points, (gaussians, spheres))
    assert float(made.scales().detach().max()) <= 0.0101
    wide, unlimited = initial_spheres(config, points, points, device)
    assert float(unlimited.log_radius.detach().exp()) > 0.02
    before = from_dict({"pretrain": {"silhouette": 0.0}}, base=config)
    assert float(initial_gaussians(before, points, points, (gaussians, spheres)).scales().detach().max()) > 0.0101
    assert len(wide) == len(gaussians)


def test_recorded_configurations_without_the_field_have_no_silhouettes():
    recorded = to_dict(preset("cpu"))
    del recorded["pretrain"]["silhouette"], recorded["pretrain"]["fade"], recorded["loss"]["pooled"]
    del recorded["pretrain"]["pooled"]
    read = from_dict(recorded)
    assert not read.pretrain.pooled
    assert (read.pretrain.silhouette, read.pretrain.fade, read.loss.pooled) == (0.0, "always", "never")
    assert preset("cpu").pretrain.silhouette == 0.5
