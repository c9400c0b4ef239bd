"""Measure what capture and training make of a film of the tests' room, in which a box flies about, against its truth.

    python tests/helpers/room.py --output room.mp4 --frames 240 --size 640 480
    python apps/capture.py room.mp4 --output data/room
    python apps/capture.py room.mp4 --output data/room-75 --frames 75
    python apps/train.py --data data/room --preset cpu --steps 6000 --output runs/room
    python benchmarks/filmed_room.py --truth room.npz --captures data/room data/room-75 --run runs/room \\
        --json benchmarks/results/filmed-room.json

Rows of ``captures`` hold the errors of the camera centres in shares of the path's length, once the two paths are
aligned: of the data set (``mean``, ``worst``), and before the cameras were adjusted (``mapped_mean``,
``mapped_worst``); and the relative error of the focal length. ``views`` holds the PSNR of the run's held-out frames,
whole, inside the box's outline and outside it, and of the worst frame.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from provenance import ROOT

from scgs_warp.capture.colmap import read_model
from scgs_warp.capture.similarity import align, centres
from scgs_warp.capture.source import read_rgb
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.storage.files import read_text
from scgs_warp.storage.json_files import parse_json


def frame_of(name: str) -> int:
    """Return the index in the film of an image of a capture."""
    return int(Path(name).stem.removeprefix("frame_"))


def off(found: dict[int, np.ndarray], truth: np.ndarray) -> tuple[float, float]:
    """Return the mean and the largest distance of camera centres from the true ones, as shares of the path's length."""
    frames = sorted(found)
    places = np.stack([found[frame] for frame in frames])
    errors = np.linalg.norm(align(places, truth[frames]).points(places) - truth[frames], axis=1)
    path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    return float(errors.mean() / path), float(errors.max() / path)


def capture_row(folder: Path, truth: dict[str, np.ndarray]) -> dict[str, Any]:
    scene, true = parse_json(read_text(folder / "transforms.json")), centres(truth["viewmats"])
    final = {frame_of(frame["file_path"]): np.array(frame["transform_matrix"])[:3, 3] for frame in scene["frames"]}
    model = read_model(folder / "work" / "model")
    mapped = {frame_of(image.name): image.projection_center() for image in model.images.values() if image.has_pose}
    picked = len(list((folder / "work" / "frames").glob("*.png")))
    mean, worst = off(final, true)
    mapped_mean, mapped_worst = off(mapped, true)
    focal = scene["fl_x"] / truth["K"][0, 0] - 1.0
    return {
        "capture": folder.name, "picked": picked, "registered": len(final), "mean": mean, "worst": worst,
        "mapped_mean": mapped_mean, "mapped_worst": mapped_worst, "focal": float(focal),
    }  # fmt: skip


def psnr(squares: np.ndarray) -> float:
    return float(-10.0 * np.log10(max(float(squares.mean()), 1e-12)))


def views_of(run: Path, moving: np.ndarray) -> dict[str, Any]:
    folder, found = run / "evaluation" / "test", []
    for file in sorted((folder / "renders").glob("*.png")):
        render, true = (read_rgb(folder / kind / file.name) / 255.0 for kind in ("renders", "truth"))
        squares = np.square(render - true).mean(2)
        inside = moving[frame_of(file.name)][: squares.shape[0], : squares.shape[1]]
        found.append((psnr(squares), psnr(squares[inside]), psnr(squares[~inside]), inside.mean()))
    whole, box, rest, share = np.array(found).T
    config, metrics = (parse_json(read_text(run / name)) for name in ("config.json", "metrics.json"))
    return {
        "run": run.name, "preset": config["preset"], "steps": config["steps"], "frames": len(found),
        "psnr": float(whole.mean()), "worst": float(whole.min()), "box": float(box.mean()), "rest": float(rest.mean()),
        "share": float(share.mean()), "gaussians": metrics["gaussians"], "seconds": metrics["seconds"],
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truth", type=Path, required=True, help="the .npz beside the film")
    parser.add_argument("--captures", type=Path, nargs="+", required=True, help="folders of apps/capture.py")
    parser.add_argument("--run", type=Path, help="a run on the first of them, evaluated")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with np.load(options.truth) as file:
        truth = dict(file)
    width = round(2 * truth["K"][0, 2])
    moving = np.unpackbits(truth["moving"], axis=-1, count=width).astype(bool)
    result = {
        "captures": [capture_row(folder, truth) for folder in options.captures],
        "views": None if options.run is None else views_of(options.run, moving),
    }
    print(json.dumps(result, indent=1))
    if options.json:
        origin = {"provenance": "measured", "command": command_line("benchmarks/filmed_room.py", sys.argv[1:])}
        (ROOT / options.json).write_text(json.dumps({**origin, **provenance("cpu"), **result}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
