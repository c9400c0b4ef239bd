"""Replay of a newcomer's first hour: install, train, own data in every layout, film, edit, export, and sixty mistakes.

    python tests/newcomer/hour.py                    # with the installed package
    python tests/newcomer/hour.py --install          # clone, virtual environment and installation first
    python tests/newcomer/hour.py --only mistakes    # data, film, edit, export, mistakes ...

Every command runs as a process of its own, in a new folder. Each answer is judged: exit status, what it says, one line
for a refusal, no traceback, and that nothing was lost. The exit status is 1 if any answer is wrong.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

TESTS = Path(__file__).resolve().parent.parent
ROOT = TESTS.parent
sys.path[:0] = [str(TESTS)]

from newcomer import places  # noqa: E402
from newcomer.judge import Answer, fingerprints, judge  # noqa: E402
from newcomer.mistakes import DONE, MISTAKES, Mistake  # noqa: E402
from newcomer.steps import CHAPTERS, Step, prepare  # noqa: E402

LONGEST = 1_800
"""Seconds that a command may take."""


def run(python: Path, command: str, place: Path) -> Answer:
    """Run ``scgs-warp COMMAND`` in a folder."""
    words = shlex.split(command.format(tiny=places.TINY))
    environ = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "120"}
    arguments = [str(python), "-m", "scgs_warp", *words]
    done = subprocess.run(arguments, cwd=place, env=environ, capture_output=True, text=True, timeout=LONGEST)
    return Answer(done.returncode, done.stdout, done.stderr)


def install(folder: Path) -> Path:
    """Clone the repository, install it into a new virtual environment, and return its Python."""
    clone, environment = folder / "scgs_warp", folder / "venv"
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
    subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
    python = environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    subprocess.run([str(python), "-m", "pip", "install", "--quiet", "-e", f"{clone}[edit,gltf]"], check=True)
    return python


def judge_step(python: Path, step: Step, place: Path) -> list[str]:
    """Run a step and return what is wrong with its answer."""
    began = fingerprints(place)
    answer = run(python, step.command, place)
    expected = Mistake(step.name, step.name, step.command, DONE, step.says, may_change=step.may_change)
    faults = judge(expected, answer, began, fingerprints(place))
    faults += [f"{name} is missing or empty" for name in step.writes if not _holds_something(place / name)]
    if faults and answer.err:
        faults.append(answer.err.strip().splitlines()[-1][:200])
    return faults


def _holds_something(path: Path) -> bool:
    return any(path.iterdir()) if path.is_dir() else path.is_file() and path.stat().st_size > 0


def judge_mistake(python: Path, mistake: Mistake, template: Path, place: Path) -> list[str]:
    """Make a mistake in a copy of the template, and return what is wrong with the answer."""
    shutil.copytree(template, place)
    places.settle(place)
    getattr(places, mistake.given)(place)
    before = fingerprints(place)
    answer = run(python, mistake.command, place)
    return judge(mistake, answer, before, fingerprints(place))


def replay(python: Path, folder: Path, chapters: list[str], jobs: int) -> Iterator[tuple[str, str, list[str], float]]:
    """Replay the chapters; yield the chapter, the name, the faults and the seconds of each answer."""
    place = folder / "work"
    prepare(place)
    for chapter, steps in CHAPTERS.items():
        if chapter in chapters or chapter == "start":
            for step in steps:
                began = time.monotonic()
                yield chapter, step.name, judge_step(python, step, place), time.monotonic() - began
    if "mistakes" not in chapters:
        return
    template = folder / "template"
    places.write_data(template)
    made = run(python, "train --data data/blobs --output runs/blobs {tiny} --steps 60", template)
    yield "mistakes", "template", [] if made.status == DONE else [made.err[-200:]], 0.0
    with ThreadPoolExecutor(jobs) as pool:

        def make(mistake: Mistake) -> tuple[list[str], float]:
            began = time.monotonic()
            return judge_mistake(python, mistake, template, folder / mistake.name), time.monotonic() - began

        for mistake, (faults, seconds) in zip(MISTAKES, pool.map(make, MISTAKES)):
            yield "mistakes", mistake.name, faults, seconds


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [*CHAPTERS, "mistakes"]
    parser.add_argument("--install", action="store_true", help="clone and install into a new environment first")
    parser.add_argument("--only", nargs="+", choices=names, default=names, help="chapters to replay")
    parser.add_argument("--jobs", type=int, default=2, help="mistakes made at the same time")
    parser.add_argument("--json", type=Path, help="file for the judgements")
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        python = install(folder) if options.install else Path(sys.executable)
        for chapter, title, faults, seconds in replay(python, folder, options.only, options.jobs):
            print(
                f"{'wrong' if faults else 'right'}  {chapter:9} {title:20} {seconds:6.1f} s  {'; '.join(faults)}",
                flush=True,
            )
            rows.append({"chapter": chapter, "name": title, "faults": faults, "seconds": round(seconds, 1)})
    wrong = [row["name"] for row in rows if row["faults"]]
    print(f"{len(rows) - len(wrong)} of {len(rows)} right")
    if options.json is not None:
        options.json.write_text(json.dumps({"right": len(rows) - len(wrong), "of": len(rows), "rows": rows}, indent=1))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
