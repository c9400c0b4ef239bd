"""Estimate the times of a frame, a training step and a rasterisation on an H200, from counted work.

    python benchmarks/estimate.py --kernels benchmarks/results/kernels-cuda.json \\
        --json benchmarks/results/estimates-h200.json

These are estimates, not measurements: nothing here has run on a GPU. Each stage takes the longest of four times: its
bytes at the full bandwidth, its flops at the full rate, and in compositing its instructions at the full rate of issue
and its accesses to shared memory, shuffles included, at one per clock. Uneven tiles, latencies, caches and kernels too
small to fill the GPU are left out, so all times are lower limits. gsplat's rasterisation is counted in the same way.
"""

from __future__ import annotations

import argparse
import ast
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from provenance import ROOT
from splat_visits import Visits, count_visits

import scgs_warp  # noqa: F401  (before torch)
from scgs_warp.benchmark.plan import MIDDLE, posed
from scgs_warp.benchmark.roofline import SPLAT, Work, backward_work, draw_work, frame_work
from scgs_warp.benchmark.scenes import Load, Size, load_of, synthetic_scene
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.scene.scene import Scene

BANDWIDTH = 4.8e12
"""Bytes a second of an H200's memory."""
FLOPS = 67e12
"""Flops a second in single precision, a multiply-add being two."""
ISSUE = FLOPS / 64
"""Warp instructions a second: a multiply-add of a warp is 64 flops."""
SHARED = ISSUE / 4
"""Accesses of a warp to shared memory, or shuffles, a second: one a clock, where four instructions are issued."""
NODE = 1e-6
"""Seconds for a node of a CUDA graph."""
SORT_NODES = {"frame": 2 * 4, "step": 3 * 4}
"""Nodes of the radix sorts: each has a histogram, its sum and about two passes."""
FLOAT, DIGIT = 4, 8
BUDGETS = ROOT / "tests" / "pretended_cuda" / "test_budgets.py"


class Stage(NamedTuple):
    """Work of a stage; ``instructions`` and ``shared`` are of warps, and known for compositing alone."""

    bytes: float
    flops: float = 0.0
    instructions: float = 0.0
    shared: float = 0.0
    nodes: int = 0

    @property
    def seconds(self) -> float:
        rates = ((self.bytes, BANDWIDTH), (self.flops, FLOPS), (self.instructions, ISSUE), (self.shared, SHARED))
        return max(amount / rate for amount, rate in rates) + self.nodes * NODE


class Case(NamedTuple):
    """An image to composite: its scene, and how often warps visit splats."""

    scene: Scene
    load: Load
    width: int
    height: int
    ours: Visits
    theirs: Visits


def make_case(count: int, size: Size) -> Case:
    scene = synthetic_scene("control-points", count, 512, "cpu")
    gaussians, camera = posed(scene, size, MIDDLE)
    load = load_of(gaussians, camera)
    return Case(scene, load, camera.width, camera.height, *count_visits(gaussians, camera))


