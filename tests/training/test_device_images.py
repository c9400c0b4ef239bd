"""Images that stay on the device: nothing is lost, nothing is copied twice, and memory is respected."""

from __future__ import annotations

import pytest
import torch

from scgs_warp.training import device_images
from scgs_warp.training.device_images import DeviceImages


def pictures() -> dict[str, torch.Tensor]:
    """Images [H, W, 3], stored planar: of a file with 8 bits, and of a reduced one."""
    random = torch.Generator().manual_seed(0)
    file = torch.randint(256, (3, 256, 9), generator=random)
    file[0] = torch.arange(256)[:, None]
    return {
        "file": (file / 255.0).permute(1, 2, 0),
        "reduced": torch.rand(3, 20, 30, generator=random).permute(1, 2, 0),
    }


@pytest.mark.parametrize("name", ["file", "reduced"])
def test_no_bit_is_lost(name, device, monkeypatch):
    monkeypatch.setattr(device_images, "MEMORY_SHARE", 1.0)
    images, image = DeviceImages(torch.device(device)), pictures()[name]
    for _ in range(2):
        found = images.planar((0, 1), lambda: image)
        assert found.device.type == device and found.is_contiguous()
        assert torch.equal(found.cpu(), image.permute(2, 0, 1))
    assert images.used == (0 if device == "cpu" else image.numel() * (1 if name == "file" else 4))


def test_values_beyond_bytes_are_kept():
    image = torch.tensor([[[1.5, -0.25, float("nan")]]])
    found = DeviceImages(torch.device("cpu")).planar(0, lambda: image)
    assert torch.equal(found.nan_to_num(7.0), image.permute(2, 0, 1).nan_to_num(7.0))
    for value in (1.5, -0.25, float("nan"), float("inf"), 0.1):
        image = torch.full((2, 2, 3), value)
        assert device_images._smallest(image) is image


def test_memory_is_respected(device):
    images, image = DeviceImages(torch.device(device)), pictures()["file"]
    images.budget = image.numel() + 10
    mask = torch.rand(256, 9) > 0.5
    for key in (0, 1, 0):
        assert torch.equal(images.planar(key, lambda: image).cpu(), image.permute(2, 0, 1))
        assert torch.equal(images.plane(("mask", key), lambda: mask).cpu(), mask)
    assert images.used == image.numel(), "one image fits; neither the second nor a mask does"
