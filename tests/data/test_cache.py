"""Cache of decoded images: bounded, read ahead without changing anything, and no bit of a run depends on it."""

from __future__ import annotations

import dataclasses
import json
import threading
import tracemalloc

import cv2
import numpy as np
import pytest
import torch

from helpers.nerfstudio_files import write
from helpers.tiny import tiny_config
from scgs_warp.config.presets import DataConfig
from scgs_warp.data import ImageCache, images, load
from scgs_warp.data.cache import READ_AHEAD, Pixels
from scgs_warp.errors import UserError
from scgs_warp.training.frames import Frames
from scgs_warp.training.state import TrainState
from scgs_warp.training.step import training_step


def pixels(value: float, size: int = 8) -> Pixels:
    return Pixels(torch.full((size, size, 3), float(value)), torch.ones(size, size))


def test_what_found_room_stays():
    cache = ImageCache(2.5 * pixels(0).bytes / 2**20)
    reads = []

    def read(value: int) -> Pixels:
        reads.append(value)
        return pixels(value)

    for _ in range(3):
        for value in range(4):
            assert cache.get(value, lambda value=value: read(value)).image[0, 0, 0] == value
    assert reads == [0, 1, 2, 3, 2, 3, 2, 3] and cache.used == 2 * pixels(0).bytes <= cache.budget
    cache.strip_alpha(0)
    assert cache.get(0, lambda: read(0)).alpha is None and cache.used == pixels(0).bytes + pixels(0).image.numel() * 4


def test_nothing_is_kept_without_room():
    cache = ImageCache(0)
    assert cache.get("a", lambda: pixels(1)).image[0, 0, 0] == 1 and cache.used == 0 and "a" not in cache


def test_reading_ahead():
    cache, begun = ImageCache(0), threading.Event()
    threads = []

    def read() -> Pixels:
        threads.append(threading.current_thread())
        begun.set()
        return pixels(3)

    cache.expect("a", read)
    assert begun.wait(10)
    assert cache.get("a", lambda: pytest.fail("read twice")).image[0, 0, 0] == 3
    assert threads[0] is not threading.main_thread()
    for key in range(10):  # foretold wrongly
        cache.expect(key, read)
    assert cache.read_ahead == READ_AHEAD

    def fail() -> Pixels:
        raise UserError("gone")

    cache.expect("b", fail)
    with pytest.raises(UserError, match="gone"):
        cache.get("b", fail)


def test_frames_are_the_same_whatever_is_kept(tmp_path):
    write(tmp_path)
    everything, nothing = load(tmp_path), load(tmp_path, cache_mib=0)
    assert nothing.cache.used == 0 < everything.cache.used <= everything.cache.budget
    for kept, read in zip(everything, nothing):
        assert (
            torch.equal(kept.image, read.image) and kept.name == read.name and torch.equal(kept.camera.K, read.camera.K)
        )
    assert everything.fingerprint == nothing.fingerprint
    shared = ImageCache(1)
    train, test = load(tmp_path, cache=shared), load(tmp_path, "test", cache=shared)
    assert train.cache is test.cache is shared and shared.used == sum(
        frame.image.numel() * 4 for frame in [*train, *test]
    )


@pytest.mark.parametrize("half", [0, 6])
def test_no_bit_of_a_run_depends_on_the_cache(tmp_path, half):
    write(tmp_path, count=12)
    results = []
    for mib in (100.0, 0.03, 0.0):
        data = load(tmp_path, cache_mib=mib)
        state = TrainState.begin(tiny_config(20, half_size=half), data, "cpu")
        frames = Frames(data, state.normalisation, state.config, "cpu")
        for state.step in range(14):
            assert training_step(state, frames).failed is None
        assert data.cache.used <= data.cache.budget
        state.config = dataclasses.replace(state.config, data=DataConfig(cache_mib=int(mib)))
        state.save(tmp_path)
        results.append((tmp_path / "checkpoint.safetensors").read_bytes())
        if mib == 0:  # another budget may be given to --resume
            again = dataclasses.replace(state.config, data=DataConfig(cache_mib=7))
            assert TrainState.resume(tmp_path, again, data, "cpu").step == state.step
    assert results[0] == results[1] == results[2], "to the last byte of the checkpoint"


def test_memory_is_bounded_by_the_cache(tmp_path, monkeypatch):
    """60 images of 1 MB and room for 8: a walk through all of them, twice, never holds more than that and those in
    hand."""
    write(tmp_path, count=4)
    content = json.loads((tmp_path / "transforms.json").read_text())
    image = np.random.default_rng(0).integers(0, 256, (240, 360, 3), dtype=np.uint8)
    entry = content["frames"][0]
    content["frames"] = [{**entry, "file_path": f"big_{index}.png"} for index in range(60)]
    for index in range(60):
        cv2.imwrite(str(tmp_path / f"big_{index}.png"), np.roll(image, index, axis=0))
    content = {key: value for key, value in content.items() if key not in ("w", "h")}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    monkeypatch.setattr("scgs_warp.data.assemble.BORDER_FRAMES", 4)
    decoded = []
    original = images.read_image
    monkeypatch.setattr(
        "scgs_warp.data.assemble.read_image", lambda path, *rest: decoded.append(path) or original(path, *rest)
    )
    tracemalloc.start()
    data = load(tmp_path, cache_mib=8)
    for _ in range(2):
        for frame in data:
            assert frame.image.shape == (240, 360, 3)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    count, size = len(data), 240 * 360 * 3 * 4
    assert count == 53 and data.cache.used // size == 8 * 2**20 // size
    assert len(decoded) == count + 2 * (count - data.cache.used // size), "each once, then what is not kept"
    assert peak < 8 * 2**20 + 12 * size, "numpy's part of it: torch shares its memory"


def test_what_is_kept_is_not_read_again_ahead():
    cache = ImageCache(1)
    cache.offer("a", pixels(3))
    cache.expect("a", lambda: pytest.fail("read twice"))
    assert cache.read_ahead == 0
    assert cache.get("a", lambda: pytest.fail("read twice")).image[0, 0, 0] == 3
