"""One frame and one training step of a small scene, for tools that slow a program down a hundredfold.

    compute-sanitizer --tool racecheck python benchmarks/gpu_small.py --no-graphs
    PYTORCH_NO_CUDA_MEMORY_CACHING=1 compute-sanitizer --tool memcheck python benchmarks/gpu_small.py --no-graphs

Both are taken operation by operation and, but for ``--no-graphs``, from recorded graphs.
"""

from __future__ import annotations

import contextlib
import sys
from unittest import mock

import scgs_warp  # noqa: F401  (sets the environment before torch is loaded)

import torch  # isort: skip
from gpu_sanitizer import DONE

from scgs_warp.benchmark.scenes import scene_camera, synthetic_scene, training_data, training_state
from scgs_warp.runtime import environment
from scgs_warp.scene import frame_graph
from scgs_warp.training.frames import Frames
from scgs_warp.training.recorded_step import RecordedSteps
from scgs_warp.training.state import TrainState
from scgs_warp.training.stepping import PlainSteps

COUNT, NODES, SIZE = 300, 30, (64, 48)
RECORDED_STEPS = 4
"""Number of steps of which the last are replayed."""


def main(graphs: bool) -> None:
    environment.configure()
    never = contextlib.nullcontext() if graphs else mock.patch.object(frame_graph, "RECORD_AFTER", sys.maxsize)
    with never:
        scene = synthetic_scene("control-points", COUNT, NODES, "cuda")
        camera = scene_camera(scene, SIZE)
        for index in range(frame_graph.RECORD_AFTER + 2 if graphs else 1):
            scene.render(camera, 0.1 * index)
        data, state = training_data(scene, SIZE), training_state(scene, True)
    scene.motion.cache_binding(None)
    frames = Frames(data, scene.normalisation, state.config, "cuda")
    failed = taken(PlainSteps(state, frames), state, 1)
    failures = [scene.frame_graph().failure]
    if graphs:
        steps = RecordedSteps(state, frames)
        failed += taken(steps, state, RECORDED_STEPS)
        failures.append(steps.failure)
    torch.cuda.synchronize()
    if any(failed) or any(failures):
        raise SystemExit(f"a step or a recording failed: {failed}, {failures}")
    print(DONE, flush=True)


def taken(steps: PlainSteps | RecordedSteps, state: TrainState, count: int) -> list[str | None]:
    """Take training steps; return the reason of each that failed, else None."""
    failed: list[str | None] = []
    for _ in range(count):
        failed += [result.failed for result in steps.take()]
        state.step += 1
    return failed + [result.failed for result in steps.settle()]


if __name__ == "__main__":
    main("--no-graphs" not in sys.argv[1:])
