"""Run the cells of an ablation one after the other in this process, or several at a time in worker processes.

``python -m scgs_warp.ablation.local_runner THREADS`` is a worker process; it reads one cell as JSON from its input.
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
from ..storage.files import read_text
from .cells import ERROR, LOG, Cell, attempt, cell_from_json, cell_to_json, is_done, read_metrics

POLL_SECONDS = 0.1
INTERRUPTED = 130

ReportLine = Callable[[str], None]
CellEnded = Callable[[str, Cell, "str | None"], None]
"""Callback for a cell that has ended: its label in the queue, the cell, and the reason if it failed."""
CellRunner = Callable[[list[tuple[str, Cell]], ReportLine, CellEnded], None]
"""Function that runs labelled cells and reports each as it ends."""


def run_cells(
    cells: list[Cell],
    *,
    jobs: int = 1,
    threads: int | None = None,
    report: ReportLine = print,
    finished: Callable[[], None] = lambda: None,
    elsewhere: CellRunner | None = None,
) -> dict[str, str]:
    """Run all cells that are not done.

    Args:
        jobs: Number of cells to run at a time; with more than one, each has its own process and its share of the
            threads.
        threads: CPU threads of all jobs together; all cores by default.
        report: Receives one line when a cell begins and one when it ends.
        finished: Called after each cell.
        elsewhere: Runs the cells in place of this machine and decides about jobs and threads itself.

    Returns:
        Reasons of failures, by the cells' names.

    Raises:
        KeyboardInterrupt: Ctrl-C or SIGTERM came; the running cells save their checkpoints.
    """
    failures: dict[str, str] = {}
    waiting = []
    for index, cell in enumerate(cells):
        label = f"[{index + 1}/{len(cells)}] {cell.name}"
        if is_done(cell):
            report(f"{label}: done before, {_score(cell)}")
        else:
            waiting.append((label, cell))

    def end(label: str, cell: Cell, failure: str | None) -> None:
        if failure is not None:
            failures[cell.name] = failure
        report(f"{label}: {_score(cell)}" if failure is None else f"{label}: failed: {failure}")
        finished()

    if elsewhere is not None:
        elsewhere(waiting, report, end)
    elif jobs > 1:
        _in_processes(waiting, jobs, threads, report, end)
    else:
        for label, cell in waiting:
            report(f"{label}: {cell.folder}")
            end(label, cell, attempt(cell))
    return failures


def _score(cell: Cell) -> str:
    metrics = read_metrics(Path(cell.folder)) or {}
    score, seconds = metrics.get("psnr"), metrics.get("seconds")
    text = "no PSNR" if score is None else f"PSNR {score:.2f} dB"
    return text if seconds is None else f"{text} after {clock(seconds)}"


class _Job(NamedTuple):
    label: str
    cell: Cell
    process: subprocess.Popen
    log: IO[bytes]


def _start(label: str, cell: Cell, threads: int, jobs: int, report: ReportLine) -> _Job:
    folder = Path(cell.folder)
    folder.mkdir(parents=True, exist_ok=True)
    report(f"{label}: {folder / LOG}")
    log = open(folder / LOG, "ab")
    # The worker has a session of its own, so that it receives Ctrl-C once, from this process: a second one would end it
    # before its checkpoint is saved.
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
    return _Job(label, cell, process, log)


def _failure(job: _Job) -> str | None:
    """Return the reason why an ended process did not finish its cell, or None if it did."""
    status = job.process.returncode
    if status == 0:
        return None
    file = Path(job.cell.folder) / ERROR
    if status == 2 and file.is_file():
        return read_text(file).splitlines()[0]
    reason = f"ended by signal {-status}" if status < 0 else f"ended with status {status}"
    return f"{reason}; see {Path(job.cell.folder) / LOG}"


def _in_processes(
    waiting: list[tuple[str, Cell]],
    jobs: int,
    threads: int | None,
    report: ReportLine,
    end: CellEnded,
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
                    end(job.label, job.cell, _failure(job))
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
    """Run one cell. Status 0: done; 2: failed, with the reason in the cell's folder; 130: stopped."""
    environment.configure(int(sys.argv[1]))
    try:
        return 0 if attempt(cell_from_json(sys.stdin.read())) is None else 2
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
