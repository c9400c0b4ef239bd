"""The control graph as a mesh."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.edit_scenes import bar_scene
from helpers.edit_sessions import TURN, part
from helpers.export_files import gltf_arrays
from scgs_warp.edit import EditSession
from scgs_warp.export.control_graph import write_graph
from scgs_warp.export.moments import even_moments
from scgs_warp.export.skeleton import build_skeleton


def test_every_control_point_is_an_octahedron_and_every_edge_a_bar(tmp_path):
    session = EditSession(bar_scene())
    skeleton, edges = build_skeleton(session, even_moments(2, 2.0)), session.graph.edges
    write_graph(tmp_path / "graph.glb", skeleton, edges, (0.0, 0.0, 1.0))
    arrays, _ = gltf_arrays(tmp_path / "graph.glb")
    nodes = len(skeleton.rest)
    assert len(arrays["POSITION"]) == 6 * (nodes + len(edges))
    balls, bars = (
        arrays["POSITION"][: 6 * nodes].reshape(-1, 6, 3),
        arrays["POSITION"][6 * nodes :].reshape(-1, 2, 3, 3),
    )
    np.testing.assert_allclose(balls.mean(1), skeleton.rest, atol=1e-5)
    np.testing.assert_allclose(bars.mean(2), skeleton.rest[edges], atol=1e-5)
    np.testing.assert_array_equal(arrays["JOINTS_0"][:, 0], [*np.repeat(np.arange(nodes), 6), *np.repeat(edges, 3)])
    np.testing.assert_array_equal(arrays["WEIGHTS_0"], np.eye(4)[:1].repeat(len(arrays["POSITION"]), 0))
    np.testing.assert_allclose(np.linalg.norm(arrays["NORMAL"], axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize("edited", [False, True])
def test_a_mask_of_gaussians_does_not_concern_the_graph(edited):
    masked, plain = (EditSession(bar_scene(share=share)) for share in (0.5, None))
    for session in (masked, plain) if edited else ():
        session.add_handle(part(session, 0.8, 1.0), 0.0, "end")
        session.move("end", [0, 0, 0.3], TURN)
    moments = even_moments(3, 2.0)
    skeleton = build_skeleton(masked, moments, bound=False)
    np.testing.assert_array_equal(skeleton.positions, build_skeleton(plain, moments).positions)
    assert len(skeleton.rest) == len(masked)
    for row, moment in enumerate(moments):
        np.testing.assert_allclose(skeleton.positions[row], masked.node_positions(moment.time), atol=1e-5)
