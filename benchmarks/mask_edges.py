"""Measure whether an edge-aware filter brings the edges of masks closer to the truth.

    python apps/synthesize.py --film phone --maps --no-sound --seconds 1.6 --fps 10 --size 480 270 --samples 2 \\
        --output data/masks
    python benchmarks/mask_edges.py --data data/masks --json benchmarks/results/mask-edges.json

The true masks are the film's `moves`. Masks to refine: those that the capture finds (`found`), and given ones that are
coarse (drawn at an eighth of the size), or whose outline lies 4 pixels outside or inside. Rows hold `masks`, `filter`
and `overlap`, the intersection of mask and truth over their union, averaged over the frames.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from provenance import ROOT

from scgs_warp.capture.moving import find_moving
from scgs_warp.capture.source import read_rgb
from scgs_warp.runtime.environment import configure
from scgs_warp.runtime.provenance import command_line, provenance

COARSE = 8
"""Factor by which coarse masks are smaller than the frames."""
SHIFT = 4
"""Pixels by which an outline is moved."""
BAND = 6
"""Half the width of the band around the outline that grabCut decides, pixels."""

Mask = np.ndarray
Filter = Callable[[np.ndarray, Mask], Mask]


def disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def grown(mask: Mask, pixels: int) -> Mask:
    """Move the outline of a mask outwards, or inwards for a negative number of pixels."""
    change = cv2.dilate if pixels > 0 else cv2.erode
    return change(mask.astype(np.uint8), disc(abs(pixels))).astype(bool)


def coarse(mask: Mask) -> Mask:
    size = mask.shape[1] // COARSE, mask.shape[0] // COARSE
    small = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return cv2.resize(small, mask.shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5


def guided(image: np.ndarray, mask: Mask) -> Mask:
    guide = image.astype(np.float32) / 255
    return cv2.ximgproc.guidedFilter(guide, mask.astype(np.float32), 8, 1e-3) > 0.5


def weighted_median(image: np.ndarray, mask: Mask) -> Mask:
    return cv2.ximgproc.weightedMedianFilter(image, mask.astype(np.uint8) * 255, 10, sigma=25.5) > 127


def grab_cut(image: np.ndarray, mask: Mask) -> Mask:
    labels = np.where(mask, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[grown(mask, -BAND)], labels[~grown(mask, BAND)] = cv2.GC_FGD, cv2.GC_BGD
    if not ((labels == cv2.GC_FGD).any() and (labels == cv2.GC_BGD).any()):
        return mask
    cv2.setRNGSeed(0)
    behind, before = np.zeros((1, 65)), np.zeros((1, 65))
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    cv2.grabCut(bgr, labels, (0, 0, 1, 1), behind, before, 3, cv2.GC_INIT_WITH_MASK)
    return (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)


FILTERS: dict[str, Filter] = {
    "none": lambda image, mask: mask,
    "guided": guided,
    "weighted-median": weighted_median,
    "grab-cut": grab_cut,
}


def overlap(one: Mask, two: Mask) -> float:
    return float((one & two).sum() / max((one | two).sum(), 1))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a film of apps/synthesize.py with --maps")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    configure(1)
    cv2.setNumThreads(1)
    maps = sorted((options.data / "maps" / "film").glob("*.npz"))
    truth = [np.load(file)["moves"].astype(bool) for file in maps]
    images = [read_rgb(options.data / "images" / f"frame_{index:05d}.png") for index in range(len(maps))]
    kinds = {
        "found": list(find_moving(images.__getitem__, len(images))),
        "coarse": [coarse(mask) for mask in truth],
        "outside": [grown(mask, SHIFT) for mask in truth],
        "inside": [grown(mask, -SHIFT) for mask in truth],
    }
    rows = []
    for kind, masks in kinds.items():
        for name, refine in FILTERS.items():
            values = [overlap(refine(image, mask), true) for image, mask, true in zip(images, masks, truth)]
            rows.append({"masks": kind, "filter": name, "overlap": float(np.mean(values))})
            print(f"{kind:8}  {name:16}  {rows[-1]['overlap']:.3f}")
    if options.json:
        origin = {"provenance": "measured", "command": command_line("benchmarks/mask_edges.py", sys.argv[1:])}
        (ROOT / options.json).write_text(json.dumps({**origin, **provenance("cpu"), "rows": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
