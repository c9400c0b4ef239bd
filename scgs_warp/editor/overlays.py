"""Overlays that the browser draws over the picture: control points, graph and gizmo."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import viser

PLAIN, CHOSEN, HELD, PINNED = (235, 235, 235), (255, 190, 0), (60, 170, 255), (150, 70, 70)
EDGE = (120, 120, 130)
GIZMO = 0.16
"""Length of the gizmo's arrows, relative to the distance of the cameras from the scene."""


def node_colors(count: int, chosen: Any, held: Any, pins: Any) -> np.ndarray:
    """Return colours [count, 3] uint8: dark red for pinned nodes, blue for nodes of handles, yellow for chosen
    nodes."""
    colors = np.tile(np.array(PLAIN, np.uint8), (count, 1))
    for nodes, color in ((pins, PINNED), (held, HELD), (chosen, CHOSEN)):
        colors[list(nodes)] = color
    return colors


class Overlays:
    """Overlays of all clients, browser units.

    Args:
        edges: [E, 2] edges of the graph.
        points: [M, 3] control points.
        size: size of a control point.
        reach: length of the gizmo.
    """

    def __init__(self, server: viser.ViserServer, edges: np.ndarray, points: np.ndarray, size: float, reach: float):
        self._edges, self._points, self.reach = edges, points, reach
        self._colors = node_colors(len(points), (), (), ())
        scene = server.scene
        self.nodes = scene.add_point_cloud(
            "/control points", points.astype(np.float32), self._colors, point_size=size, point_shape="circle",
            precision="float32",
        )  # fmt: skip
        self.graph = scene.add_line_segments(
            "/graph", points[edges].astype(np.float32), np.array(EDGE, np.uint8), thickness=1.0,
            thickness_units="screen", visible=False,
        )  # fmt: skip
        self.gizmo = scene.add_transform_controls(
            "/gizmo", scale=reach, line_width=3.0, depth_test=False, visible=False,
        )  # fmt: skip

    def move(self, points: np.ndarray) -> None:
        """Move control points to positions [M, 3]; skip those whose new position is not finite."""
        points = np.where(np.isfinite(points), points, self._points)
        if not np.array_equal(points, self._points):
            self._points = points
            self.nodes.points = points.astype(np.float32)
            self._draw_graph()

    def _draw_graph(self) -> None:
        if self.graph.visible:
            self.graph.points = self._points[self._edges].astype(np.float32)

    def color(self, chosen: Any, held: Any, pins: Any) -> None:
        colors = node_colors(len(self._points), chosen, held, pins)
        if not np.array_equal(colors, self._colors):
            self._colors = self.nodes.colors = colors

    def show(self, nodes: bool, graph: bool, size: float) -> None:
        self.nodes.visible, self.graph.visible, self.nodes.point_size = nodes, graph, size
        self._draw_graph()

    def place_gizmo(self, pose: tuple[np.ndarray, np.ndarray] | None) -> None:
        """Show the gizmo at a position and wxyz; None hides it. Do not call it during a drag."""
        if pose is None or not all(np.isfinite(part).all() for part in pose):
            self.gizmo.visible = False
            return
        position, wxyz = pose
        if not np.allclose(self.gizmo.position, position, atol=1e-12):
            self.gizmo.position = position
        if not np.allclose(self.gizmo.wxyz, wxyz, atol=1e-12):
            self.gizmo.wxyz = wxyz
        self.gizmo.visible = True
