"""Inverse kinematics against its float64 twin, step by step and at the end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from reference.inverse_kinematics import place_chain
from reference.inverse_kinematics import reach_place as twin
from scgs_warp.kernels import inverse_kinematics as kernels
from scgs_warp.runtime.launch import launch

PULL, SLIDE, LONGEST = 2e4, 40.0, 0.5
SHARES = 0.4, 0.8, 1.2
ORDER = "joints", "shifts", "rotations", "costs", "base", "ends", "aims"


def chain(seed: int, count: int) -> dict[str, Any]:
    """A bent chain of ``count`` joints on a moved base, with unlike costs and three aims within its reach."""
    random = np.random.default_rng(seed)
    joints = np.cumsum(random.normal(size=(count, 3)) * 0.2 + [0.5, 0.0, 0.0], 0)
    grip = joints[-1] + [0.4, 0.1, -0.1]
    body = {
        "joints": joints,
        "shifts": 0.05 * random.normal(size=(count, 3)),
        "rotations": Rotation.from_rotvec(random.normal(size=(count, 3)) * 0.6).as_matrix(),
        "base": Rotation.from_rotvec(random.normal(size=3)).as_matrix(),
        "ends": np.stack([random.normal(size=3), grip]),
    }
    _, points, end = place_chain(**body, turns=[Rotation.identity()] * count, shift=np.zeros(3))
    swing, shapes = random.normal(size=3), random.normal(size=(count, 3, 3))
    return {
        **body,
        "costs": shapes @ shapes.transpose(0, 2, 1) + np.eye(3),
        "aims": [points[0] + Rotation.from_rotvec(t * swing).apply((1 - 0.2 * t) * (end - points[0])) for t in SHARES],
    }


def solve(of: dict[str, Any], most: list[int], tolerance: float, device: str) -> tuple[np.ndarray, np.ndarray]:
    inputs = {name: torch.from_numpy(np.array(of[name])).to(device) for name in ORDER}
    inputs["base"] = inputs["base"][None].contiguous()
    count = len(of["joints"])
    scratch = (torch.empty(count, *shape, dtype=torch.float64, device=device) for shape in ((3, 3), (3,)))
    turns = torch.tensor([[0.0, 0.0, 0.0, 1.0]] * count, dtype=torch.float64, device=device)
    shift = torch.zeros(1, 3, dtype=torch.float64, device=device)
    limits = torch.tensor(most, dtype=torch.int32, device=device), PULL, SLIDE, LONGEST, tolerance
    launch(kernels.reach_place, 1, *inputs.values(), *limits, *scratch, turns, shift)
    return turns.cpu().numpy(), shift[0].cpu().numpy()


def assert_same(found: tuple[np.ndarray, np.ndarray], wanted: tuple[np.ndarray, np.ndarray], atol: float) -> None:
    same = np.sign((found[0] * wanted[0]).sum(1, keepdims=True))
    np.testing.assert_allclose(found[0] * same, wanted[0], atol=atol)
    np.testing.assert_allclose(found[1], wanted[1], atol=atol)


@pytest.mark.parametrize("most", [[1, 0, 0], [2, 1, 0], [2, 2, 3]])
@pytest.mark.parametrize("count", [1, 2, 3, 5])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_every_step(seed, count, most, device):
    """Few iterations, before a minimum hides a wrong step."""
    of = chain(seed, count)
    wanted = twin(**of, most=most, pull=PULL, slide=SLIDE, longest=LONGEST, tolerance=0.0)
    assert_same(solve(of, most, 0.0, device), wanted, 1e-8)
    assert not np.allclose(wanted[0][:, :3], 0.0, atol=1e-2), "the chain turns"


@pytest.mark.parametrize("count", [1, 3])
def test_iterations_stop_at_the_tolerance(count, device):
    of, tolerance = chain(4, count), 1e-2
    wanted = twin(**of, most=[40] * 3, pull=PULL, slide=SLIDE, longest=LONGEST, tolerance=tolerance)
    further = twin(**of, most=[40] * 3, pull=PULL, slide=SLIDE, longest=LONGEST, tolerance=0.0)
    assert_same(solve(of, [40] * 3, tolerance, device), wanted, 1e-7)
    assert np.abs(wanted[0] - further[0]).max() > 1e-6, "more iterations would change it"


@pytest.mark.parametrize("angle", [1e-9, 5e-4, 2e-3, 1.0, 3.1])
def test_turns_of_any_size(angle, device):
    """One free joint turns a point about it by a known angle, however small or large."""
    aim = Rotation.from_rotvec([0.0, 0.0, angle])
    of = {
        "joints": np.zeros((1, 3)), "shifts": np.zeros((1, 3)), "rotations": np.eye(3)[None],
        "costs": 1e-9 * np.eye(3)[None], "base": np.eye(3),
        "ends": np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        "aims": [Rotation.from_rotvec([0.0, 0.0, angle * share]).apply([1.0, 0.0, 0.0]) for share in (0.3, 0.6, 1.0)],
    }  # fmt: skip
    turns, _ = solve(of, [60] * 3, 0.0, device)
    np.testing.assert_allclose(Rotation.from_quat(turns[0]).as_rotvec(), aim.as_rotvec(), rtol=1e-5, atol=1e-12)