def sort_bytes(entries: float, key: int, bits: int) -> float:
    """Return the traffic of a radix sort of pairs with values of four bytes: a histogram, then a pass per eight bits
    that reads and writes everything."""
    return entries * (key + 2.0 * (key + 4) * -(-bits // DIGIT))


def tile_bits(case: Case) -> int:
    return (-(-case.width // 16) * -(-case.height // 16)).bit_length()


def our_binning(case: Case, slots: bool) -> Stage:
    """Sort the splats by depth, list their pairs in this order, and sort these by tile.

    With slots, which gradients need, each pair has an owner, too.
    """
    count, pairs = case.scene.gaussian_count, case.ours.pairs
    listing = count * (2 * SPLAT + 7 * FLOAT) + pairs * FLOAT * (5 if slots else 2)
    return Stage(listing + sort_bytes(count, 4, 32) + sort_bytes(pairs, 4, tile_bits(case)))


def their_binning(case: Case) -> Stage:
    """gsplat sorts all pairs by one key of tile and depth."""
    count, pairs = case.scene.gaussian_count, case.theirs.pairs
    return Stage(count * (2 * SPLAT + 3 * FLOAT) + 3 * FLOAT * pairs + sort_bytes(pairs, 8, 32 + tile_bits(case)))


def compositing(case: Case, visits: Visits, loops: dict[str, Any], adjoint: bool, sums: float) -> Stage:
    """Count a pass over all splats of all tiles; ``sums`` are the bytes of gradients that a pair or hit moves."""
    loop = loops["adjoint" if adjoint else "forward"]
    hits, misses = visits.hits, (visits.backward if adjoint else visits.forward) - visits.hits
    instructions = hits * loop["hit"]["all"] + misses * loop["miss"]["all"]
    shared = hits * (loop["hit"]["shared"] + loop["hit"]["SHFL"]) + misses * loop["miss"]["shared"]
    images = FLOAT * case.width * case.height * (8 if adjoint else 6)
    return Stage(visits.pairs * 44 + images + sums, 0.0, instructions, shared)


def rasterisation(case: Case, loops: dict[str, Any]) -> dict[str, dict[str, Stage]]:
    """Count forward and adjoint of three channels for both renderers, stage by stage."""
    count = case.scene.gaussian_count
    drawn = draw_work(count, case.load, case.width, case.height, 3)
    before = {name: Stage(*drawn[name]) for name in ("project", "harmonics")}
    pixels = backward_work(count, Load(0, 0.0, 0), 0, 0)  # what the adjoint does per Gaussian
    after = Stage(*pixels)
    slots = case.ours.pairs * 16.0 * FLOAT
    atomics = case.theirs.hits * 9.0 * FLOAT
    return {
        "scgs_warp": {
            **before,
            "bin": our_binning(case, slots=True),
            "composite": compositing(case, case.ours, loops["scgs_warp"], False, 0.0),
            "composite, adjoint": compositing(case, case.ours, loops["scgs_warp"], True, 2 * slots),
            "Gaussians, adjoint": after,
        },
        "gsplat": {
            **before,
            "bin": their_binning(case),
            "composite": compositing(case, case.theirs, loops["gsplat"], False, 0.0),
            "composite, adjoint": compositing(case, case.theirs, loops["gsplat"], True, atomics),
            "Gaussians, adjoint": after,
        },
    }


def frame(case: Case, loops: dict[str, Any], budgets: dict[str, int]) -> dict[str, Stage]:
    work: dict[str, Work] = frame_work(case.scene, case.load, case.width, case.height)
    stages = {name: Stage(*work[name]) for name in ("network", "skin", "project", "harmonics")}
    nodes = budgets["FRAME_OPERATIONS"] + budgets["FRAME_LAUNCHES"] + SORT_NODES["frame"]
    return {
        **stages,
        "bin": our_binning(case, slots=False),
        "composite": compositing(case, case.ours, loops["scgs_warp"], False, 0.0),
        "nodes of the graph": Stage(0.0, nodes=nodes),
    }


def step(case: Case, loops: dict[str, Any], budgets: dict[str, int]) -> dict[str, Stage]:
    """A training step: the frame and its adjoint, the loss, and Adam."""
    stages = frame(case, loops, budgets)
    both = rasterisation(case, loops)["scgs_warp"]
    pixels, count = case.width * case.height, case.scene.gaussian_count
    numbers = sum(p.numel() for model in (case.scene.gaussians, case.scene.motion) for p in model.parameters())
    neighbors = case.scene.config.motion.neighbors
    moved = Stage(2 * stages["skin"].bytes + count * neighbors * 20, 3 * stages["skin"].flops)
    nodes = budgets["RECORDED_OPERATIONS"] + budgets["RECORDED_LAUNCHES"] + SORT_NODES["step"]
    return {
        **stages,
        "bin": both["bin"],
        "neighbours": Stage(count * (44 + 8 * neighbors), count * 512 * 3.0 * 11),
        "loss": Stage(pixels * FLOAT * 3 * 14, pixels * 3 * 2 * 5 * 22 * 2.0),
        "composite, adjoint": both["composite, adjoint"],
        "Gaussians, adjoint": both["Gaussians, adjoint"],
        "skin, adjoint": moved,
        "network, adjoint": Stage(2 * stages["network"].bytes, 2 * stages["network"].flops),
        "Adam": Stage(7.0 * FLOAT * numbers, 12.0 * numbers),
        "nodes of the graph": Stage(0.0, nodes=nodes),
    }


def read_budgets(path: Path) -> dict[str, int]:
    """Return the numbers of operations and launches that the tests allow."""
    found: dict[str, int] = {}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign):
            targets = node.targets[0].elts if isinstance(node.targets[0], ast.Tuple) else node.targets
            values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
            for target, value in zip(targets, values):
                if isinstance(target, ast.Name) and isinstance(value, ast.Constant) and isinstance(value.value, int):
                    found[target.id] = value.value
    return found


def described(case: Case, parts: dict[str, Stage]) -> dict[str, Any]:
    rows = {name: {**stage._asdict(), "us": 1e6 * stage.seconds} for name, stage in parts.items()}
    return {"stages": rows, "us": sum(row["us"] for row in rows.values())}


def estimate(kernels: dict[str, Any]) -> dict[str, Any]:
    loops, budgets = kernels["loops"], read_budgets(BUDGETS)
    wholes: list[tuple[str, int, Size, Callable[..., dict[str, Stage]]]] = [
        ("frame", 49_000, 800, frame),
        ("step", 40_000, 400, step),
    ]
    results: dict[str, Any] = {"rates": {"bandwidth": BANDWIDTH, "flops": FLOPS, "node_s": NODE}, "rasterisation": []}
    cases = {size: make_case(count, size) for _, count, size, _ in wholes}
    for name, _, size, count_work in wholes:
        case = cases[size]
        results[name] = {**workload(case), **described(case, count_work(case, loops, budgets))}
    for case in (cases[800], make_case(1_000_000, (1920, 1080))):
        both = rasterisation(case, loops)
        sides = {name: described(case, parts) for name, parts in both.items()}
        visits = {"scgs_warp": case.ours._asdict(), "gsplat": case.theirs._asdict()}
        results["rasterisation"].append({**workload(case), "visits": visits, **sides})
    return results


def workload(case: Case) -> dict[str, Any]:
    return {
        "gaussians": case.scene.gaussian_count,
        "width": case.width,
        "height": case.height,
        "pairs": case.ours.pairs,
        "contributors": case.load.contributors,
    }


def main(args: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernels", type=Path, required=True, help="result of kernel_table.py with --nvcc")
    parser.add_argument("--json", type=Path, required=True, help="file to write")
    words = sys.argv[1:] if args is None else args
    options = parser.parse_args(words)
    kernels = json.loads(options.kernels.read_text(encoding="utf-8"))
    if "gsplat" not in kernels["loops"]:
        print(f"{options.kernels} lacks gsplat's loops: run kernel_table.py with --nvcc", file=sys.stderr)
        return 2
    origin = {**provenance("cpu"), "command": command_line("benchmarks/estimate.py", words)}
    result = {**origin, **estimate(kernels)}
    options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
