"""A slice of the campaign of extreme kernel inputs (tests/fuzz/campaign.py), and proof that it detects failures."""

from __future__ import annotations

import json
import math
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fuzz import campaign, laws
from fuzz.poison import finite_rows
from helpers.edit_scenes import bar_scene
from helpers.scenes import look_at, random_camera, random_gaussians
from scgs_warp.errors import UserError
from scgs_warp.ops.projection import project
from scgs_warp.ops.skinning import skin, skin_rbf
from scgs_warp.rendering.render import draw
from scgs_warp.types import Camera, Gaussians, Pose

CASES = 700
"""Cases of the slice: under a minute on two busy cores."""

linux = pytest.mark.skipif(sys.platform != "linux", reason="the fence asks the kernel for walls of memory")


def run(folder: Path, *options: object) -> tuple[int, dict]:
    summary = folder / "summary.json"
    status = campaign.main([*map(str, options), "--summary", str(summary)])
    return status, json.loads(summary.read_text())


@linux
def test_a_slice_of_the_campaign(device: str, tmp_path: Path):
    status, summary = run(tmp_path, "--cases", CASES, "--seed", 1_000_000, "--device", device)
    assert summary["failures"] == [] and status == 0
    assert summary["cases"] == CASES and len(summary["cases_of"]) >= 25


@linux
@pytest.mark.slow
def test_the_campaign(device: str, tmp_path: Path):
    status, summary = run(tmp_path, "--cases", 20_000, "--device", device)
    assert summary["failures"] == [] and status == 0 and summary["cases"] == 20_000


@linux
def test_a_campaign_can_fail(tmp_path: Path):
    """A case that crashes, hangs or breaks a law is named, and the following cases run."""
    status, summary = run(tmp_path, "--cases", 30, "--seed", 108, "--modules", "fuzz.cases_broken", "--patience", 5)
    assert status == 1 and summary["cases"] == 30
    found = {failure["op"]: failure["failure"] for failure in summary["failures"]}
    assert set(found) == {"read", "write", "input", "unwritten", "abort", "hang"}
    assert len(summary["failures"]) == 30 - summary["cases_of"]["fine"]
    assert "status -11" in found["read"] and "status -6" in found["abort"] and "more than 5 s" in found["hang"]
    assert "past the end of ['values_out']" in found["write"] and "to its input" in found["input"]
    assert "not finite" in found["unwritten"]


def test_a_campaign_goes_on_where_it_ended(tmp_path: Path):
    own = campaign.parse(["--seed", "5", "--cases", "10", "--summary", str(tmp_path / "summary.json")])
    first = campaign.Campaign(own)
    first.take(['[5, "draw", ""]', '[6, "skin", "AssertionError: so"]'])
    first.save()
    second = campaign.Campaign(own)
    assert second.next == 7 and second.counts == {"draw": 1, "skin": 1} and second.failures[0]["case"] == 6
    own.seed = 6
    with pytest.raises(SystemExit, match="another campaign"):
        campaign.Campaign(own)


def test_a_case_is_its_number():
    cases = dict.fromkeys("abc", (None, 1.0))
    first = [campaign.op_of(number, cases) for number in range(200)]
    assert first == [campaign.op_of(number, cases) for number in range(200)]
    assert min(first.count(op) for op in "abc") > 40


