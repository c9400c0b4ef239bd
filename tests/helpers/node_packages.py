"""Node packages of others, which read what we export or check our pages: looked for in the folder that SCGS_NODE names,
in .node beside the sources (where .ci/run puts them), and among node's global packages. Tests are skipped, with the
reason, where node or a package is missing."""

from __future__ import annotations

import functools
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from helpers.paths import ROOT

SPLAT_TRANSFORM = "@playcanvas/splat-transform"
INSTALL = "npm install --prefix .node @playcanvas/splat-transform gltf-validator three axe-core"
"""Command that installs the packages, as in .ci/run."""


@functools.cache
def _folders() -> list[Path]:
    places = [os.environ.get("SCGS_NODE", ""), str(ROOT / ".node")]
    folders = [Path(place) / "node_modules" for place in places if place]
    if npm := shutil.which("npm"):
        done = subprocess.run([npm, "root", "-g"], capture_output=True, text=True, timeout=120, check=False)
        folders += [Path(done.stdout.strip())] if done.stdout.strip() else []
    return folders


def package(name: str) -> Path:
    """The folder of a node package."""
    for folder in _folders():
        if (folder / name / "package.json").is_file():
            return folder / name
    pytest.skip(f"no node package {name}; {INSTALL}, or name a folder with it in SCGS_NODE")


def node(*arguments: str | Path) -> str:
    """Run node and return what it prints."""
    program = shutil.which("node")
    if program is None:
        pytest.skip("node is not installed")
    done = subprocess.run(
        [program, *map(str, arguments)], capture_output=True, text=True, timeout=300, check=False
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:] or done.stdout[-2000:]
    return done.stdout


def splat_transform(source: Path, target: Path, *options: str) -> Path:
    """Convert a file by splat-transform."""
    program = package(SPLAT_TRANSFORM) / "bin" / "cli.mjs"
    node(program, "-q", "-w", source, target, *options)
    return target


def version_of(folder: Path) -> tuple[int, ...]:
    """The version of a node package, by its folder."""
    text = json.loads((folder / "package.json").read_text(encoding="utf-8"))["version"]
    return tuple(int(part) for part in text.split("-")[0].split("."))


def gltf_errors(path: Path) -> list[dict]:
    """Return the errors and warnings of the Khronos validator."""
    script = (
        "const [place, file] = process.argv.slice(1);"
        "const bytes = new Uint8Array(require('fs').readFileSync(file));"
        "require(place).validateBytes(bytes, { maxIssues: 0 })"
        ".then(report => console.log(JSON.stringify(report.issues.messages)));"
    )
    found = json.loads(node("-e", script, package("gltf-validator"), path))
    return [message for message in found if message["severity"] < 2]
