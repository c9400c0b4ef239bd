"""The cells of an ablation as tasks of a Ray cluster: begun where there is room, begun again where a worker is lost.

Ray starts the processes and notices when one dies; what happens then is decided here, where the cells' folders can be
seen: a cell that came further since the last loss is given another chance, as often as it takes.
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
from ..storage.json_files import parse_json
from . import ray_cluster
from .cells import LOG, Cell, cell_to_json
from .local_runner import End, Report, Runner
from .ray_cluster import Machine
from .ray_worker import LOCK_SECONDS, PACKAGES, WORKER, difference, fingerprint, identity, look, work

MOST_LOSSES = 3
"""Workers that a cell may lose without a step forward; then it fails: it may be what kills them."""
POLL_SECONDS = 0.5
LOOK_SECONDS = 60.0
"""For a machine to import the package and answer."""
STOP_SECONDS = 30.0
"""For running cells to save their checkpoints."""
VISIBLE_SECONDS = 60.0
"""For a file that another machine wrote to be seen here: file systems of networks remember what was not there."""
TAIL = 4096


@contextmanager
def on_cluster(
    address: str, cells: Sequence[Cell], output: Path, *, jobs: int, threads: int | None, device: str
) -> Iterator[Runner]:
    """What ``ablate_jobs.run_cells`` takes as ``elsewhere``, as long as the context lasts.

    Args:
        address: as ``ray_cluster.check_address`` wants it.
        output: the folder of all cells, which all machines must share.
        jobs: cells at a time on each machine.
        threads: of each machine; default: all that it gives.
        device: ``cpu``, ``cuda``, or ``auto``: GPUs if the cluster has some.

    Raises:
        UserError: no cluster, or its machines cannot train these cells.
    """
    local = max(1, (threads or available_threads()) // jobs) * jobs
    with ray_cluster.connect(address, cpus=local, gpu=device != "cpu") as ray:
        found = ray_cluster.machines(ray)
        cuda = device == "cuda" or (device == "auto" and any(machine.gpus >= 1 for machine in found))
        useful = ray_cluster.fitting(found, cuda)
        share = ray_cluster.threads_of_a_cell(useful, jobs, threads, cuda)
        expected, processors = _look(ray, useful, cells, output)

        def run(waiting: list[tuple[str, Cell]], report: Report, end: End) -> None:
            count = ray_cluster.places(useful, share, cuda)
            size, room = _some(len(useful), "machine"), f"{_some(count, 'cell')} at a time"
            report(f"Ray cluster of {size}: {room}, each with {_some(share, 'thread')}")
            if len(processors) > 1:
                report(f"processors differ, and so may the last digits of results: {', '.join(processors)}")
            placed = [(place, replace(cell, device="cuda" if cuda else "cpu")) for place, cell in waiting]
            head = ray_cluster.Head(ray, address)
            _Sweep(ray, expected, share, cuda, report, end, head.check, jobs).run(placed)

        yield run


def _some(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _look(ray: Any, useful: Sequence[Machine], cells: Sequence[Cell], output: Path) -> tuple[dict[str, str], list[str]]:
    """Ask every machine whether it can train the cells.

    Returns:
        the identity that all of them have, and their processors' models.

    Raises:
        UserError: one cannot; names it, and why.
    """
    ours = identity()
    folders = {str(cell.settings["data"]["folder"]) for cell in cells}
    question = {
        "data": {folder: fingerprint(Path(folder)) for folder in sorted(folders)},
        "weights": cells[0].lpips_weights,
    }
    with _token(output) as (file, token):
        question |= {"token_file": str(file), "token": token}
        answers = _ask_all(ray, useful, question)
    expected: dict[str, str] = {name: value for name, value in ours.items() if name not in PACKAGES}
    for machine, answer in answers:
        differs = difference(answer["identity"], expected)
        if differs is not None:
            raise UserError(f"--ray: {machine.host} has {differs}; install the same on every machine")
        if answer["problem"] is not None:
            raise UserError(f"--ray: {machine.host} {answer['problem']}")
        expected = {**answer["identity"], **expected}  # the first one's packages count
    return expected, sorted({answer["processor"] for _, answer in answers})


@contextmanager
def _token(output: Path) -> Iterator[tuple[Path, str]]:
    """A locked file in ``output`` with a text that nobody can guess; both are gone afterwards.

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

    task = ray.remote(look)
    refs = {}
    for machine in useful:
        there = NodeAffinitySchedulingStrategy(machine.id, soft=False)
        refs[task.options(num_cpus=0, max_retries=0, scheduling_strategy=there).remote(question)] = machine
    done, late = ray.wait(list(refs), num_returns=len(refs), timeout=LOOK_SECONDS)
    if late:
        raise UserError(
            f"--ray: {refs[late[0]].host} gave no answer within {LOOK_SECONDS:.0f} s; look at it, or stop it"
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
    """One line, the innermost reason that Ray gives."""
    lines = [line.strip() for line in str(getattr(error, "cause", None) or error).splitlines() if line.strip()]
    found = [line for line in lines if "Error: " in line]
    return (found or lines or [type(error).__name__])[-1]


@dataclass
class _Task:
    """A cell that was handed to the cluster."""

    place: str
    cell: Cell
    attempt: int = 1
    losses: int = 0
    """Since the checkpoint last changed."""
    mark: int = 0
    """The checkpoint's time of change, ns, when a worker was last lost."""
    seen: bool = False
    """Whether it was reported to run."""
    done: int = 0
    """Steps."""

    @property
    def folder(self) -> Path:
        return Path(self.cell.folder)

    @property
    def steps(self) -> int:
        return int(self.cell.settings["steps"])


@dataclass
class _Sweep:
    """The cells on their way."""

    ray: Any
    expected: dict[str, str]
    threads: int
    cuda: bool
    report: Report
    end: End
    check: Callable[[], None] = lambda: None
    """Raises a UserError when the cluster is lost."""
    jobs: int = 1
    """Cells at a time on each machine."""
    sweep: str = field(default_factory=lambda: uuid.uuid4().hex)
    running: dict[Any, _Task] = field(default_factory=dict)
    """By what Ray calls their results."""
    ended: int = 0

    def __post_init__(self) -> None:
        # A process for each cell, as the local runner has; retries are ours.
        options = {"num_cpus": self.threads, "num_gpus": 1 if self.cuda else 0, "max_calls": 1, "max_retries": 0}
        self._work = self.ray.remote(**options)(work)

    def run(self, waiting: Sequence[tuple[str, Cell]]) -> None:
        """All of them, to the end.

        Raises:
            KeyboardInterrupt: after Ctrl-C or SIGTERM, the running cells' checkpoints being saved.
            UserError: the cluster is lost.
        """
        tasks = [_Task(place, cell) for place, cell in waiting]
        for task in tasks:
            task.mark, task.done = _changed(task.folder), min(_steps_done(task.folder), task.steps)
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
                    self._look(bar, len(tasks))
            except ConnectionError as error:
                raise UserError(f"--ray: the connection is lost ({error}); the same command continues") from error
            finally:
                if self.running:
                    self._stop()

    def _submit(self, task: _Task) -> None:
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
        """A task has ended, somehow."""
        task = self.running.pop(ref)
        lost, failure = self._outcome(ref)
        if lost is not None:
            changed = _changed(task.folder)
            task.losses = 1 if changed != task.mark else task.losses + 1
            task.mark = changed
            if task.losses < MOST_LOSSES:
                self.report(f"{task.place}: {lost}; it goes on elsewhere, from its checkpoint if it has one")
                task.attempt += 1
                self._submit(task)
                return
            failure = f"{lost}, {task.losses} times without a step forward; see {task.folder / LOG}"
        elif failure is None and not _appears(task.folder / "metrics.json"):
            failure = f"trained, but its metrics.json is not seen in {task.folder} here; is the folder shared?"
        bar.advance(task.steps - task.done)
        self.ended += 1
        self.end(task.place, task.cell, failure)

    def _outcome(self, ref: Any) -> tuple[str | None, str | None]:
        """Why the worker was lost, or why the cell failed; neither: it is trained."""
        errors = self.ray.exceptions
        try:
            answer = self.ray.get(ref)
        except errors.RayTaskError as error:
            return None, _cause(error)
        except errors.RayError as error:
            return _loss(error), None
        return ("its worker was stopped", None) if answer["stopped"] else (None, answer["failure"])

    def _look(self, bar: Progress, total: int) -> None:
        """Which cells run, and how far they are."""
        active = 0
        for task in self.running.values():
            worker = _read(task.folder / WORKER)
            if worker.get("sweep") != self.sweep or worker.get("attempt") != task.attempt:
                continue
            active += 1
            if not task.seen:
                task.seen = True
                self.report(f"{task.place}: on {worker['host']}, {task.folder / LOG}")
            done = min(_steps_done(task.folder), task.steps)
            bar.advance(done - task.done)
            task.done = done
        bar.advance(0, cells=f"{self.ended}/{total}", running=active)

    def _stop(self) -> None:
        """Ask all that run to save and end; forget those that wait."""
        self.report("stopping: cells that run save their checkpoints")
        try:
            for ref in self.running:
                self.ray.cancel(ref, force=False)
            self.ray.wait(list(self.running), num_returns=len(self.running), timeout=STOP_SECONDS)
        except ConnectionError:
            pass  # then the cluster ends them


def _loss(error: Exception) -> str:
    """Why a worker is no more."""
    known = {
        "WorkerCrashedError": "its worker was killed",
        "NodeDiedError": "its machine was lost",
        "OutOfMemoryError": "its worker was killed for want of memory",
        "TaskCancelledError": "it was cancelled",
    }
    name = type(error).__name__
    return known.get(name, f"its worker was lost ({name})")


def _changed(folder: Path) -> int:
    """When the checkpoint was last written, ns; 0 without one."""
    try:
        return (folder / CHECKPOINT).stat().st_mtime_ns
    except OSError:
        return 0


def _read(path: Path) -> dict[str, Any]:
    try:
        values = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def _steps_done(folder: Path) -> int:
    """By the end of the log; 0 without one."""
    try:
        with open(folder / "log.jsonl", "rb") as file:
            file.seek(max(0, file.seek(0, 2) - TAIL))
            lines = file.read().splitlines()
    except OSError:
        return 0
    for line in reversed(lines):
        try:
            return int(parse_json(line)["step"])
        except (ValueError, KeyError, TypeError):
            continue  # a line that is being written, or was cut
    return 0


def _appears(path: Path, seconds: float = VISIBLE_SECONDS) -> bool:
    """Whether a file that another machine wrote is there, or comes in time."""
    until = time.monotonic() + seconds
    while not path.is_file():
        if time.monotonic() > until:
            return False
        list(path.parent.iterdir())  # makes a client of NFS look again
        time.sleep(POLL_SECONDS)
    return True
