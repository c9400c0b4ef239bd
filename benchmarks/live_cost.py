"""Measure what a page that follows a training costs (``train.py --live``), and compare the checkpoints.

    python benchmarks/live_cost.py                                      # the built-in scene with the preset quick
    python benchmarks/live_cost.py --steps 1500 --json live.json
    python benchmarks/live_cost.py --data DIR --preset cpu --steps 4000

Two processes train the same scene with the same seed: one alone, the other with a page. They take turns in blocks of
steps, so that other work on the machine disturbs both alike. This process is the page: it holds the WebSocket and
fetches and inflates each scene; what a browser draws is not counted, since it may run elsewhere. The clock that spaces
the pictures stands still while the other process trains.

Per block, the ratio of the two processes' times is taken by the clock and as processor time of all threads. ``share``
is measured directly: the processor time of making and serving pictures, divided by that of the training with a page.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import zlib
from pathlib import Path
from typing import Any

from scgs_warp.apps.cli import prepare
from scgs_warp.apps.cli import run as run_app
from scgs_warp.apps.settings import builtin_scene
from scgs_warp.config.presets import PRESETS, TrainConfig, preset, with_steps
from scgs_warp.errors import UserError
from scgs_warp.live.training_view import TrainingView
from scgs_warp.live.viewer import SceneView
from scgs_warp.runtime import environment
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.training.loop import fit
from scgs_warp.training.run import load_splits
from scgs_warp.training.state import TrainState

WORKER = "SCGS_LIVE_COST_WORKER"
"""Environment variable that makes this script one of the two processes: ``alone`` or ``watched``."""
SETTLED = 10.0
"""Largest number of seconds that a page may need to fetch a scene."""


class Turns:
    """Watcher that trains in blocks, each when it is told to, and passes questions on to the page's watcher."""

    def __init__(self, block: int, view: SceneView | None, steps: int) -> None:
        self._block, self._step, self._idle = block, 0, 0.0
        self._watcher = None if view is None else TrainingView(view, steps, clock=lambda: self._now())
        self._began: tuple[float, float] | None = None
        self.shown, self.wall, self.processor = 0, 0.0, 0.0
        """Number of pictures, and the seconds of making them."""

    def _now(self) -> float:
        """Seconds of training."""
        return time.monotonic() - self._idle

    def due(self) -> bool:
        if self._step % self._block == 0:
            self.end_block()
            self.begin_block()
        self._step += 1
        return self._watcher is not None and self._watcher.due()

    def show(self, state: TrainState) -> None:
        assert self._watcher is not None
        wall, processor = time.perf_counter(), time.process_time()
        self._watcher.show(state)
        self.shown += 1
        self.wall += time.perf_counter() - wall
        self.processor += time.process_time() - processor

    def begin_block(self) -> None:
        stopped = time.monotonic()
        if not sys.stdin.readline():
            raise KeyboardInterrupt  # the other side has ended
        self._idle += time.monotonic() - stopped
        self._began = time.perf_counter(), time.process_time()

    def end_block(self) -> None:
        """Report the block. What the server sends afterwards is part of ``processor``, not of ``wall``."""
        if self._began is None:
            return
        wall, (began, processor) = time.perf_counter(), self._began
        tell(block=self._step)
        sys.stdin.readline()
        tell(wall=wall - began, processor=time.process_time() - processor)
        self._began = None


def tell(**fields: Any) -> None:
    """Answer the process that measures; what the training prints goes elsewhere."""
    assert sys.__stdout__ is not None
    print(json.dumps(fields), file=sys.__stdout__, flush=True)


def server_seconds() -> float:
    """Return the processor time of the thread that serves the page."""
    for thread in threading.enumerate():
        if thread.name == "page server" and thread.ident is not None and hasattr(time, "pthread_getcpuclockid"):
            return time.clock_gettime(time.pthread_getcpuclockid(thread.ident))
    return 0.0


def work(kind: str, options: argparse.Namespace, device: str) -> None:
    """Train in turns, as one of the two processes."""
    config = configuration(options)
    data, _ = load_splits(config, options.data)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        view = stack.enter_context(SceneView("training", port=0)) if kind == "watched" else None
        tell(url=None if view is None else view.server.url)
        turns = Turns(options.block, view, config.steps)
        fit(config, data, output=Path(folder) / "run", device=device, watcher=turns)
        turns.end_block()
        sys.stdin.readline()
        checkpoint = (Path(folder) / "run" / "checkpoint.safetensors").read_bytes()
        made = {"pictures": turns.shown, "wall": turns.wall, "processor": turns.processor, "server": server_seconds()}
        tell(bits=hashlib.sha256(checkpoint).hexdigest(), **made)


