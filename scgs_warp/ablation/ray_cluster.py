"""Connection to a Ray cluster (extra ``cluster``) in bounded time, and the resources of its machines.

``python -m scgs_warp.ablation.ray_cluster ADDRESS`` only connects. It runs as a process of its own before this one
connects, because Ray waits two minutes for a missing cluster and then ends the process.
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
"""Longest wait for a connection to be accepted."""
ANSWER_SECONDS = 45.0
"""Longest wait for Ray to be imported and to answer."""
PULSE_SECONDS = 2.0
"""Time between two checks of the cluster's head node."""
GONE_SECONDS = 20.0
"""Time without an answer from the head node after which the ablation ends with a one-line error; Ray would end the
process after 60 s."""
STORE_BYTES = 100 << 20
"""Bytes of shared memory for the objects of a local cluster. Little is needed: an ablation's objects are lines of
text."""
START_HINT = "start a cluster with 'ray start --head', or give --ray local"


@dataclass(frozen=True)
class Machine:
    """A machine of the cluster, and the resources that it offers."""

    id: str
    host: str
    cpus: float
    gpus: float


def check_address(address: str) -> None:
    """Check ``--ray`` before anything else is done.

    Raises:
        UserError: Ray is missing, the address is malformed, or nothing listens there.
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
        raise UserError(f"--ray {address}: no connection ({error}); {START_HINT}") from error


def prepare() -> None:
    """Set Ray's environment, which it reads when it is imported; the user's values win."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")


def _init(address: str, **more: Any) -> Any:
    import ray
    import ray._private.worker as worker

    if hasattr(worker, "print_to_stdstream"):
        # Ray prints long lines about every worker that ends, even as it should; the sweep reports losses itself.
        worker.print_to_stdstream = lambda *args, **keywords: None  # type: ignore[assignment]
    ray.init(address, log_to_driver=False, logging_level="error", **more)  # type: ignore[arg-type]
    return ray


@contextmanager
def connect(address: str, *, cpus: int, gpu: bool) -> Iterator[Any]:
    """Yield the module ``ray``, connected to ``address`` (see :func:`check_address`).

    Args:
        cpus: Processors of the cluster that ``local`` starts, which listens on the loopback interface only.
        gpu: Whether that cluster may use this machine's GPUs.

    Raises:
        UserError: no cluster answers, or it refuses this Python, this Ray or this user.
    """
    check_address(address)
    prepare()
    if address == "local":
        # Meant for other systems, this variable makes every part of Ray use 127.0.0.1.
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
        limits = {} if gpu else {"num_gpus": 0}
        more = {"num_cpus": cpus, "include_dashboard": False, "object_store_memory": STORE_BYTES, **limits}
    else:
        more = {}
        _ask(address)
    try:
        ray = _init(address, **more)
    except Exception as error:
        raise UserError(f"--ray {address}: {last_error_line(str(error))}; {START_HINT}") from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _ask(address: str) -> None:
    """Connect to ``address`` in a process of its own, which can be ended.

    Raises:
        UserError: no cluster answers.
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
            f"--ray {address}: no Ray cluster answered within {ANSWER_SECONDS:.0f} s; {START_HINT}; from a machine "
            "outside the cluster, give ray://HOST:10001"
        ) from error
    if answer.returncode != 0:
        raise UserError(f"--ray {address}: {last_error_line(answer.stderr)}; {START_HINT}")


def last_error_line(text: str) -> str:
    """Return the last line that is not blank, which in a traceback is the error."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return re.sub(r"^[\w.]+Error: ", "", lines[-1]) if lines else "Ray gave no reason"


class HeadMonitor:
    """Monitor of the cluster's head node. Connections from outside (``ray://``) are not monitored, since they end with
    the head node."""

    def __init__(self, ray: Any, address: str) -> None:
        self.address = address
        self._address_of_head = None if address.startswith("ray://") else str(ray.get_runtime_context().gcs_address)
        self._answered = self._asked = time.monotonic()

    def check(self) -> None:
        """Ask the head node for an answer every ``PULSE_SECONDS``; call this often.

        Raises:
            UserError: the head node did not answer for ``GONE_SECONDS``.
        """
        now = time.monotonic()
        if self._address_of_head is None or now - self._asked < PULSE_SECONDS:
            return
        host, _, port = self._address_of_head.rpartition(":")
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
    """List the machines that are alive."""
    alive = []
    for node in ray.nodes():
        if node["Alive"]:
            has = node["Resources"]
            name = f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
            alive.append(Machine(node["NodeID"], name, has.get("CPU", 0.0), has.get("GPU", 0.0)))
    return alive


def usable_machines(candidates: Sequence[Machine], cuda: bool) -> list[Machine]:
    """Return the machines that can train a cell; a head node often offers no processors and is left out.

    Raises:
        UserError: there are none.
    """
    useful = [machine for machine in candidates if machine.cpus >= 1 and (machine.gpus >= 1 or not cuda)]
    if not useful:
        lacks = "a GPU and a CPU to give; take --device cpu, or add one" if cuda else "CPUs to give; add one"
        raise UserError(
            f"--ray: none of the cluster's {len(candidates)} machines has {lacks} with 'ray start --address'"
        )
    return useful


def threads_of_a_cell(useful: Sequence[Machine], jobs: int, threads: int | None, cuda: bool) -> int:
    """Compute the threads of one cell so that ``jobs`` cells fit on every machine; larger machines then run more cells.

    Args:
        threads: CPU threads of all cells on a machine together; by default all that the machine offers.
    """
    shares = []
    for machine in useful:
        total = min(threads or int(machine.cpus), int(machine.cpus))
        shares.append(total // max(jobs, int(machine.gpus) if cuda else 1))
    return max(1, min(shares))


def cells_at_a_time(useful: Sequence[Machine], threads: int, cuda: bool) -> int:
    """Count the cells that all machines together can run at a time."""
    return sum(int(min(m.cpus // threads, m.gpus if cuda else m.cpus)) for m in useful)


if __name__ == "__main__":
    prepare()
    _init(sys.argv[1]).shutdown()
