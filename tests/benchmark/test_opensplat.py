"""OpenSplat is fed the splats that this project draws, and its times are compared only if the images agree."""

from __future__ import annotations

import sys

import pytest
import torch

from helpers.scripts import benchmark_script
from scgs_warp.errors import UserError
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.compositing import composite
from scgs_warp.types import Splats

pytestmark = pytest.mark.usefixtures("all_threads")


class Impostor:
    """OpenSplat's two functions, done with our own code: what is fed to it, and in which units, shows here."""

    def __init__(self, brighter: float = 1.0) -> None:
        self.brighter = brighter

    def forward(self, width, height, xys, conics, colors, opacities, background, cov2d, depths):
        inverse = torch.linalg.inv(cov2d)
        packed = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
        ratio = (conics / packed)[:, 0].median()
        assert torch.allclose(conics, ratio * packed, rtol=1e-2, atol=1e-5)
        leaves = [value.clone().requires_grad_() for value in (xys, conics, colors, opacities)]
        means, shapes, tints, opaque = leaves
        radii = torch.full((len(xys), 2), 99, dtype=torch.int32)
        splats = Splats(means + 0.5, shapes, depths, opaque[:, 0], radii, width, height)
        image, alpha = composite(splats, tints, bin_splats(splats), background)
        image = (self.brighter * image).permute(1, 2, 0)
        return image.detach(), 1 - alpha.detach(), (image, leaves)

    def backward(self, width, height, *arguments):
        lists, v_image, v_alpha = arguments[-3:]
        assert v_image.shape == (height, width, 3) and v_alpha.shape == (height, width) and len(arguments) == 11
        return torch.autograd.grad(lists[0], lists[1], v_image, retain_graph=True)


def test_both_renderers_get_the_same_splats_and_must_draw_the_same_image():
    opensplat = benchmark_script("opensplat")
    compared = opensplat.compare(Impostor(), 150, (60, 50), 0.0)
    assert compared["pictures"]["as_it_is"]["largest"] < 1e-4 and (compared["width"], compared["height"]) == (60, 50)
    assert max(compared["gradients_relative"].values()) < 1e-3
    median = {name: row["ms_median"] for name, row in compared["rows"].items()}
    assert compared["ratios"]["forward"] == pytest.approx(median["opensplat/forward"] / median["scgs_warp/forward"])
    report = {"machine": {"gpu": None, "processor": "x", "cores": 2, "torch": "2", "warp": "1"}, "date": "2026-01-01"}
    text = benchmark_script("timing_tables").opensplat({**report, "opensplat": "abc", "flags": "-O3", **compared})
    assert f"| {compared['ratios']['both']:,.1f} |" in text and "within 1e-4" in text
    with pytest.raises(UserError, match="OpenSplat"):
        opensplat.compare(Impostor(1.1), 150, (60, 50), 0.0)


def test_a_folder_that_is_no_checkout_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["opensplat.py", str(tmp_path)])
    assert benchmark_script("opensplat").main() == 2
    assert "give a checkout" in capsys.readouterr().err
