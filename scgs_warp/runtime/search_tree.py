"""Search for nearest points on the host."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import KDTree

from . import environment


def search_tree(points: np.ndarray) -> KDTree:
    """Build the search for nearest neighbours among points [P, D].

    SciPy splits points at the floating-point number next to a coordinate. While denormals are flushed to zero, the
    number next to 0 is 0 again, and SciPy recurses until the process crashes; they are therefore kept meanwhile.
    """
    if not environment.configured():
        return KDTree(points)
    torch.set_flush_denormal(False)
    try:
        return KDTree(points)
    finally:
        torch.set_flush_denormal(True)
