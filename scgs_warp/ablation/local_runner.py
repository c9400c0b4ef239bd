"""Run the cells of an ablation one after the other in this process, or several at a time in worker processes.

``python -m scgs_warp.ablation.local_runner`` is a worker process: it reads one cell as JSON.
``ray_runner`` runs cells on a cluster.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, NamedTuple

from ..runtime import environment, memory
from ..runtime.progress import clock
from .cells import ERROR, LOG, Cell, attempt, cell_from_json, cell_to_json, is_done, read_metrics

POLL_SECONDS = 0.1
INTERRUPTED = 130

Report = Callable[[str], None]
End = Callable[[str, Cell, "str | None"], None]
"""Told of a cell that has ended: its place in the queue, the cell, and why it failed, if it did."""
Runner = Callable[[list[tuple[str, Cell]], Report, End], None]
"""Runs cells, and tells of each as it ends."""


def run_cells(
    cells: list[Cell],
    *,
    jobs: int = 1,
    threads: int | None = None,
    report: Report = print,
    finished: Callable[[], None] = lambda: None,
    elsewhere: Runner | None = None,
) -> dict[str, str]:
    """Run all cells that are not done.

    Args:
        jobs: how many at a time; with more than one, each has its own process and its share of the threads.
        threads: of all jobs together; default: all cores.
        report: gets one line when a cell begins and one when it ends.
        finished: called after each cell.
        elsewhere: runs the cells instead of this machine, where ``jobs`` and ``threads`` are its own concern.

    Returns:
        what went wrong, by the cells' names.

    Raises:
        KeyboardInterrupt: after Ctrl-C or SIGTERM, the running cells' checkpoints being saved.
    """
    failures: dict[str, str] = {}
    waiting = []
    for index, cell in enumerate(cells):
        place = f"[{index + 1}/{len(cells)}] {cell.name}"
        if is_done(cell):
            report(f"{place}: done before, {_score(cell)}")
        else:
            waiting.append((place, cell))

    def end(place: str, cell: Cell, failure: str | None) -> None:
        if failure is not None:
            failures[cell.name] = failure
        report(f"{place}: {_score(cell)}" if failure is None else f"{place}: failed: {failure}")
        finished()

    if elsewhere is not None:
        elsewhere(waiting, report, end)
    elif jobs > 1:
        _in_processes(waiting, jobs, threads, report, end)
    else:
        for place, cell in waiting:
            report(f"{place}: {cell.folder}")
            end(place, cell, attempt(cell))
    return failures


def _score(cell: Cell) -> str:
    metrics = read_metrics(Path(cell.folder)) or {}
    score, seconds = metrics.get("psnr"), metrics.get("seconds")
    text = "no PSNR" if score is None else f"PSNR {score:.2f} dB"
    return text if seconds is None else f"{text} after {clock(seconds)}"


class _Job(NamedTuple):
    place: str
    cell: Cell
    process: subprocess.Popen
    log: IO[bytes]


def _start(place: str, cell: Cell, threads: int, jobs: int, report: Report) -> _Job:
    folder = Path(cell.folder)
    folder.mkdir(parents=True, exist_ok=True)
    report(f"{place}: {folder / LOG}")
    log = open(folder / LOG, "ab")
    # In a session of its own, so that Ctrl-C in the terminal reaches it once, through us: the second would cut it off.
    process = subprocess.Popen(
        [sys.executable, "-m", "scgs_warp.ablation.local_runner", str(threads)],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=log,
        start_new_session=True,
        env={**os.environ, memory.SIBLINGS_VARIABLE: str(jobs)},
    )
    assert process.stdin is not None
    process.stdin.write(cell_to_json(cell).encode())
    process.stdin.close()
    return _Job(place, cell, process, log)


def _failure(job: _Job) -> str | None:
    """Why an ended process did not finish its cell; None if it did."""
    status = job.process.returncode
    if status == 0:
        return None
    file = Path(job.cell.folder) / ERROR
    if status == 2 and file.is_file():
        return file.read_text(encoding="utf-8").splitlines()[0]
    reason = f"ended by signal {-status}" if status < 0 else f"ended with status {status}"
    return f"{reason}; see {Path(job.cell.folder) / LOG}"


def _in_processes(
    waiting: list[tuple[str, Cell]],
    jobs: int,
    threads: int | None,
    report: Report,
    end: End,
) -> None:
    from ..runtime.stop_signals import stop_signals

    share = max(1, (threads or environment.available_threads()) // jobs)
    queue, running = list(waiting), []
    with stop_signals() as stop:
        try:
            while queue or running:
                while queue and len(running) < jobs and not stop.is_set():
                    running.append(_start(*queue.pop(0), share, jobs, report))
                for job in [job for job in running if job.process.poll() is not None]:
                    running.remove(job)
                    job.log.close()
                    end(job.place, job.cell, _failure(job))
                if stop.is_set():
                    raise KeyboardInterrupt
                time.sleep(POLL_SECONDS)
        finally:
            if running:
                report(f"stopping {len(running)} running: their checkpoints are being saved")
            for job in running:
                job.process.send_signal(signal.SIGINT if os.name == "posix" else signal.SIGTERM)
            for job in running:
                job.process.wait()
                job.log.close()


def main() -> int:
    """Status 0: done; 2: failed, the reason is in the cell's folder; 130: stopped."""
    environment.configure(int(sys.argv[1]))
    try:
        return 0 if attempt(cell_from_json(sys.stdin.read())) is None else 2
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
