"""First hits of a camera's rays, against every triangle in float64."""

from __future__ import annotations

import math

import numpy as np
import torch

from reference.raycast import first_hit_on
from scgs_warp.data.synthetic.orbit_cameras import camera_at, camera_of
from scgs_warp.data.synthetic.raycast import mesh_over
from scgs_warp.data.synthetic.solids import rounded_box, slab
from scgs_warp.kernels import raycast_hits
from scgs_warp.runtime.launch import launch

SIZE = 24


def test_hits_match_float64(device):
    """Faces, barycentric coordinates and depths; some rays pass the mesh."""
    ball, plate = rounded_box((0.5, 0.4, 0.3), 0.2, 4), slab((0.9, 0.9, 0.05), 0.4)
    vertices = torch.from_numpy(np.concatenate([ball[0], plate[0] - [0.1, 0.0, 0.6]])).float()
    faces = torch.from_numpy(np.concatenate([ball[1], plate[1] + len(ball[0])])).int()
    camera = camera_of(camera_at(math.radians(-70.0), 0.4, 4.0), 0.6, SIZE, SIZE)
    camera_to_world = torch.linalg.inv(camera.viewmat.double())[:3]
    face = torch.full((SIZE, SIZE), 7, dtype=torch.int32, device=device)
    shares, depth = torch.full((SIZE, SIZE, 3), 9.0, device=device), torch.full((SIZE, SIZE), 9.0, device=device)
    mesh = mesh_over(vertices.to(device), faces.reshape(-1).contiguous().to(device))
    pose = camera_to_world.float().contiguous().to(device)
    launch(raycast_hits.first_hits, SIZE * SIZE, mesh.id, pose, camera.K.to(device), SIZE, face, shares, depth)
    differ = hit = 0
    for y in range(SIZE):
        for x in range(SIZE):
            expected = first_hit_on(
                vertices.double(), faces.long(), camera_to_world, camera.K.double(), x + 0.5, y + 0.5
            )
            if int(face[y, x]) != expected[0]:  # a ray through an edge may hit either face
                differ += 1
                continue
            hit += expected[0] >= 0
            torch.testing.assert_close(shares[y, x].cpu().double(), expected[1], atol=2e-4, rtol=0)
            assert abs(float(depth[y, x]) - expected[2]) < 1e-4
    assert differ <= 3 and 100 < hit < SIZE * SIZE - 100
