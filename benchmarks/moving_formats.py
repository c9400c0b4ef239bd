"""Measure what each format of a moving scene takes, and what it loses.

    python benchmarks/moving_formats.py --run runs/figure-quick ... --json benchmarks/results/moving-formats.json

Each run is written in every format with 60 instants over 2 seconds, read back by another reader than the writer's, and
compared with the scene: with the Gaussians that stand for its sharp ones (`export/plain.py`), which all formats but the
page hold. Rows hold `scene`, `gaussians`, `degree`, `format`, `bytes`; distances of positions relative to the scene's
extent, at stored instants (`position`, `position_95`: the mean, and what 95 % are within) and half-way between two
(`between`, `between_95`), where sequences show the earlier frame; and `psnr`, the lowest of six views at stored
instants, over the pixels that show something.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from provenance import ROOT
from scipy.spatial import KDTree
from still_formats import SORTED_BITS, loss, picture, read

sys.path.insert(0, str(ROOT / "tests"))
sys.path.insert(0, str(ROOT / "examples" / "players"))

from skinned_splats import SkinnedSplats

from helpers.export_files import fourdgs_player, npz_player
from helpers.page_reader import PagePlayer, binding_of, pose_of, read_page
from scgs_warp.config.presets import to_dict
from scgs_warp.edit import EditSession, edit_file, skeleton_file
from scgs_warp.edit.rotations import conjugate, multiply, rotate
from scgs_warp.export.gltf import upright
from scgs_warp.export.moving import extent_of
from scgs_warp.export.plain import plain_scene
from scgs_warp.export.request import ExportRequest
from scgs_warp.export.run import export
from scgs_warp.geometry.cameras import orbit_camera
from scgs_warp.geometry.morton import morton_order
from scgs_warp.runtime.environment import configure
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.scene.scene import Scene
from scgs_warp.storage import checkpoint
from scgs_warp.types import Gaussians

FRAMES, FPS = 60, 30.0
SHOWN = (0, 20, 45)
"""Frames that are compared, and those half a frame after them."""
VIEWS, SIZE = 2, 400
Player = Callable[[float], Gaussians]
Order = Literal["same", "by place", "by place in every file"]
"""Order of the Gaussians in a format: that of the scene, or another."""


def rows_of(run: Path) -> list[dict[str, Any]]:
    """Measure all formats on one run."""
    original, rows = Scene.load(run, device="cpu"), []
    with tempfile.TemporaryDirectory() as name:
        folder, plain = Path(name), Path(name) / "run"
        parts = EditSession(original).skeleton
        scene = saved(plain_scene(original), plain)
        skeleton_file.write(plain / skeleton_file.FILE, parts, edit_file.scene_of(EditSession(scene).engine))

        def made(file: str, **options: Any) -> Path:
            export(ExportRequest(folder / file, run=run if file == "a.html" else plain, **options))
            return folder / file

        length: dict[str, Any] = {"frames": FRAMES, "fps": FPS}
        ply, sog = (made(kind, format=f"{kind}-sequence", frames=FRAMES) for kind in ("ply", "sog"))
        npz, points, segments = (made(file, **length) for file in ("a.npz", "a.glb", "a.4dgs"))
        rig, page, up = made("rig.glb", skeleton="parts", **length), made("a.html"), scene.overview.up
        players: dict[str, tuple[Path, Order, Player]] = {
            "ply-sequence": (ply, "same", sequence_player(ply, ".ply")),
            "sog-sequence": (sog, "by place in every file", sequence_player(sog, ".sog")),
            "npz": (npz, "same", npz_player(npz)),
            "glb": (points, "same", glb_player(points, up)),
            "glb, skeleton of parts": (rig, "same", glb_player(rig, up)),
            "4dgs": (segments, "by place", fourdgs_player(segments)),
            "html": (page, "by place", page_player(page, original)),
        }
        for kind, (path, order, play) in players.items():
            truth = original if kind == "html" else scene
            rows.append({**head(run, scene), "format": kind, "bytes": size(path), **errors(play, truth, order)})
        for ending in ("npz", "csv", "glb"):
            path = made(f"tracks.{ending}", format="tracks", **length)
            row = {**head(run, scene), "format": f"tracks, .{ending}", "bytes": size(path)}
            rows.append({**row, **track_errors(path, scene)} if ending == "npz" else row)
    for row in rows:
        print(row)
    return rows


def saved(scene: Scene, folder: Path) -> Scene:
    """Write a scene as a run, and load it."""
    folder.mkdir()
    checkpoint.write(folder, scene.tensors(), {**scene.metadata(), "stage": "main"})
    (folder / "config.json").write_text(json.dumps(to_dict(scene.config)))
    return Scene.load(folder, device="cpu")


def head(run: Path, scene: Scene) -> dict[str, Any]:
    return {"scene": run.name, "gaussians": len(scene.gaussians), "degree": scene.gaussians.sh_degree}


def size(path: Path) -> int:
    return sum(file.stat().st_size for file in (path.iterdir() if path.is_dir() else [path]))


def sequence_player(folder: Path, ending: str) -> Player:
    def play(seconds: float) -> Gaussians:
        return read(folder / f"frame_{int(seconds * FPS + 1e-6):05d}{ending}")

    return play


def glb_player(path: Path, up: tuple[float, float, float]) -> Player:
    """Return the player of examples/players in the scene's axes, with the harmonics of the file."""
    splats, still = SkinnedSplats(path), read(path)
    back = conjugate(np.array(upright(up))[[3, 0, 1, 2]])

    def play(seconds: float) -> Gaussians:
        means, quats = splats.at(seconds)
        means, quats = rotate(back, means), multiply(back, quats)
        return replace(still, means=torch.from_numpy(means).float(), quats=torch.from_numpy(quats).float())

    return play


