"""The comparison with gsplat, with stand-ins for it."""

from __future__ import annotations

import pytest
import torch

from scgs_warp.benchmark import gsplat, scenes
from scgs_warp.benchmark import run as bench
from scgs_warp.errors import UserError

pytestmark = pytest.mark.usefixtures("all_threads")


def test_renderers_must_agree_before_they_are_timed():
    image = torch.rand(3, 40, 50)
    gsplat.check_agreement(image, image + 5e-5)
    flipped = image.clone()
    flipped[0, 3, 4] += 1 / 255
    gsplat.check_agreement(image, flipped)
    for changed in (image + 2e-4, image.where(torch.arange(50) != 7, image + 1e-3), image * torch.nan):
        with pytest.raises(UserError, match="differ"):
            gsplat.check_agreement(image, changed)
    flipped[0, 3, 4] += 1.0
    with pytest.raises(UserError, match="differ"):
        gsplat.check_agreement(image, flipped)


def test_against_a_peer_that_is_ours_and_one_that_is_wrong():
    scene = scenes.synthetic_scene("static", 120, 12, "cpu")
    plan = bench.BenchPlan(None, 120, 12, 48, ("static",), "cpu", (1,), 0.0)
    case = bench.BenchCase(scene, plan, scenes.Load(1, 1.0), 1)
    ours = gsplat.rasterize.rasterization
    rows = gsplat.Peers(ours).rows(case)
    assert [(row["renderer"], row["name"]) for row in rows] == [
        ("scgs_warp", "raster/forward"),
        ("scgs_warp", "raster/both"),
        ("gsplat", "raster/forward"),
        ("gsplat", "raster/both"),
    ]
    with pytest.raises(UserError, match="differ"):
        gsplat.Peers(lambda *args, **kwargs: (0.5 * ours(*args, **kwargs)[0],)).rows(case)
