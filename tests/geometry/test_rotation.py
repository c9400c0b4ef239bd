"""Rotations: quaternions in torch, matrices checked."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from reference.quaternion import normalise, to_matrix
from scgs_warp.geometry.rotation import is_rotation, rotate


def test_rotate_is_the_matrix_of_any_multiple():
    g = torch.Generator().manual_seed(0)
    quats, vectors = torch.randn(50, 4, generator=g, dtype=torch.float64), torch.randn(50, 3, generator=g).double()
    expected = (to_matrix(normalise(quats)) @ vectors[:, :, None])[:, :, 0]
    torch.testing.assert_close(rotate(3.0 * quats, vectors), expected)


def test_a_quarter_turn_about_z():
    quat = torch.tensor([[math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]])
    torch.testing.assert_close(rotate(quat, torch.tensor([[1.0, 0.0, 2.0]])), torch.tensor([[0.0, 1.0, 2.0]]))


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (np.eye(3), True),
        (np.diag([1.0, -1.0, -1.0]), True),
        (np.eye(3) * 1.0004, True),
        (np.eye(3) * 1.01, False),
        (np.diag([1.0, 1.0, -1.0]), False),
        (np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), False),
        (np.full((3, 3), np.nan), False),
        (np.eye(3) * 1e300, False),
        (np.zeros((3, 3)), False),
    ],
)
def test_is_rotation(matrix: np.ndarray, expected: bool):
    assert is_rotation(matrix) is expected
