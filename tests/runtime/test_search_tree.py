"""Search for nearest points: also where coordinates are 0, which crashed while denormals were flushed."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import torch

from helpers.paths import ROOT
from scgs_warp.runtime.search_tree import search_tree

PROGRAM = """
import numpy as np
from scgs_warp.runtime.search_tree import search_tree
from scgs_warp.runtime import environment
environment.configure(1)
points = (np.arange(400)[:, None] // np.array([1, 7, 50]) % 2).astype(float)
points[:, 0] *= np.linspace(0.0, 0.1, 400)
print(search_tree(points).query(points)[0].max())
"""


def test_coordinates_of_zero_do_not_crash():
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and float(done.stdout) == 0.0, done


def test_neighbours_are_those_of_all_distances():
    random = np.random.default_rng(1)
    points, others = random.normal(size=(200, 3)), random.normal(size=(50, 3))
    distances, nearest = search_tree(points).query(others, k=3)
    every = np.linalg.norm(others[:, None] - points[None], axis=2)
    assert np.allclose(np.sort(every, axis=1)[:, :3], distances)
    assert np.array_equal(every.argmin(1), nearest[:, 0])


def test_denormals_are_flushed_again():
    search_tree(np.zeros((3, 2)))
    assert float(torch.tensor([1e-40]) * 1.0) == 0.0
