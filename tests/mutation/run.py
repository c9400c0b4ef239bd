"""Run the tests on every mutant, in a copy of the repository: ``python tests/mutation/run.py --changed main``.

Each mutant is written into the copy, its tests run in a child process until the first failure, and the file is
restored. A mutant is killed if a test fails, the process crashes, or the tests take much longer than without it; it
survives if they all pass. The checkout is never changed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from mutation.mutants import Mutant, read_all  # noqa: E402

SLOWDOWN, PATIENCE = 5.0, 60.0
"""A mutant is killed by time after ``SLOWDOWN`` times what its tests take without it, and ``PATIENCE`` seconds more."""
VERDICTS = ("killed", "survived", "unknown")
LINKS = ("kernels", "apps")
"""Folders that belong to the package under another path: in the copy, links stand for them."""


def git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def make_copy(folder: Path) -> None:
    """Copy the files of the checkout, changed ones included, without build outputs."""
    for name in git("ls-files", "--cached", "--others", "--exclude-standard").splitlines():
        source = ROOT / name
        if source.is_file():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target)
    for name in LINKS:
        (folder / "scgs_warp" / name).symlink_to(Path("..") / name)


def prepare(copy: Path, kernels: Path) -> None:
    """Set up the process from which the tests of every mutant are forked: the copy comes first on every path, large
    packages are loaded once, and kernels that are compiled already are taken over."""
    usual = Path(os.environ.get("WARP_CACHE_PATH", Path.home() / ".cache/warp"))
    if usual.is_dir():
        shutil.copytree(usual, kernels)
    os.environ["PYTHONPATH"] = os.pathsep.join([str(copy), str(copy / "tests")])
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"  # the time stamps of two mutants may be the same
    os.environ["WARP_CACHE_PATH"] = str(kernels)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.dont_write_bytecode = True
    sys.path[:] = [str(copy), str(copy / "tests"), *(p for p in sys.path if p not in (str(ROOT), str(ROOT / "tests")))]
    os.chdir(copy)
    # Under another name, since mutants are imported as scgs_warp.
    for name, folder in (("original", "scgs_warp"), ("original.runtime", "scgs_warp/runtime")):
        sys.modules[name] = package = types.ModuleType(name)
        package.__path__ = [str(copy / folder)]
    importlib.import_module("original.runtime.environment").prepare_environment()
    import _pytest.assertion.rewrite
    import cv2  # noqa: F401
    import hypothesis  # noqa: F401
    import pytest
    import scipy.sparse.linalg  # noqa: F401
    import torch  # noqa: F401
    import warp  # noqa: F401

    assert pytest is not None and _pytest is not None
    sys.modules.pop("mutation", None)
    sys.modules.pop("mutation.mutants", None)


def in_child(work: Callable[[], int], log: Path, seconds: float) -> tuple[str, int]:
    """Run ``work`` in a forked process with its output in ``log``.

    Returns:
        How it ended (``status``, ``signal`` or ``time``), and the number of the status or signal.
    """
    child = os.fork()
    if child == 0:
        os.setsid()
        number = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(number, 1)
        os.dup2(number, 2)
        status = 99
        try:
            status = work()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, how = os.waitpid(child, os.WNOHANG)
        if done:
            return ("signal", os.WTERMSIG(how)) if os.WIFSIGNALED(how) else ("status", os.WEXITSTATUS(how))
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "time", 0


def run_tests(copy: Path, tests: tuple[str, ...]) -> int:
    """Run tests of the copy until the first failure."""
    import pytest

    import scgs_warp
    import scgs_warp.kernels

    for package in (scgs_warp, scgs_warp.kernels):
        assert str(package.__file__).startswith(str(copy)), f"{package.__file__} is not of the copy"
    options = ["-x", "-q", "-n", "0", "--no-header", "-p", "no:cacheprovider", "-p", "no:randomly"]
    return int(pytest.main([*options, *tests]))


@contextmanager
def mutated(copy: Path, mutant: Mutant) -> Iterator[int]:
    """Apply a mutant to the copy; give the number of its line."""
    path = copy / mutant.file
    text = path.read_text(encoding="utf-8")
    path.write_text(mutant.apply(text), encoding="utf-8")
    try:
        yield mutant.line(text)
    finally:
        path.write_text(text, encoding="utf-8")


def judge(ended: str, number: int, log: str) -> tuple[str, str]:
    """Return the verdict on a mutant, and the test or the event that killed it."""
    if ended == "time":
        return "killed", "time"
    if ended == "signal":
        return "killed", f"signal {number}"
    if number == 0:
        return "survived", ""
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", log, re.M)
    if number in (1, 2) and failed:
        return "killed", failed[1]
    return "unknown", f"status {number}"


def chosen(options: argparse.Namespace) -> list[Mutant]:
    """Return the mutants that the options ask for."""
    mutants = read_all()
    if options.changed is not None:
        base = git("merge-base", options.changed, "HEAD")
        files = {*git("diff", "--name-only", base).splitlines()}
        mutants = [m for m in mutants if m.file in files or files.intersection(m.tests)]
    if options.only:
        mutants = [m for m in mutants if any(part in m.name for part in options.only)]
    return mutants


def read_results(path: Path | None) -> dict[str, dict[str, Any]]:
    if path is None or not path.is_file():
        return {}
    return {row["mutant"]: row for row in json.loads(path.read_text(encoding="utf-8"))["results"]}


def write_results(path: Path | None, rows: dict[str, dict[str, Any]]) -> None:
    """Write the results of all mutants that still are in the lists, in their order."""
    if path is None:
        return
    listed = [rows[mutant.name] for mutant in read_all() if mutant.name in rows]
    counts = {
        verdict: sum(row["verdict"] == verdict for row in listed) for verdict in ("killed", "survived", "unknown")
    }
    content = {"mutants": len(read_all()), "run": len(listed), **counts, "results": listed}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


class Bench:
    """A copy of the repository on which mutants are tried one by one."""

    def __init__(self, folder: Path) -> None:
        self.copy, self._log = folder.resolve() / "copy", folder / "log"
        make_copy(self.copy)
        prepare(self.copy, folder / "kernels")
        self._usual: dict[tuple[str, ...], float] = {}

    def _run(self, tests: tuple[str, ...], seconds: float) -> tuple[str, int]:
        return in_child(lambda: run_tests(self.copy, tests), self._log, seconds)

    def _log_text(self) -> str:
        return self._log.read_text(encoding="utf-8", errors="replace")

    def try_mutant(self, mutant: Mutant) -> dict[str, Any]:
        """Run the tests of a mutant, at first without it. Tests that fail without it say nothing about it."""
        if mutant.tests not in self._usual:
            start, sound = time.monotonic(), self._run(mutant.tests, 3600) == ("status", 0)
            self._usual[mutant.tests] = time.monotonic() - start if sound else math.inf
            if not sound:
                print(f"{' '.join(mutant.tests)}: fails without any mutant\n{self._log_text()[-2000:]}")
        if self._usual[mutant.tests] == math.inf:
            line = mutant.line((self.copy / mutant.file).read_text(encoding="utf-8"))
            return {"mutant": mutant.name, "line": line, "verdict": "unknown", "by": "its tests fail without it"}
        with mutated(self.copy, mutant) as line:
            ended = self._run(mutant.tests, SLOWDOWN * self._usual[mutant.tests] + PATIENCE)
        verdict, by = judge(*ended, self._log_text())
        row = {"mutant": mutant.name, "line": line, "verdict": verdict, "by": by}
        return row | ({"equivalent": mutant.equivalent} if mutant.equivalent else {})


def main(args: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--changed", metavar="REVISION", help="only mutants whose file or tests changed since then")
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="only mutants whose name contains one of these texts")
    parser.add_argument("--output", type=Path, help="JSON of results; rows of other mutants in it are kept")
    parser.add_argument("--missing", action="store_true", help="only mutants without a result in --output")
    parser.add_argument("--minutes", type=float, default=1e9, help="begin no further mutant after this time")
    options = parser.parse_args(args)
    output = None if options.output is None else options.output.resolve()
    mutants, rows = chosen(options), read_results(output)
    if options.missing:
        mutants = [m for m in mutants if rows.get(m.name, {}).get("verdict") in (None, "unknown")]
    commit, began = git("rev-parse", "--short", "HEAD"), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="scgs-mutation-") as folder:
        bench = Bench(Path(folder))
        for index, mutant in enumerate(mutants):
            if time.monotonic() - began > 60 * options.minutes:
                print(f"{len(mutants) - index} mutants are left")
                break
            start = time.monotonic()
            row = rows[mutant.name] = bench.try_mutant(mutant) | {"commit": commit}
            seconds = time.monotonic() - start
            place = f"{mutant.name}:{row['line']}"
            print(f"{index + 1}/{len(mutants)} {row['verdict']} {place} {row['by']} {seconds:.0f} s", flush=True)
            write_results(output, rows)
    survivors = [m for m in mutants if m.name in rows and rows[m.name]["verdict"] != "killed" and not m.equivalent]
    for mutant in survivors:
        row = rows[mutant.name]
        print(f"\n{mutant.file}:{row['line']} {row['verdict']}\n-{mutant.code}\n+{mutant.wrong}")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
