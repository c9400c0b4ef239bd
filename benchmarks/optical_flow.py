"""Measure which of OpenCV's dense optical flows is nearest to the truth, and how much of it can be trusted.

    python apps/synthesize.py --film phone --maps --no-sound --seconds 8 --fps 15 --size 320 240 --output data/flow
    python benchmarks/optical_flow.py --data data/flow --json benchmarks/results/optical-flow.json

Rows hold `flow`; the mean distance in pixels from the true flow where both images show the surface, over all of the
image (`error`), over what moves (`error_moving`), and over what a check forth and back and for texture trusts
(`error_trusted`); `trusted`, the share of the image; and `ms`, the processor time of a pair of images, one way.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from provenance import ROOT

from scgs_warp.capture.source import read_rgb
from scgs_warp.geometry.optical_flow import dense_flow, returns, textured
from scgs_warp.runtime.environment import configure
from scgs_warp.runtime.provenance import command_line, provenance

PAIRS = 8
"""Number of pairs of frames, spread over the film."""

Flow = Callable[[np.ndarray, np.ndarray], np.ndarray]


def search(preset: int) -> Flow:
    return lambda one, two: cv2.DISOpticalFlow.create(preset).calc(one, two, None)


def robust_local(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    colors = (cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) for image in (one, two))
    return cv2.optflow.DenseRLOFOpticalFlow_create().calc(*colors, None)


FLOWS: dict[str, Flow] = {
    "DIS, fast": search(cv2.DISOPTICAL_FLOW_PRESET_FAST),
    "DIS, medium": search(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM),
    "DIS, medium, to single pixels": dense_flow,
    "Farneback": lambda one, two: cv2.calcOpticalFlowFarneback(one, two, None, 0.5, 4, 15, 3, 7, 1.5, 0),
    "PCAFlow": lambda one, two: cv2.optflow.createOptFlow_PCAFlow().calc(one, two, None),
    "RLOF": robust_local,
    "DeepFlow": lambda one, two: cv2.optflow.createOptFlow_DeepFlow().calc(one, two, None),
    "DualTVL1": lambda one, two: cv2.optflow.DualTVL1OpticalFlow_create().calc(one, two, None),
}


def measure(flow: Flow, grays: list[np.ndarray], maps: list[dict[str, np.ndarray]], chosen: list[int]) -> dict:
    """Compare a flow with the truth at the frames ``chosen``."""
    values, seconds = [], 0.0
    for index in chosen:
        one, two, truth = grays[index], grays[index + 1], maps[index]
        begun = time.process_time()
        forth, back = flow(one, two), flow(two, one)
        seconds += time.process_time() - begun
        error = np.linalg.norm(forth - truth["flow"], axis=2)
        seen, moves = truth["seen"].astype(bool), truth["moves"].astype(bool)
        sure = returns(forth, back, 1.0) & textured(one)
        values.append((error[seen].mean(), error[seen & moves].mean(), error[seen & sure].mean(), sure.mean()))
    names = "error", "error_moving", "error_trusted", "trusted"
    means = dict(zip(names, np.mean(values, 0).tolist(), strict=True))
    return {**means, "ms": 1e3 * seconds / (2 * len(chosen))}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a film of apps/synthesize.py with --maps")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    configure(1)
    cv2.setNumThreads(1)
    maps = [dict(np.load(file)) for file in sorted((options.data / "maps" / "film").glob("*.npz"))]
    images = [read_rgb(options.data / "images" / f"frame_{index:05d}.png") for index in range(len(maps))]
    grays = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    chosen = np.linspace(0, len(maps) - 2, PAIRS).round().astype(int).tolist()
    rows = []
    for name, flow in FLOWS.items():
        rows.append({"flow": name, **measure(flow, grays, maps, chosen)})
        print(f"{name:30} " + "  ".join(f"{key} {value:.3f}" for key, value in rows[-1].items() if key != "flow"))
    if options.json:
        origin = {"provenance": "measured", "command": command_line("benchmarks/optical_flow.py", sys.argv[1:])}
        (ROOT / options.json).write_text(json.dumps({**origin, **provenance("cpu"), "rows": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
