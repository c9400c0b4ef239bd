"""Measure the cost of sharing a step's views among processes: bytes, and the time of each part of a step.

    torchrun --standalone --nproc-per-node 2 benchmarks/sharing.py                 # two processes on this machine
    torchrun --standalone --nproc-per-node 2 benchmarks/sharing.py --size 800 --json sharing.json
    python benchmarks/sharing.py                                                   # one process, for comparison

Every process renders one view per step of the synthetic scene of ``apps/bench.py step``. Milliseconds are medians over
steps of the first process, by the clock and as processor time of all its threads; on a busy machine the latter is
steadier, but does not include waiting.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import scgs_warp

import torch  # isort: skip

from scgs_warp.apps.cli import prepare
from scgs_warp.apps.cli import run as run_app
from scgs_warp.benchmark.memory import model_mib, peak_mib
from scgs_warp.benchmark.scenes import synthetic_scene, training_data, training_state
from scgs_warp.optim import Adam
from scgs_warp.runtime import environment
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.runtime.torchrun import process_rank
from scgs_warp.training import step as training
from scgs_warp.training.frames import Frames
from scgs_warp.training.process_group import ProcessGroup, join_processes

assert scgs_warp.__version__
PARTS = [
    ("view", training, "one_view"),
    ("wait", ProcessGroup, "gather_rows"),
    ("exchange", ProcessGroup, "all_to_all"),
    ("join", ProcessGroup, "all_gather"),
    ("adam", Adam, "step"),
]
"""Names of rows, and the functions that they time: a view forward and backward, waiting for the others at its end, two
ways of moving gradients, and Adam."""


class Clock:
    """Times of functions, step by step."""

    def __init__(self, device: str) -> None:
        self.wait = torch.cuda.synchronize if device == "cuda" else lambda: None
        self.steps: list[dict[str, tuple[float, float]]] = []
        for label, owner, name in PARTS:
            setattr(owner, name, self._timed(getattr(owner, name), label))

    def _timed(self, call: Any, name: str) -> Any:
        def timed(*arguments: Any, **named: Any) -> Any:
            before = self._now()
            result = call(*arguments, **named)
            self._add(name, before)
            return result

        return timed

    def _now(self) -> tuple[float, float]:
        self.wait()
        return time.perf_counter(), time.process_time()

    def _add(self, name: str, before: tuple[float, float]) -> None:
        wall, processor = (after - then for after, then in zip(self._now(), before))
        wall_before, processor_before = self.steps[-1].get(name, (0.0, 0.0))
        self.steps[-1][name] = wall_before + wall, processor_before + processor

    def step(self, call: Any) -> None:
        self.steps.append({})
        self._timed(call, "step")()

    def rows(self) -> list[dict[str, Any]]:
        samples: dict[str, list[tuple[float, float]]] = defaultdict(list)
        for step in self.steps[len(self.steps) // 5 :]:  # The first steps allocate.
            for name, times in step.items():
                samples[name].append(times)
        medians = {name: [1e3 * statistics.median(column) for column in zip(*times)] for name, times in samples.items()}
        return [{"name": name, "ms": round(wall, 2), "cpu_ms": round(cpu, 2)} for name, (wall, cpu) in medians.items()]


def main(arguments: list[str] | None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, usual in (("gaussians", 49_000), ("nodes", 512), ("size", 400), ("steps", 50)):
        parser.add_argument(f"--{name}", type=int, default=usual)
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    where = process_rank()
    device = prepare(options.device, where.threads if where and options.threads is None else options.threads)
    with join_processes(where, device) as group:
        scene = synthetic_scene("control-points", options.gaussians, options.nodes, device)
        data = training_data(scene, options.size)
        scene.motion.cache_binding(None)
        state = training_state(scene, arap=False)
        state.group, processes = group, 1 if group is None else group.size
        state.config = replace(state.config, batch=processes)
        frames, clock = Frames(data, scene.normalisation, state.config, device), Clock(device)

        def step() -> None:
            if training.training_step(state, frames).failed is not None:
                raise RuntimeError("the loss is not finite")
            state.step += 1

        for _ in range(options.steps):
            clock.step(step)
        result = {
            "command": command_line("benchmarks/sharing.py", sys.argv[1:] if arguments is None else arguments),
            "processes": processes,
            "threads": environment.thread_count(),
            "model_mib": round(model_mib(scene), 1),
            "peak_mib": round(peak_mib(device) or 0.0),
            "mib_per_step": round((group.bytes / options.steps if group else 0) / 2**20, 2),
            "rows": clock.rows(),
            **provenance(device),
        }
        print(json.dumps(result, indent=1))
        if options.json and (group is None or group.first):
            options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(run_app(main))
