"""Backs of surfaces that a glTF file shows from one side only."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from helpers.gltf_files import Glb, box, quad

pytest.importorskip("pygltflib")

from scgs_warp.data.synthetic.from_mesh import SynthesisPlan, SynthesisRequest, check, plan_synthesis, synthesize
from scgs_warp.data.synthetic.orbit_cameras import FilmingSettings
from scgs_warp.data.synthetic.shading import Shading
from scgs_warp.errors import UserError

SMALL = FilmingSettings(32, 32, train=40, test=1, val=0)


def planned(glb: Glb, folder: Path, **look) -> SynthesisPlan:
    mesh = glb.save(folder / "x.glb")
    return plan_synthesis(folder / "data", SynthesisRequest(mesh, filming=SMALL, samples=2, shading=Shading(**look)))


def told(plan: SynthesisPlan) -> list[str]:
    return [line for line in plan.lines if "--two-sided" in line]


def covered(plan: SynthesisPlan) -> list[int]:
    """Return the number of covered pixels of each training picture."""
    from PIL import Image

    folder = synthesize(plan)
    return [int((np.asarray(Image.open(file))[..., 3] > 0).sum()) for file in sorted((folder / "train").glob("*.png"))]


def test_a_sheet_of_one_side_is_told_and_shown_from_both_on_request(tmp_path):
    (tmp_path / "one").mkdir()
    plan = planned(quad(), tmp_path / "one")
    (line,) = told(plan)
    assert 20 < int(line.split(" %")[0]) < 80  # many cameras stand behind it
    one = covered(plan)
    assert one.count(0) > 5
    (tmp_path / "both").mkdir()
    plan = planned(quad(), tmp_path / "both", two_sided=True)
    both = covered(plan)
    assert told(plan) == [] and both.count(0) < 2
    assert all(more == less for less, more in zip(one, both, strict=True) if less)


@pytest.mark.parametrize("glb", [quad(doubleSided=True), box()], ids=["double-sided", "closed"])
def test_nothing_is_told_where_no_back_is_missing(glb, tmp_path):
    plan = planned(glb, tmp_path)
    assert told(plan) == []
    with_backs = SynthesisRequest(plan.request.mesh, filming=SMALL, samples=2, shading=Shading(two_sided=True))
    assert covered(plan) == covered(plan_synthesis(tmp_path / "same", with_backs))


def test_data_made_by_earlier_versions_is_still_recognised(tmp_path):
    plan = planned(quad(), tmp_path)
    folder = synthesize(plan)
    assert "two_sided" not in json.loads((folder / "synthesis.json").read_text())["look"]
    assert planned(quad(), tmp_path).made
    with pytest.raises(UserError, match="holds something else"):
        planned(quad(), tmp_path, two_sided=True)


def test_a_built_in_subject_has_no_such_surfaces():
    with pytest.raises(UserError, match="--two-sided: is for glTF files"):
        check(SynthesisRequest(subject="balls", shading=Shading(two_sided=True)))
