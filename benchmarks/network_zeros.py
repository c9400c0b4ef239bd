"""Measure how many hidden values of trained deformation networks are zero.

    python benchmarks/network_zeros.py runs/hook runs/figure --json benchmarks/results/network-zeros.json

The kernels of the CPU leave out products with zeros (``kernels/native/network_zeros.h``). Rows hold `run`, `rows` (the
control points), `zeros`, the share of hidden values that are zero, and `columns`, the share of a layer's columns that
are zero in eight rows that follow one another on the curve along which frames evaluate the control points. Both are
means over all hidden layers at the times 0.1, 0.5 and 0.9. A last row holds those of the benchmark's synthetic scene.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import torch
from provenance import ROOT

from scgs_warp import Scene
from scgs_warp.benchmark.scenes import synthetic_scene
from scgs_warp.geometry.morton import morton_order
from scgs_warp.motion import ControlPoints
from scgs_warp.motion.network import DeformationNetwork, encode, rows_of
from scgs_warp.runtime.environment import configure
from scgs_warp.runtime.provenance import command_line, provenance

TIMES = 0.1, 0.5, 0.9
TILE = 8


@torch.no_grad()
def shares(network: DeformationNetwork, positions: torch.Tensor, time: float) -> tuple[float, float]:
    """Return the shares of zeros and of columns that are zero in a tile, averaged over the hidden layers."""
    where = encode(positions[torch.from_numpy(morton_order(positions.numpy()))], network.position_frequencies)
    inputs = rows_of(where, encode(torch.tensor([[time]]), network.time_frequencies))
    hidden, zeros, columns = inputs, 0.0, 0.0
    for index, layer in enumerate(network.layers):
        hidden = layer(torch.cat([inputs, hidden], dim=1) if index == network.skip else hidden).relu()
        silent = hidden == 0
        tiles = silent[: len(silent) // TILE * TILE].view(-1, TILE, silent.shape[1])
        zeros += float(silent.float().mean()) / len(network.layers)
        columns += float(tiles.all(1).float().mean()) / len(network.layers)
    return zeros, columns


def row_of(name: str, scene: Scene) -> dict[str, object]:
    """Measure a scene with one network."""
    motion = scene.motion
    if not isinstance(motion, ControlPoints) or not isinstance(motion.network, DeformationNetwork):
        raise SystemExit(f"{name}: has no network of control points, or several")
    positions = motion.positions.detach()
    found = [shares(motion.network, positions, time) for time in TIMES]
    zeros, columns = (sum(values) / len(TIMES) for values in zip(*found, strict=True))
    print(f"{name:24}  {len(positions):5} control points  {zeros:.2f} zeros  {columns:.2f} of the columns")
    return {"run": name, "rows": len(positions), "zeros": zeros, "columns": columns}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    configure(1)
    rows = [row_of(run.name, Scene.load(run, device="cpu")) for run in options.runs]
    rows.append(row_of("synthetic", synthetic_scene("control-points", 10_000, 512, "cpu")))
    if options.json:
        origin = {"provenance": "measured", "command": command_line("benchmarks/network_zeros.py", sys.argv[1:])}
        (ROOT / options.json).write_text(json.dumps({**origin, **provenance("cpu"), "rows": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
