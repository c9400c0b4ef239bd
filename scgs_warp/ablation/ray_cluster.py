"""A Ray cluster (extra ``cluster``): reached in bounded time or refused with one line, and what its machines have.

``python -m scgs_warp.ablation.ray_cluster ADDRESS`` only connects: Ray itself waits two minutes for a cluster that is
not there and then ends the process, so that a process of its own asks first.
"""

from __future__ import annotations

import importlib.util
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from ..errors import UserError

CONNECT_SECONDS = 5.0
"""For a connection to be accepted."""
ANSWER_SECONDS = 45.0
"""For Ray to be imported, and to answer."""
PULSE_SECONDS = 2.0
GONE_SECONDS = 20.0
"""Without an answer of the head the sweep ends, and says so: Ray itself ends the process after 60 s."""
STORE_BYTES = 100 << 20
"""Of shared memory for a local cluster's objects: ours are lines of text."""
START = "start a cluster with 'ray start --head', or give --ray local"


@dataclass(frozen=True)
class Machine:
    """A node of the cluster."""

    id: str
    host: str
    cpus: float
    gpus: float


def check_address(address: str) -> None:
    """Before anything else is done; connects to nothing that takes long.

    Raises:
        UserError: Ray is missing, the address is none, or nothing listens there.
    """
    if importlib.util.find_spec("ray") is None:
        raise UserError(
            f'--ray {address}: needs the package ray: pip install "scgs-warp[cluster]"; without --ray the cells are '
            "trained by processes of this machine"
        )
    if address in ("local", "auto"):
        return
    match = re.fullmatch(r"(?:ray://)?([\w.-]+|\[[0-9a-fA-F:]+\]):(\d{1,5})", address)
    if match is None:
        raise UserError(f"--ray {address!r}: give local, auto, HOST:PORT or ray://HOST:PORT")
    try:
        socket.create_connection((match[1].strip("[]"), int(match[2])), CONNECT_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise UserError(f"--ray {address}: no connection ({error}); {START}") from error


def prepare() -> None:
    """Ray reads its environment when it is imported. The user's values win."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")


def _init(address: str, **more: Any) -> Any:
    import ray
    import ray._private.worker as worker

    if hasattr(worker, "print_to_stdstream"):
        # Long lines on every worker that ends, even as it should; what matters of them we say ourselves.
        worker.print_to_stdstream = lambda *args, **keywords: None  # type: ignore[assignment]
    ray.init(address, log_to_driver=False, logging_level="error", **more)  # type: ignore[arg-type]
    return ray


@contextmanager
def connect(address: str, *, cpus: int, gpu: bool) -> Iterator[Any]:
    """The module ``ray``, connected to ``address`` (see :func:`check_address`) until the end of the context.

    Args:
        cpus: of the cluster that ``local`` starts, which listens on loopback alone.
        gpu: whether that one may have this machine's GPUs.

    Raises:
        UserError: no cluster answers, or it refuses this Python, this Ray or this user.
    """
    check_address(address)
    prepare()
    if address == "local":
        # Ray means a machine of its own by it; to us it is the switch that makes every part of Ray use 127.0.0.1.
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
        limits = {} if gpu else {"num_gpus": 0}
        more = {"num_cpus": cpus, "include_dashboard": False, "object_store_memory": STORE_BYTES, **limits}
    else:
        more = {}
        _ask(address)
    try:
        ray = _init(address, **more)
    except Exception as error:
        raise UserError(f"--ray {address}: {_reason(str(error))}; {START}") from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _ask(address: str) -> None:
    """Whether a cluster answers at ``address``; in a process of its own, which can be ended.

    Raises:
        UserError: it does not.
    """
    try:
        answer = subprocess.run(
            [sys.executable, "-m", "scgs_warp.ablation.ray_cluster", address],
            capture_output=True,
            text=True,
            timeout=ANSWER_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise UserError(
            f"--ray {address}: no Ray cluster answered within {ANSWER_SECONDS:.0f} s; {START}; from a machine outside "
            "the cluster, give ray://HOST:10001"
        ) from error
    if answer.returncode != 0:
        raise UserError(f"--ray {address}: {_reason(answer.stderr)}; {START}")


def _reason(text: str) -> str:
    """The last line that says something: of a traceback, the error."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return re.sub(r"^[\w.]+Error: ", "", lines[-1]) if lines else "Ray gave no reason"


class Head:
    """Whether the cluster's head is there; not known of a connection from outside, which ends with it."""

    def __init__(self, ray: Any, address: str) -> None:
        self.address = address
        self._place = None if address.startswith("ray://") else str(ray.get_runtime_context().gcs_address)
        self._answered = self._asked = time.monotonic()

    def check(self) -> None:
        """To be called often; asks now and then.

        Raises:
            UserError: there was no answer for a while.
        """
        now = time.monotonic()
        if self._place is None or now - self._asked < PULSE_SECONDS:
            return
        host, _, port = self._place.rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), CONNECT_SECONDS).close()
            self._answered = now
        except OSError as error:
            if now - self._answered > GONE_SECONDS:
                raise UserError(
                    f"--ray {self.address}: the head of the cluster is gone; what is trained is kept, and the same "
                    "command continues"
                ) from error
        self._asked = time.monotonic()


def machines(ray: Any) -> list[Machine]:
    """Those that are alive."""
    found = []
    for node in ray.nodes():
        if node["Alive"]:
            has = node["Resources"]
            name = f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
            found.append(Machine(node["NodeID"], name, has.get("CPU", 0.0), has.get("GPU", 0.0)))
    return found


def fitting(found: Sequence[Machine], cuda: bool) -> list[Machine]:
    """Machines that can train a cell at all; the head of a cluster often has no processors to give.

    Raises:
        UserError: there are none.
    """
    useful = [machine for machine in found if machine.cpus >= 1 and (machine.gpus >= 1 or not cuda)]
    if not useful:
        lacks = "a GPU and a CPU to give; take --device cpu, or add one" if cuda else "CPUs to give; add one"
        raise UserError(f"--ray: none of the cluster's {len(found)} machines has {lacks} with 'ray start --address'")
    return useful


def threads_of_a_cell(useful: Sequence[Machine], jobs: int, threads: int | None, cuda: bool) -> int:
    """A cell's share where ``jobs`` of them are to run on every machine at a time; on larger ones more will.

    Args:
        threads: for all cells of a machine together; default: as many as it gives.
    """
    shares = []
    for machine in useful:
        total = min(threads or int(machine.cpus), int(machine.cpus))
        shares.append(total // max(jobs, int(machine.gpus) if cuda else 1))
    return max(1, min(shares))


def places(useful: Sequence[Machine], threads: int, cuda: bool) -> int:
    """How many cells run at a time."""
    return sum(int(min(m.cpus // threads, m.gpus if cuda else m.cpus)) for m in useful)


if __name__ == "__main__":
    prepare()
    _init(sys.argv[1]).shutdown()
