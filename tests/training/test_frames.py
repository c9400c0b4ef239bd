"""Training views: an order without replacement, progressive windows, backgrounds, half-sized images."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.data.dataset import Dataset
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.training.frames import Frames


def frames(size: int = 64, count: int = 10, **changes) -> Frames:
    return Frames(tiny_dataset(count, size), Normalisation.identity(), tiny_config(100, **changes), "cpu")


def test_every_epoch_sees_every_frame_once_in_another_order():
    made = frames()
    epochs = [[made.index_at(10 * epoch + i, False) for i in range(10)] for epoch in range(3)]
    assert all(sorted(epoch) == list(range(10)) for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]


def test_progressive_starts_with_the_first_fifth_and_grows_to_all():
    made = frames(pretrain={"progressive_every": 50})
    windows = [range(start, start + 10) for start in (0, 50, 200)]
    seen = [[made.data[made.index_at(step, True)].time for step in window] for window in windows]
    times = sorted(frame.time for frame in made.data)
    assert set(seen[0]) == set(times[:2])
    assert max(seen[1]) in times[3:5] and min(seen[1][1::2]) >= times[2], "every other step looks at the newest fifth"
    assert set(seen[2]) == set(times)


def test_progressive_by_fifths_adds_them_at_once():
    """As in the supplement: no frame of the next fifth before the interval ends, and all frames equally often."""
    made = frames(pretrain={"progressive_every": 50, "progressive_by": "fifth"})
    times = sorted(frame.time for frame in made.data)
    for window, count in ((range(0, 50), 2), (range(50, 100), 4), (range(152, 200), 8), (range(200, 250), 10)):
        seen = [made.data[made.index_at(step, True)].time for step in window]
        assert set(seen) == set(times[:count])
        assert max(seen.count(time) for time in set(seen)) - min(seen.count(time) for time in set(seen)) <= 2


def test_random_background_is_under_the_image_alone():
    made = frames()
    _, background, truth, mask, _ = made.load(3, 7, True, False)
    alpha, plain = made.data[3].alpha, made.load(3, 7, False, False).truth
    assert mask is None
    assert torch.allclose(truth, plain + (1 - alpha) * background[:, None, None])
    assert torch.equal(truth, made.load(3, 7, True, False).truth), "the same step gives the same background"
    assert not torch.equal(truth, made.load(3, 8, True, False).truth)


@pytest.mark.parametrize("size", [64, 65])
def test_half_size_sees_the_same_scene(size):
    made = frames(size, half_size=10)
    camera, _, truth, _, _ = made.load(2, 9, False, False)
    whole_camera, _, whole, _, _ = made.load(2, 10, False, False)
    assert truth.shape == (3, size // 2, size // 2) and whole.shape == (3, size, size)
    assert (camera.width, camera.height) == (size // 2, size // 2)
    even = whole[:, : size // 2 * 2, : size // 2 * 2]
    expected = even.unflatten(2, (-1, 2)).unflatten(1, (-1, 2)).mean((2, 4))
    assert torch.allclose(truth, expected, atol=1e-6)
    # A point lands on the same place of the image: half the pixel coordinates.
    point = torch.tensor([0.1, -0.2, 0.3, 1.0])
    pixels = [(c.K @ (c.viewmat @ point)[:3]) for c in (camera, whole_camera)]
    assert torch.allclose(pixels[0][:2] / pixels[0][2], 0.5 * pixels[1][:2] / pixels[1][2], atol=1e-4)


def test_small_images_and_masks_at_half_size():
    made = frames(48, half_size=10)
    assert made.load(0, 0, False, False).camera.width == 48, "too small to be halved"
    made = frames(64, half_size=10)
    mask = torch.ones(64, 64, dtype=torch.bool)
    mask[10, 11] = False
    masked = [dataclasses.replace(frame, mask=mask if index == 1 else None) for index, frame in enumerate(made.data)]
    made.data = Dataset(masked, folder=made.data.folder, split="train")
    half = made.load(1, 0, False, False).mask
    assert half is not None and not half[5, 5] and int((~half).sum()) == 1


def test_random_backgrounds_over_data_on_white():
    """The images are read on white: a random colour must take the place of white, not be added to it."""
    given = tiny_dataset(3, 64)
    on_white = [dataclasses.replace(f, image=f.image + (1 - f.alpha)[..., None]) for f in given]
    data = Dataset(on_white, folder=given.folder, split="train", background="white")
    made = Frames(data, Normalisation.identity(), tiny_config(100), "cpu")
    _, background, truth, _, _ = made.load(1, 7, True, False)
    alone = given[1].image.permute(2, 0, 1)
    expected = alone + (1 - given[1].alpha) * background[:, None, None]
    assert torch.allclose(truth, expected, atol=1e-6) and not torch.allclose(background, torch.ones(3))
    assert torch.equal(made.load(1, 7, False, False).background, torch.ones(3))


def test_random_data_has_another_background_at_every_step():
    """Data whose background is ``random`` asks for it itself, also in the main stage."""
    made = frames()
    data = Dataset(list(made.data), folder=made.data.folder, split="train", background="random")
    made = Frames(data, Normalisation.identity(), tiny_config(100), "cpu")
    seen = [made.load(3, step, False, False) for step in (7, 8)]
    for view in seen:
        expected = data[3].image.permute(2, 0, 1) + (1 - data[3].alpha) * view.background[:, None, None]
        assert torch.allclose(view.truth, expected, atol=1e-6) and float(view.background.std()) > 1e-3
    assert not torch.equal(seen[0].background, seen[1].background)


def test_progressive_by_frame_adds_them_one_by_one():
    """Of ten frames one more every 25 steps; steps with odd numbers look at the newest fifth, the others at all."""
    made = frames(pretrain={"progressive_every": 50})
    times = sorted(frame.time for frame in made.data)

    def seen(steps: range) -> set[float]:
        return {made.data[made.index_at(step, True)].time for step in steps}

    for start, count in ((14, 3), (40, 4), (64, 5), (90, 6), (114, 7)):
        even, odd = seen(range(start, start + 22, 2)), seen(range(start + 1, start + 22, 2))
        assert even <= set(times[:count]) and even - odd, "earlier ones, too"
        assert odd == set(times[count - 2 : count])
