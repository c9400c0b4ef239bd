"""Marks for figures: where a figure comes from, and whether the code that it measures has changed since."""

from __future__ import annotations

import functools
import json
import re
import subprocess
from collections.abc import Iterable
from pathlib import Path

from markdown_table import table

ROOT = Path(__file__).resolve().parent.parent
REPORTED, OLDER = "†", "‡"
RENDERING = (
    *("kernels", "scgs_warp/ops", "scgs_warp/runtime", "scgs_warp/geometry", "scgs_warp/rendering", "scgs_warp/motion"),
    *("scgs_warp/scene", "scgs_warp/gaussians.py", "scgs_warp/types.py"),
)
TRAINING = (
    *(*RENDERING, "scgs_warp/training", "scgs_warp/data", "scgs_warp/config", "scgs_warp/evaluation"),
    *("scgs_warp/optim.py", "scgs_warp/seeding.py"),
)
MESHES = (*RENDERING, "scgs_warp/export/mesh")
EDITING = (*RENDERING, "scgs_warp/edit", "scgs_warp/editor")


@functools.cache
def changed_since(commit: str | None, paths: tuple[str, ...]) -> bool:
    """Tell whether a commit after ``commit`` touched ``paths``; False without git, and for a shallow clone's gaps.

    A result that was measured with uncommitted changes (``COMMIT-dirty``) counts as changed.

    Raises:
        ValueError: the repository has its whole history, and ``commit`` is not in it.
    """
    if commit is None:
        return False
    if commit.endswith("-dirty"):
        return True
    if _git("rev-parse", "--is-shallow-repository") != "false":
        return False
    if _git("merge-base", "--is-ancestor", commit, "HEAD") is None:
        raise ValueError(f"a result names commit {commit}, which is not in the history: measure it again")
    return bool(_git("log", "-1", "--format=%h", f"{commit}..HEAD", "--", *paths))


def _git(*words: str) -> str | None:
    """Return what a git command prints; None where it fails."""
    try:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def reported_note(commits: Iterable[str]) -> str:
    """Write the legend of the mark ``REPORTED``; return an empty text if there are no commits."""
    names = ", ".join(dict.fromkeys(commit[:7] for commit in commits))
    return (
        f"{REPORTED} First reported in commit {names}; the repository holds no result file for these values."
        if names
        else ""
    )


def older_note(commits: Iterable[str]) -> str:
    """Write the legend of the mark ``OLDER``; return an empty text if there are no commits."""
    names = ", ".join(dict.fromkeys(commit[:7] for commit in commits))
    return f"{OLDER} Measured at commit {names}; the measured code has changed since." if names else ""


def without_older_marks(page: str) -> str:
    """Remove the marks that depend on the history of the repository, so that only figures are compared."""
    return re.sub(rf"\n*^{OLDER} .*$", "", page, flags=re.MULTILINE).replace(f" {OLDER}", "")


def reported_table(path: Path) -> str:
    """Write a table as it was reported.

    Its file holds ``commit``, ``head`` and ``rows``, each with ``cells`` and, if it differs, its ``commit``.
    """
    values = json.loads(path.read_text(encoding="utf-8"))
    lines = [[f"{row['cells'][0]} {REPORTED}".strip(), *row["cells"][1:]] for row in values["rows"]]
    commits = [row.get("commit", values["commit"]) for row in values["rows"]]
    return f"{table(values['head'], lines, numbers=False)}\n\n{reported_note(commits)}"
