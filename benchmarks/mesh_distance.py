"""Measure exported meshes against the true surface of a synthetic scene.

    python benchmarks/mesh_distance.py --run runs/figure-quick runs/cesium --mesh CesiumMan.glb \\
        --json benchmarks/results/mesh-distance.json

A run's data are the built-in scene, or those that `apps/synthesize.py` made of the file given with --mesh. For each
run, a mesh of each of the times (`still`) and one moving mesh (`moving`) are written as `apps/export.py --format mesh`
writes them, and read back.

Rows hold `run`, `subject`, `mesh`, `time`, `faces`, `closed`, and distances in percent of the subject's height:
`to_mesh_mean`, `to_mesh_p95` from points of the true surface to the mesh, `to_true_mean`, `to_true_p95` from points of
the mesh to the true surface. The true surface is what can be seen of it from outside, from any direction.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh
import warp as wp
from provenance import ROOT

from scgs_warp.data.gltf.scene import read_scene
from scgs_warp.data.synthetic.builtin import MARKER as BUILTIN
from scgs_warp.data.synthetic.builtin import FigureSubject
from scgs_warp.data.synthetic.from_mesh import SynthesisRequest, load_subject
from scgs_warp.data.synthetic.mesh import MeshSubject
from scgs_warp.export.request import ExportRequest
from scgs_warp.export.run import export
from scgs_warp.geometry.cameras import look_at
from scgs_warp.runtime.environment import configure
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.storage.json_files import parse_json
from scgs_warp.types import Camera

TIMES = (0.0, 0.5, 1.0)
POINTS = 60_000
"""Number of points that are sampled on either surface."""
DIRECTIONS = 120
"""Number of directions from which the true surface is looked at."""
DISTANCE = 5.0
"""Distance of the cameras from the origin; synthetic subjects stay in a ball of radius 1.3 around it."""
INSETS = np.array([[1, 1, 1], [8, 1, 1], [1, 8, 1], [1, 1, 8]]) / np.array([[3], [10], [10], [10]])
"""Points of a triangle, one of which must be visible."""


@wp.kernel
def nearest(mesh: wp.uint64, points: wp.array[wp.vec3], distances: wp.array[float]):
    i = wp.tid()
    found = wp.mesh_query_point_no_sign(mesh, points[i], 1.0e6)
    distances[i] = wp.length(wp.mesh_eval_position(mesh, found.face, found.u, found.v) - points[i])


class Truth(NamedTuple):
    """A synthetic subject."""

    name: str
    subject: FigureSubject | MeshSubject
    height: float

    def surface(self, time: float) -> trimesh.Trimesh:
        """Return the triangles that can be seen from outside at a time, in world units."""
        subject = self.subject
        posed = subject.pose(time)
        figure = isinstance(subject, FigureSubject)
        faces = subject.surface.faces if figure else subject.scene.triangles.faces
        vertices = posed.vertices.double().numpy()
        points = torch.from_numpy(np.einsum("kc,fcx->fkx", INSETS, vertices[faces]).reshape(-1, 3)).float()
        seen = torch.zeros(len(points), dtype=torch.bool)
        for camera in cameras():
            seen |= subject.visible(posed, camera, points)
        visible = seen.reshape(-1, len(INSETS)).any(dim=1).numpy()
        return trimesh.Trimesh(vertices, faces[visible], process=False)


def cameras() -> list[Camera]:
    """Return cameras in all directions around the origin."""
    index = np.arange(DIRECTIONS)
    z = 1.0 - 2.0 * (index + 0.5) / DIRECTIONS
    turn = math.pi * (1.0 + 5.0**0.5) * index
    eyes = DISTANCE * np.column_stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    K = torch.tensor([[800.0, 0, 400], [0, 800, 400], [0, 0, 1]])
    return [Camera(look_at(eye, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), K, 800, 800) for eye in eyes]


def truth_of(run: Path, mesh: Path | None) -> Truth:
    """Find the subject of a run."""
    folder = Path(parse_json((run / "config.json").read_text())["data"]["folder"])
    if (folder / BUILTIN).is_file():
        name, subject = "built-in scene", FigureSubject()
    else:
        if mesh is None:
            raise SystemExit(f"{folder} is not the built-in scene: give the file that it was made of with --mesh")
        name, subject = mesh.stem, load_subject(SynthesisRequest(mesh=mesh), "cpu")[0]
    height = float(np.load(folder / "ground_truth.npz")["height"])
    return Truth(name, subject, height)  # type: ignore[arg-type]


def distances(points: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the distance of each of the points [P, 3] from a mesh."""
    vertices = wp.array(mesh.vertices.astype(np.float32), dtype=wp.vec3, device="cpu")
    solid = wp.Mesh(points=vertices, indices=wp.array(mesh.faces.astype(np.int32).ravel(), device="cpu"))
    found = wp.empty(len(points), dtype=float, device="cpu")
    places = wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(nearest, dim=len(points), inputs=[solid.id, places, found], device="cpu")
    return found.numpy().astype(np.float64)


def compared(true: trimesh.Trimesh, made: trimesh.Trimesh, height: float) -> dict[str, float]:
    """Return the distances both ways in percent of the height."""
    to_mesh = distances(trimesh.sample.sample_surface(true, POINTS, seed=1)[0], made) * 100.0 / height
    to_true = distances(trimesh.sample.sample_surface(made, POINTS, seed=2)[0], true) * 100.0 / height
    return {
        "to_mesh_mean": float(to_mesh.mean()), "to_mesh_p95": float(np.quantile(to_mesh, 0.95)),
        "to_true_mean": float(to_true.mean()), "to_true_p95": float(np.quantile(to_true, 0.95)),
    }  # fmt: skip


def rows_of(run: Path, mesh: Path | None, folder: Path) -> list[dict[str, Any]]:
    """Export and measure the meshes of one run."""
    truth, rows = truth_of(run, mesh), []

    def add(kind: str, time: float, made: trimesh.Trimesh) -> None:
        sizes = {"faces": len(made.faces), "closed": bool(made.is_watertight)}
        measured = compared(truth.surface(time), made, truth.height)
        rows.append({"run": run.name, "subject": truth.name, "mesh": kind, "time": time, **sizes, **measured})
        print(
            "  ".join(
                f"{key} {value:.3f}" if isinstance(value, float) else f"{value}" for key, value in rows[-1].items()
            )
        )

    moving = folder / f"{run.name}.glb"
    export(ExportRequest(moving, run=run, format="mesh", sequence=True))
    scene = read_scene(moving, None)
    assert scene.clip is not None
    for time in TIMES:
        still = folder / f"{run.name}-{time:g}.ply"
        export(ExportRequest(still, run=run, format="mesh", time=time))
        add("still", time, trimesh.load(still, force="mesh", process=False))
        posed = scene.posed(scene.clip.start + time * (scene.clip.end - scene.clip.start)).positions
        add("moving", time, trimesh.Trimesh(posed, scene.triangles.faces, process=False))
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, nargs="+", required=True)
    parser.add_argument("--mesh", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    configure(1)
    with tempfile.TemporaryDirectory() as folder:
        rows = [row for run in options.run for row in rows_of(run, options.mesh, Path(folder))]
    if options.json:
        origin = {"provenance": "measured", "command": command_line("benchmarks/mesh_distance.py", sys.argv[1:])}
        content = {**origin, **provenance("cpu"), "rows": rows}
        (ROOT / options.json).write_text(json.dumps(content, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
