"""One frame and one training step of a small scene, for tools that slow a program down a hundredfold.

    compute-sanitizer --tool racecheck python benchmarks/gpu_small.py
    PYTORCH_NO_CUDA_MEMORY_CACHING=1 compute-sanitizer --tool memcheck python benchmarks/gpu_small.py --no-graphs

Both are taken operation by operation and, but for ``--no-graphs``, from recorded graphs.
"""

from __future__ import annotations

import sys

import scgs_warp  # noqa: F401  (sets the environment before torch is loaded)

import torch  # isort: skip
from gpu_sanitizer import DONE

from scgs_warp.benchmark.scenes import scene_camera, synthetic_scene, training_data, training_state
from scgs_warp.runtime import environment
from scgs_warp.scene.frame_graph import RECORD_AFTER
from scgs_warp.training.frames import Frames
from scgs_warp.training.recorded_step import RecordedSteps
from scgs_warp.training.step import training_step

COUNT, NODES, SIZE = 300, 30, (64, 48)
RECORDED_STEPS = 4
"""Number of steps of which the last are replayed."""


def main(graphs: bool) -> None:
    environment.configure()
    scene = synthetic_scene("control-points", COUNT, NODES, "cuda")
    camera = scene_camera(scene, SIZE)
    for index in range(RECORD_AFTER + 2 if graphs else 1):
        scene.render(camera, 0.1 * index)
    data, state = training_data(scene, SIZE), training_state(scene, True)
    scene.motion.cache_binding(None)  # type: ignore[operator]
    frames = Frames(data, scene.normalisation, state.config, "cuda")
    failed = [training_step(state, frames).failed]
    state.step += 1
    steps = RecordedSteps(state, frames)
    for _ in range(RECORDED_STEPS if graphs else 1):
        failed += [result.failed for result in steps.take()]
        state.step += 1
    failed += [result.failed for result in steps.settle()]
    torch.cuda.synchronize()
    if any(failed) or (graphs and (steps.failure or scene.frame_graph().failure)):
        raise SystemExit(f"a step or a recording failed: {failed}, {steps.failure}, {scene.frame_graph().failure}")
    print(DONE, flush=True)


if __name__ == "__main__":
    main("--no-graphs" not in sys.argv[1:])
