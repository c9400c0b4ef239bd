"""Scenarios that tests/training/test_process_group.py runs in several processes, one after the other.

``python tests/helpers/parallel_job.py OUTPUT SCENARIO...``. Refusals go to OUTPUT/RANK.json. The environment variable
PORTS holds one port for each time the processes join.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # when run as a program

import torch
from safetensors.torch import save_file

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.apps.cli import run
from scgs_warp.config.presets import TrainConfig
from scgs_warp.data.dataset import Dataset
from scgs_warp.errors import UserError
from scgs_warp.runtime import environment
from scgs_warp.runtime.torchrun import process_rank
from scgs_warp.training import loop, process_group, second_try_config, stepping
from scgs_warp.training.frames import Frames
from scgs_warp.training.loop import fit
from scgs_warp.training.process_group import ProcessGroup, join_processes
from scgs_warp.training.state import StepResult, TrainState

SHORT = timedelta(seconds=6)
USUALLY = second_try_config.LEAST_VISITS
ENDING = ("hung", "killed")
"""Scenarios after which the processes are no longer joined."""

PLAIN = tiny_config(40, batch=2, loss={"arap_until": 40})
"""With ARAP to the end: a row of the log has its last value since a row or a resume, so both see it."""
RICH = tiny_config(
    40,
    batch=4,
    freeze=2,
    data={"background": "random"},
    motion={"hyper_dim": 2, "time_noise": 0.1, "mask": True},
    pretrain={"progressive": True},
    optim={"cameras": 1e-3},
    densify={"absolute_grad": True},
)
LONG = tiny_config(500, batch=2, motion={"width": 32}, densify={"max_gaussians": 3000, "until": 400})
TWICE = tiny_config(30, batch=2, pretrain={"steps": 12, "densify_until": 8, "warm_up": 2, "progressive_every": 1})
PLANES = tiny_config(20, batch=4, coarse=3, motion={"model": "hexplane"})


def spoilt() -> Dataset:
    """The second of six frames cannot be learnt from; the fourth has another size than the first."""
    data = tiny_dataset(6)
    small = tiny_dataset(6, 32)
    frames = [small[i] if i == 3 else data[i] for i in range(6)]
    frames[1].image[5, 5, 0] = float("nan")
    return Dataset(frames, folder=Path("tiny"), split="train", background="random")


DATA: dict[str, tuple[TrainConfig, Callable[[], Dataset]]] = {
    "plain": (PLAIN, lambda: tiny_dataset(6)),
    "rich": (RICH, spoilt),
    "planes": (PLANES, lambda: tiny_dataset(6)),
    "long": (LONG, tiny_dataset),
    "twice": (TWICE, lambda: tiny_dataset(6)),
    "uneven": (tiny_config(40, batch=3), lambda: tiny_dataset(6)),
}


def at_step(step: int, rank: int, group: ProcessGroup | None, act: Callable[[TrainState], None]) -> None:
    """Have one process do something before a step's views."""
    original = stepping.training_step

    def acting(state: TrainState, frames: Frames) -> StepResult:
        if state.step == step and (group is None or group.rank == rank):
            act(state)
        return original(state, frames)

    stepping.training_step = acting


def nudge(state: TrainState) -> None:
    state.gaussians.means.data[0, 0] += 1e-6


def kill(state: TrainState) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def ask(state: TrainState) -> None:
    os.kill(os.getpid(), signal.SIGTERM)


def hang(state: TrainState) -> None:
    time.sleep(1.5 * SHORT.total_seconds())


def play(name: str, group: ProcessGroup | None, output: Path) -> None:
    """One scenario: a run of ``DATA``, or one of those with a mishap on the plain one."""
    mishaps = {"stopped": (20, 1, ask), "killed": (23, 1, kill), "hung": (7, 0, hang), "nudged": (6, 1, nudge)}
    if name in mishaps:
        step, rank, act = mishaps[name]
        at_step(step, rank, group, act)
    second_try_config.LEAST_VISITS = 1 if name == "twice" else USUALLY
    process_group.PIECE = 999 if name == "rich" else 1 << 22
    loop.COMPARE_EVERY = 5 if name == "nudged" else 500
    config, data = DATA.get(name, DATA["plain"])
    scene = fit(config, data(), output=output / name, group=group, resume=name == "resumed")
    if name == "long" and group is not None:
        save_file(
            {key: value.detach().clone() for key, value in scene.tensors().items()}, output / f"{group.rank}.long"
        )


def main(arguments: list[str] | None) -> None:
    output, refused = Path(sys.argv[1]), {}
    environment.configure(1)
    untouched, ports = stepping.training_step, os.environ["PORTS"].split()
    scenarios = sys.argv[2:]
    while scenarios:
        process_group.PATIENCE = SHORT if scenarios[0] == "hung" else timedelta(minutes=2)
        os.environ["MASTER_PORT"] = ports.pop()
        with join_processes(process_rank(), "cpu") as group:
            assert group is not None
            while scenarios:
                name = scenarios.pop(0)
                stepping.training_step = untouched
                try:
                    play(name, group, output)
                except KeyboardInterrupt:
                    refused[name] = "interrupted"
                except UserError as error:
                    refused[name] = str(error)
                    if not scenarios:
                        raise
                finally:
                    (output / f"{group.rank}.json").write_text(json.dumps(refused))
                if name in ENDING or (scenarios and scenarios[0] in ENDING):
                    break


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(run(main))
