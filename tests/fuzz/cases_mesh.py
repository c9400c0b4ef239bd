"""Cases of meshes: depth of the surface, and its fusion into a volume."""

from __future__ import annotations

import numpy as np
import torch

from fuzz.cases_render import camera_of, gaussians_of, on, poisoned_gaussians
from fuzz.poison import Draw, finite_rows
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.fusion import Volume
from scgs_warp.ops.projection import project
from scgs_warp.ops.surface_depth import surface_depth
from scgs_warp.types import Camera, Gaussians

from . import laws


def depth_of(values: list[torch.Tensor], camera: Camera, sharpness: float, level: float) -> torch.Tensor:
    gaussians = Gaussians(*values, sharpness)
    shapes = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    splats = project(*shapes, camera.viewmat, camera.K, camera.width, camera.height, sharpness=sharpness)
    return surface_depth(gaussians, splats, bin_splats(splats), camera, level)


def case_surface_depth(d: Draw, device: str) -> None:
    """Depths are finite and not negative, and as if the broken Gaussians were not there."""
    g, camera = poisoned_gaussians(d, d.count(), 0), camera_of(d, *d.size()).to(device)
    values = on(device, *g.tensors().values())
    options = float(d.pick((0.0, 0.5, 4.0))), float(d.pick((0.1, 0.5, 0.9)))
    depth = depth_of(values, camera, *options)
    laws.finite("depth", depth)
    assert bool((depth >= 0).all())
    whole = finite_rows(*values[:4]).to(device)
    laws.equal("depth of the valid alone", depth, depth_of([x[whole] for x in values], camera, *options))


def case_fusion(d: Draw, device: str) -> None:
    """Sums stay within the weights, whatever the depths and the camera are."""
    width, height = (max(side, 2) for side in d.size())
    camera = camera_of(d, width, height)
    values = on(device, *gaussians_of(d, 40, 0).tensors().values())
    good = camera_of(d, width, height, poisoned=0.0).to(device)
    depth = depth_of(values, good, 0.0, 0.5).cpu()
    if d.chance():
        d.poison(depth)
    depth = depth.to(device)
    volume = Volume.empty(np.full(3, -1.0), np.full(3, 1.0), float(d.pick((0.3, 0.7))), 0.5, device)
    for _ in range(int(d.rng.integers(1, 4))):
        volume.add(depth, camera)
    laws.finite("sums, weights", volume.sums, volume.weights)
    assert bool((volume.weights >= 0).all()) and bool((volume.sums.abs() <= volume.weights * 1.0001).all())
    laws.finite("distances", volume.distances())


CASES = {"surface_depth": (case_surface_depth, 3), "fusion": (case_fusion, 2)}
