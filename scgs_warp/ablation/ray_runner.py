"""Run the cells of an ablation as tasks of a Ray cluster; continue a cell whose worker was lost on another one.

Ray starts the processes and notices when one dies. Tasks are submitted with ``max_retries=0``, because Ray's retries
count deaths and not progress. A cell on machines that come and go may lose many workers, and is submitted again as long
as its checkpoint advances; after ``MOST_LOSSES`` losses without progress it fails.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any

from ..errors import UserError
from ..runtime import memory
from ..runtime.environment import available_threads
from ..runtime.progress import Progress, progress
from ..runtime.stop_signals import stop_signals
from ..storage.checkpoint import FILE as CHECKPOINT
from ..storage.files import open_regular
from ..storage.json_files import parse_json, read_json
from . import ray_cluster
from .cells import LOG, Cell, cell_to_json
from .local_runner import CellEnded, CellRunner, ReportLine
from .ray_cluster import Machine
from .ray_worker import (
    LOCK_SECONDS,
    PACKAGES,
    WORKER,
    fingerprint,
    identity,
    identity_difference,
    inspect_machine,
    train_cell,
)

MOST_LOSSES = 3
"""A cell fails after losing this many workers in a row without progress, because it may itself be what kills them."""
POLL_SECONDS = 0.5
INSPECT_SECONDS = 60.0
"""Longest wait for a machine to import the package and answer."""
STOP_SECONDS = 30.0
"""Longest wait for running cells to save their checkpoints."""
VISIBLE_SECONDS = 60.0
"""Longest wait for another machine's file to appear on this one: network file systems cache that a file is absent."""
TAIL = 4096