def test_a_nan_from_the_loss_is_not_hidden(device: str):
    """Overflow guards pass non-finite gradients on, so that training stops there."""
    g, camera = random_gaussians(3, 60, device), random_camera(3, 33, 31, device)
    leaves = [x.clone().requires_grad_() for x in g.tensors().values()]
    image, alpha = draw(Gaussians(*leaves), camera)
    v_image = torch.zeros_like(image)
    v_image[1].view(-1)[alpha.argmax()] = torch.nan  # a pixel that Gaussians reach
    grads = torch.autograd.grad(image, leaves, v_image)
    assert bool(grads[4].isnan().any()), "colours"
    splats = [x.clone().requires_grad_() for x in leaves[:4]]
    found = project(*splats, camera.viewmat, camera.K, 33, 31)
    v_means2d = torch.full_like(found.means2d, torch.nan)
    assert bool(torch.autograd.grad(found.means2d, splats, v_means2d)[0].isnan().any()), "means"
    nodes, pose = leaves[0][:5].detach(), Pose(torch.zeros(5, 3, device=device), leaves[1][:5].detach())
    indices = torch.zeros(60, 2, dtype=torch.int32, device=device)
    for moved in (
        lambda means: skin(means, leaves[1], nodes, pose, indices, torch.full((60, 2), 0.5, device=device)),
        lambda means: skin_rbf(means, leaves[1], nodes, torch.ones(5, device=device), pose, indices),
    ):
        means_t = moved(leaves[0])[0]
        v_means = torch.zeros_like(means_t)
        v_means[7] = torch.nan
        v_rest = torch.autograd.grad(means_t, leaves[0], v_means)[0]
        assert bool(v_rest[7].isnan().all()) and not bool(v_rest[:7].any() | v_rest[8:].any())


@pytest.mark.parametrize("time", [math.nan, math.inf, -math.inf])
def test_a_time_that_is_none_is_refused_in_one_line(time: float):
    scene, camera = bar_scene(nodes=8, gaussians=20), random_camera(0, 9, 8)
    for call in (scene.gaussians_at, scene.control_points_at, lambda t: scene.render(camera, t)):
        with pytest.raises(UserError, match=f"time is {time}; give a number from 0") as caught:
            call(time)
        assert "\n" not in str(caught.value)
    for outside, inside in ((-3.0, 0.0), (1e38, 1.0)):
        assert torch.equal(scene.gaussians_at(outside).means, scene.gaussians_at(inside).means)
        assert torch.equal(scene.control_points_at(outside), scene.control_points_at(inside))


WIDTHS = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "sh_dc": 3}
THRESHOLDS = (struct.unpack("I", struct.pack("f", value))[0] for value in (1 / 255, 0.999, 1e-4, 0.01, -1.0))
SPECIAL = (0x7FC00000, 0x7F800000, 0xFF800000, 0x7F7FFFFF, 0xFF7FFFFF, 0x80000000, 1, 0x80000001, 0x00800000,
           *THRESHOLDS)  # fmt: skip
BITS = st.one_of(st.sampled_from(SPECIAL), st.integers(0, 2**32 - 1))
"""Draw bit patterns as integers: hypothesis cannot draw floats where denormals are flushed."""


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(sorted(WIDTHS)), st.integers(0, 3), BITS), max_size=12), st.data())
def test_any_bits_in_a_few_gaussians(hits: list[tuple[str, int, int]], data: st.DataObject):
    """Four Gaussians, the first untouched; failing cases shrink to the few values that matter."""
    rng = np.random.default_rng(0)
    values = {name: torch.from_numpy(rng.normal(size=(5, n)).astype(np.float32)) for name, n in WIDTHS.items()}
    values["scales"], values["opacities"] = 0.1 * values["scales"].abs(), values["opacities"].abs().clamp(max=0.9)
    values["means"][0], values["opacities"][0] = 0.0, 0.9
    for name, row, bits in hits:
        column = data.draw(st.integers(0, WIDTHS[name] - 1))
        values[name].view(torch.int32)[row + 1, column] = bits - (bits >> 31 << 32)
    leaves = [x.requires_grad_() for x in values.values()]
    fields = [*leaves[:3], leaves[3][:, 0], leaves[4], torch.zeros(5, 0, 3)]
    view = look_at(torch.tensor([0.0, 0.0, -3.0]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    camera = Camera(view, torch.tensor([[20.0, 0, 9], [0, 20, 8], [0, 0, 1]]), 18, 16)
    image, alpha = draw(Gaussians(*fields), camera, depth=True)
    laws.finite("image, alpha", image, alpha)
    laws.finite("gradients", *torch.autograd.grad((image.sum(), alpha.sum()), leaves))
    whole = finite_rows(*leaves)
    alone = draw(Gaussians(*(x[whole] for x in fields)), camera, depth=True)
    laws.equal("image of the valid alone", image, alone[0])
    assert bool(alone[1].any())