class Trainer:
    """One of the two processes."""

    def __init__(self, kind: str, words: list[str]) -> None:
        command = [sys.executable, str(Path(__file__).resolve()), *words]
        self.kind, self.blocks, self.end = kind, list[dict[str, float]](), dict[str, Any]()
        self._said = tempfile.TemporaryFile("w+")
        streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": self._said}
        self._process = subprocess.Popen(command, text=True, env={**os.environ, WORKER: kind}, **streams)
        self.url = self._hear()["url"]

    def _hear(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._said.seek(0)
            raise UserError(f"the training {self.kind} has ended early: {self._said.read()[-2000:].strip()}")
        return json.loads(line)

    def go(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write("go\n")
        self._process.stdin.flush()

    def take_block(self, settle: Any) -> bool:
        """Train one block; return False if it was the last one."""
        self.go()
        said = self._hear()
        if "block" in said:
            settle()
            self.go()
            self.blocks.append(self._hear())
            return True
        self.end = said
        return False

    def stop(self) -> None:
        self._process.kill()
        self._process.wait()


class Follower:
    """What a page does, without its browser: holds the WebSocket, fetches every scene, and inflates it."""

    def __init__(self, url: str) -> None:
        self.scenes, self.bytes, self.gaussians = 0, 0, 0
        self._known = self._shown = 0
        self._changed = threading.Condition()
        self._open = threading.Event()
        self._problem: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(url,), daemon=True)
        self._thread.start()
        if not self._open.wait(60):
            raise UserError(f"the page cannot be opened: {self._problem}")

    def _run(self, url: str) -> None:
        import asyncio

        try:
            asyncio.run(self._follow(url))
        except Exception as error:
            self._problem = error

    async def _follow(self, url: str) -> None:
        import aiohttp

        root = url.partition("/?")[0]
        async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session:
            await (await session.get(url)).read()
            async with session.ws_connect(f"{root}/socket", headers={"Origin": root}, max_msg_size=0) as wire:
                self._open.set()
                async for message in wire:
                    state = json.loads(message.data)
                    if "version" not in state:  # how to find the server again
                        continue
                    version = state["version"]
                    with self._changed:
                        self._known = version
                    if version not in (0, self._shown):  # a page that has just come may be told a version twice
                        self._take(await (await session.get(f"{root}/scene")).read())
                    with self._changed:
                        self._shown = version
                        self._changed.notify_all()

    def _take(self, content: bytes) -> None:
        raw = zlib.decompress(content)
        length = int.from_bytes(raw[:4], "little")
        self.gaussians = json.loads(raw[4 : 4 + length])["gaussians"]
        self.scenes += 1
        self.bytes += len(content)

    def settle(self) -> None:
        """Wait until the newest scene has come; raise UserError if the page is closed."""
        time.sleep(0.05)
        with self._changed:
            self._changed.wait_for(lambda: self._shown == self._known, SETTLED)
        if not self._thread.is_alive():
            raise UserError(f"the page was closed: {self._problem}")


def configuration(options: argparse.Namespace) -> TrainConfig:
    made = preset(options.preset)
    made = made if options.steps is None else with_steps(made, options.steps)
    return dataclasses.replace(made, checkpoint_seconds=1e9)


def ratios(alone: list[dict[str, float]], watched: list[dict[str, float]], name: str) -> dict[str, Any]:
    """Return the median and the quartiles of the ratios of blocks, and the ratio of the sums."""
    each = [b[name] / a[name] for a, b in zip(alone, watched, strict=True)]
    low, middle, high = statistics.quantiles(each, n=4) if len(each) > 1 else each * 3
    whole = sum(b[name] for b in watched) / sum(a[name] for a in alone)
    return {
        "median": round(middle, 4),
        "quartiles": [round(low, 4), round(high, 4)],
        "of_sums": round(whole, 4),
        "alone_s": round(sum(a[name] for a in alone), 2),
        "watched_s": round(sum(b[name] for b in watched), 2),
        "each": [round(ratio, 3) for ratio in each],
    }


def measure(words: list[str], opened: bool) -> dict[str, Any]:
    """Train both, in turns; the order of the two changes from pair to pair."""
    trainers: list[Trainer] = []
    try:
        for kind in ("alone", "watched"):
            trainers.append(Trainer(kind, words))
        alone, watched = trainers
        page = Follower(watched.url) if opened else None
        settles, running, pair = {"watched": page.settle} if page else {}, True, 0
        while running:
            for trainer in trainers if pair % 2 == 0 else trainers[::-1]:
                running = trainer.take_block(settles.get(trainer.kind, lambda: None))
            pair += 1
            if running and sys.stderr.isatty():
                print(f"\r{pair} pairs", end="", file=sys.stderr)
    finally:
        for trainer in trainers:
            trainer.stop()
    made, spent = watched.end, sum(block["processor"] for block in watched.blocks)
    return {
        "pairs": len(watched.blocks),
        "wall": ratios(alone.blocks, watched.blocks, "wall"),
        "processor": ratios(alone.blocks, watched.blocks, "processor"),
        "share": round((made["processor"] + made["server"]) / spent, 4),
        "pictures": made["pictures"],
        "ms_per_picture": round(1e3 * made["wall"] / max(made["pictures"], 1), 1),
        "server_s": round(made["server"], 3),
        "scenes_fetched": page.scenes if page else 0,
        "mib_fetched": round(page.bytes / 2**20, 2) if page else 0.0,
        "gaussians_of_the_last": page.gaussians if page else 0,
        "same_bits": alone.end["bits"] == watched.end["bits"],
    }


def main(arguments: list[str] | None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of a data set; default: the built-in scene")
    parser.add_argument("--preset", choices=PRESETS, default="quick")
    parser.add_argument("--steps", type=int, help="length of the run; default: the preset's")
    parser.add_argument("--block", type=int, default=250, help="steps of a block")
    parser.add_argument("--no-page", action="store_true", help="a control: nobody opens the page")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    if options.block < 1:
        raise UserError(f"--block {options.block}: give 1 or more")
    if kind := os.environ.get(WORKER):
        sys.stdout = sys.stderr
    device = prepare(options.device, options.threads)
    options.data = options.data or builtin_scene(device)
    if kind:
        work(kind, options, device)
        return
    words = sys.argv[1:] if arguments is None else arguments
    result = {
        "command": command_line("benchmarks/live_cost.py", words),
        "preset": options.preset,
        "steps": configuration(options).steps,
        "block": options.block,
        "threads": environment.thread_count(),
        **measure(words, not options.no_page),
        **provenance(device),
    }
    print(json.dumps(result, indent=1))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")
    if not result["same_bits"]:
        raise UserError("the checkpoints differ")


if __name__ == "__main__":
    sys.exit(run_app(main))