def page_player(path: Path, scene: Scene) -> Player:
    facts, columns = read_page(path)
    page, binding = PagePlayer(scene, facts, columns), binding_of(facts, columns)

    def play(seconds: float) -> Gaussians:
        pose = pose_of(facts, columns, seconds * FPS / (FRAMES - 1))
        posed = scene.motion.apply_pose(page.gaussians, pose, binding)  # type: ignore[operator]
        undo = scene.normalisation
        return replace(posed, means=undo.undo(posed.means), scales=undo.undo_scale(posed.scales))

    return play


@torch.no_grad()
def posed(scene: Scene, frame: float) -> Gaussians:
    """Return a scene's Gaussians, sharp ones as they are."""
    found = scene.motion.gaussians_at(scene.gaussians, frame / (FRAMES - 1))
    undo = scene.normalisation
    return replace(found, means=undo.undo(found.means), scales=undo.undo_scale(found.scales))


@torch.no_grad()
def errors(play: Player, scene: Scene, order: Order) -> dict[str, float]:
    start = posed(scene, 0)
    extent, seen = extent_of(start.means.numpy()), np.flatnonzero(start.opacities.numpy() >= 1 / 255)
    rows = np.arange(len(start.means))
    if order == "by place":
        rows = seen[KDTree(start.means.numpy()[seen]).query(play(0.0).means.numpy())[1]]
    found: dict[str, list[np.ndarray]] = {"position": [], "between": []}
    losses = []
    for frame in SHOWN:
        truth = posed(scene, frame)
        if order == "by place in every file":
            rows = morton_order(truth.means.double().numpy(), SORTED_BITS)
        for name, moment in (("position", frame), ("between", frame + 0.5)):
            made, whole = play(moment / FPS).means.numpy(), posed(scene, moment).means.numpy()
            found[name].append(np.linalg.norm(made - whole[rows], axis=1) / extent)
        for view in range(VIEWS):
            camera = orbit_camera(scene.overview, scene.overview.azimuth + 360.0 * view / VIEWS, SIZE)
            losses.append(loss(picture(play(frame / FPS), camera), picture(truth, camera)))
    return {**summed(found), "psnr": min(losses)}


def summed(found: dict[str, list[np.ndarray]]) -> dict[str, float]:
    rows = {}
    for name, parts in found.items():
        rows[name], rows[f"{name}_95"] = float(np.mean(parts)), float(np.quantile(parts, 0.95))
    return rows


def track_errors(path: Path, scene: Scene) -> dict[str, float]:
    with np.load(path, allow_pickle=False) as tracks:
        points, rows = tracks["points"], tracks["gaussians"]
    extent, found = extent_of(posed(scene, 0).means.numpy()), {"position": [], "between": []}
    for frame in SHOWN:
        half = 0.5 * (points[frame] + points[frame + 1])
        for name, made, moment in (("position", points[frame], frame), ("between", half, frame + 0.5)):
            found[name].append(np.linalg.norm(made - posed(scene, moment).means.numpy()[rows], axis=1) / extent)
    return summed(found)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, nargs="+", required=True)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    configure(1)
    rows = [row for run in options.run for row in rows_of(run)]
    if options.json:
        origin = {"provenance": "measured", "command": command_line("benchmarks/moving_formats.py", sys.argv[1:])}
        content = {**origin, **provenance("cpu"), "rows": rows}
        options.json.write_text(json.dumps(content, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