@contextmanager
def on_cluster(
    address: str, cells: Sequence[Cell], output: Path, *, jobs: int, threads: int | None, device: str
) -> Iterator[CellRunner]:
    """Connect to a cluster; yield the argument ``elsewhere`` of ``local_runner.run_cells``.

    Args:
        address: As ``ray_cluster.check_address`` takes it.
        output: Folder of all cells, which all machines must share.
        jobs: Number of cells to run at a time on each machine.
        threads: CPU threads on each machine; by default all that the machine offers.
        device: ``cpu``, ``cuda``, or ``auto``: GPUs if the cluster has some.

    Raises:
        UserError: there is no cluster, or its machines cannot train these cells.
    """
    local = max(1, (threads or available_threads()) // jobs) * jobs
    with ray_cluster.connect(address, cpus=local, gpu=device != "cpu") as ray:
        known = ray_cluster.machines(ray)
        cuda = device == "cuda" or (device == "auto" and any(machine.gpus >= 1 for machine in known))
        useful = ray_cluster.usable_machines(known, cuda)
        share = ray_cluster.threads_of_a_cell(useful, jobs, threads, cuda)
        expected, processors = _inspect_machines(ray, useful, cells, output)

        def run(waiting: list[tuple[str, Cell]], report: ReportLine, end: CellEnded) -> None:
            count = ray_cluster.cells_at_a_time(useful, share, cuda)
            size, room = _counted(len(useful), "machine"), f"{_counted(count, 'cell')} at a time"
            report(f"Ray cluster of {size}: {room}, each with {_counted(share, 'thread')}")
            if len(processors) > 1:
                report(f"processors differ, and so may the last digits of results: {', '.join(processors)}")
            placed = [(label, replace(cell, device="cuda" if cuda else "cpu")) for label, cell in waiting]
            head = ray_cluster.HeadMonitor(ray, address)
            Sweep(ray, expected, share, cuda, report, end, head.check, jobs).run(placed)

        yield run


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _inspect_machines(
    ray: Any, useful: Sequence[Machine], cells: Sequence[Cell], output: Path
) -> tuple[dict[str, str], list[str]]:
    """Ask every machine whether it can train the cells.

    Returns:
        The identity that all of them share, and the models of their processors.

    Raises:
        UserError: a machine cannot train the cells; names the machine and the reason.
    """
    ours = identity()
    folders = {str(cell.settings["data"]["folder"]) for cell in cells}
    question = {
        "data": {folder: fingerprint(Path(folder)) for folder in sorted(folders)},
        "weights": cells[0].lpips_weights,
    }
    with token_file(output) as (file, token):
        question |= {"token_file": str(file), "token": token}
        answers = _ask_all(ray, useful, question)
    expected: dict[str, str] = {name: value for name, value in ours.items() if name not in PACKAGES}
    for machine, answer in answers:
        differs = identity_difference(answer["identity"], expected)
        if differs is not None:
            raise UserError(f"--ray: {machine.host} has {differs}; install the same on every machine")
        if answer["problem"] is not None:
            raise UserError(f"--ray: {machine.host} {answer['problem']}")
        expected = {**answer["identity"], **expected}  # The first machine's packages count.
    return expected, sorted({answer["processor"] for _, answer in answers})


@contextmanager
def token_file(output: Path) -> Iterator[tuple[Path, str]]:
    """Make a locked file with a random text in ``output``; remove it afterwards.

    Raises:
        UserError: ``output`` cannot be written.
    """
    folder, token = output.absolute(), uuid.uuid4().hex
    file = folder / f".cluster-{token[:8]}"
    made = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        opened = open(file, "w", encoding="utf-8")
    except OSError as error:
        raise UserError(f"--output {output}: {error.strerror}; name a folder that all machines can write") from error
    try:
        with opened:
            _lock(opened)
            opened.write(token)
            opened.flush()
            yield file, token
    finally:
        file.unlink(missing_ok=True)
        if made and not any(folder.iterdir()):
            folder.rmdir()


def _lock(opened: IO[str]) -> None:
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(opened, fcntl.LOCK_EX)
    except OSError as error:
        raise UserError(f"{opened.name}: cannot be locked ({error.strerror}); mount it with locks (NFS 4)") from error


def _ask_all(ray: Any, useful: Sequence[Machine], question: dict[str, Any]) -> list[tuple[Machine, dict[str, Any]]]:
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    task = ray.remote(inspect_machine)
    refs = {}
    for machine in useful:
        affinity = NodeAffinitySchedulingStrategy(machine.id, soft=False)
        refs[task.options(num_cpus=0, max_retries=0, scheduling_strategy=affinity).remote(question)] = machine
    done, late = ray.wait(list(refs), num_returns=len(refs), timeout=INSPECT_SECONDS)
    if late:
        raise UserError(
            f"--ray: {refs[late[0]].host} gave no answer within {INSPECT_SECONDS:.0f} s; look at it, or stop it"
        )
    answers = []
    for ref in done:
        try:
            answers.append((refs[ref], ray.get(ref)))
        except ray.exceptions.RayTaskError as error:
            raise UserError(
                f"--ray: {refs[ref].host} cannot run this version ({_cause(error)}); install the same scgs-warp there, "
                "in the Python that runs 'ray start'"
            ) from error
        except ray.exceptions.RayError as error:
            raise UserError(f"--ray: {refs[ref].host} was lost when it was asked ({type(error).__name__})") from error
    return answers


def _cause(error: Exception) -> str:
    """Return the innermost reason that Ray gives, in one line."""
    lines = [line.strip() for line in str(getattr(error, "cause", None) or error).splitlines() if line.strip()]
    reasons = [line for line in lines if "Error: " in line]
    return (reasons or lines or [type(error).__name__])[-1]


@dataclass
class Task:
    """A cell that was submitted to the cluster."""

    label: str
    cell: Cell
    attempt: int = 1
    losses: int = 0
    """Workers lost since the checkpoint last changed."""
    mark: int = 0
    """Modification time, ns, that the checkpoint had when a worker was last lost."""
    seen: bool = False
    """True if the machine that runs this attempt has been reported."""
    done: int = 0
    """Number of trained steps that the progress bar shows."""

    @property
    def folder(self) -> Path:
        return Path(self.cell.folder)

    @property
    def steps(self) -> int:
        return int(self.cell.settings["steps"])


@dataclass
class Sweep:
    """All cells of one call, from submission to completion or failure."""

    ray: Any
    expected: dict[str, str]
    threads: int
    cuda: bool
    report: ReportLine
    end: CellEnded
    check: Callable[[], None] = lambda: None
    """Raises a UserError if the cluster is lost."""
    jobs: int = 1
    """Number of cells to run at a time on each machine."""
    sweep: str = field(default_factory=lambda: uuid.uuid4().hex)
    running: dict[Any, Task] = field(default_factory=dict)
    """Submitted tasks, by Ray's references to their results."""
    ended: int = 0

    def __post_init__(self) -> None:
        # Each cell gets a process of its own, as the local runner gives it, and Ray does not retry.
        options = {"num_cpus": self.threads, "num_gpus": 1 if self.cuda else 0, "max_calls": 1, "max_retries": 0}
        self._work = self.ray.remote(**options)(train_cell)

    def run(self, waiting: Sequence[tuple[str, Cell]]) -> None:
        """Run all cells until each is done or has failed.

        Raises:
            KeyboardInterrupt: Ctrl-C or SIGTERM came; the running cells save their checkpoints.
            UserError: the cluster is lost.
        """
        tasks = [Task(label, cell) for label, cell in waiting]
        for task in tasks:
            task.mark, task.done = _changed(task.folder), min(steps_done(task.folder), task.steps)
        total, done = sum(task.steps for task in tasks), sum(task.done for task in tasks)
        with progress(total, "steps of all cells", start=done) as bar, stop_signals() as stop:
            try:
                for task in tasks:
                    self._submit(task)
                while self.running:
                    self.check()
                    ready, _ = self.ray.wait(list(self.running), num_returns=1, timeout=POLL_SECONDS)
                    for ref in ready:
                        self._collect(ref, bar)
                    if stop.is_set():
                        raise KeyboardInterrupt
                    self._update_progress(bar, len(tasks))
            except ConnectionError as error:
                raise UserError(f"--ray: the connection is lost ({error}); the same command continues") from error
            finally:
                if self.running:
                    self._stop()

    def _submit(self, task: Task) -> None:
        order = {
            "cell": cell_to_json(task.cell),
            "threads": self.threads,
            "identity": self.expected,
            "sweep": self.sweep,
            "attempt": task.attempt,
            "wait": LOCK_SECONDS if task.attempt > 1 else 0.0,
            "memory": memory.limit(),
            "siblings": self.jobs,
        }
        self.running[self._work.remote(order)] = task
        task.seen = False

    def _collect(self, ref: Any, bar: Progress) -> None:
        """Handle a task that has ended: submit it again, or report its end."""
        task = self.running.pop(ref)
        lost, failure = self._outcome(ref)
        if lost is not None:
            changed = _changed(task.folder)
            task.losses = 1 if changed != task.mark else task.losses + 1
            task.mark = changed
            if task.losses < MOST_LOSSES:
                self.report(f"{task.label}: {lost}; it goes on elsewhere, from its checkpoint if it has one")
                task.attempt += 1
                self._submit(task)
                return
            failure = f"{lost}, {task.losses} times without a step forward; see {task.folder / LOG}"
        elif failure is None and not appears(task.folder / "metrics.json"):
            failure = f"trained, but its metrics.json is not seen in {task.folder} here; is the folder shared?"
        bar.advance(task.steps - task.done)
        self.ended += 1
        self.end(task.label, task.cell, failure)

    def _outcome(self, ref: Any) -> tuple[str | None, str | None]:
        """Return (reason, None) if the worker was lost, (None, reason) if the cell failed, (None, None) if it is
        trained."""
        errors = self.ray.exceptions
        try:
            answer = self.ray.get(ref)
        except errors.RayTaskError as error:
            return None, _cause(error)
        except errors.RayError as error:
            return _loss(error), None
        return ("its worker was stopped", None) if answer["stopped"] else (None, answer["failure"])

    def _update_progress(self, bar: Progress, total: int) -> None:
        """Report cells that have begun, and advance the bar."""
        active = 0
        for task in self.running.values():
            worker = _read(task.folder / WORKER)
            if worker.get("sweep") != self.sweep or worker.get("attempt") != task.attempt:
                continue
            active += 1
            if not task.seen:
                task.seen = True
                self.report(f"{task.label}: on {worker['host']}, {task.folder / LOG}")
            done = min(steps_done(task.folder), task.steps)
            bar.advance(done - task.done)
            task.done = done
        bar.advance(0, cells=f"{self.ended}/{total}", running=active)

    def _stop(self) -> None:
        """Ask running cells to save and end; cancel waiting ones."""
        self.report("stopping: cells that run save their checkpoints")
        try:
            for ref in self.running:
                self.ray.cancel(ref, force=False)
            self.ray.wait(list(self.running), num_returns=len(self.running), timeout=STOP_SECONDS)
        except ConnectionError:
            pass  # The cluster ends tasks whose driver has left.


def _loss(error: Exception) -> str:
    """Return the reason why a worker was lost."""
    known = {
        "WorkerCrashedError": "its worker was killed",
        "NodeDiedError": "its machine was lost",
        "OutOfMemoryError": "its worker was killed for want of memory",
        "TaskCancelledError": "it was cancelled",
    }
    name = type(error).__name__
    return known.get(name, f"its worker was lost ({name})")


def _changed(folder: Path) -> int:
    """Return the modification time of the checkpoint, ns; 0 without one."""
    try:
        return (folder / CHECKPOINT).stat().st_mtime_ns
    except OSError:
        return 0


def _read(path: Path) -> dict[str, Any]:
    try:
        return read_json(path)
    except UserError:
        return {}


def steps_done(folder: Path) -> int:
    """Read the last step from the log; return 0 if there is none."""
    try:
        with open_regular(folder / "log.jsonl") as file:
            file.seek(max(0, file.seek(0, 2) - TAIL))
            lines = file.read().splitlines()
    except OSError:
        return 0
    for line in reversed(lines):
        try:
            return int(parse_json(line)["step"])
        except (ValueError, KeyError, TypeError):
            continue  # The line is being written, or was cut.
    return 0


def appears(path: Path) -> bool:
    """Wait for a file of another machine; return False if it does not appear in ``VISIBLE_SECONDS``."""
    until = time.monotonic() + VISIBLE_SECONDS
    while not path.is_file():
        if time.monotonic() > until:
            return False
        list(path.parent.iterdir())  # Listing the folder makes an NFS client look again.
        time.sleep(POLL_SECONDS)
    return True
