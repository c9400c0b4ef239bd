"""Measure a shared page of many Gaussians in Chromium with WebGL in software: loading, and frames.

    python benchmarks/page_frames.py                        # a million Gaussians that move, a window of 400 x 400
    python benchmarks/page_frames.py --gaussians 100000 --json page.json

Seconds of a view are processor time of all of the browser's processes; those of loading are by the clock. A change of
the view draws two frames: at once with the order of the Gaussians that is known, then in the right order.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from provenance import ROOT

sys.path.insert(0, str(ROOT / "tests"))

from helpers.chromium import FLAGS, find
from scgs_warp.apps.cli import prepare
from scgs_warp.apps.cli import run as run_app
from scgs_warp.benchmark.scenes import synthetic_scene
from scgs_warp.errors import UserError
from scgs_warp.export.page import write_page
from scgs_warp.runtime.provenance import command_line, provenance

PATIENCE = 1800.0
"""Seconds to wait for a picture."""
SCRIPT = Path(__file__).with_suffix(".js")
"""Functions that run in the page, as ``measured``."""


def browser_seconds() -> float:
    """Return the processor time of this process's descendants so far."""
    parents, times = dict[int, int](), dict[int, float]()
    for entry in Path("/proc").iterdir():
        try:
            words = (entry / "stat").read_text().rpartition(")")[2].split() if entry.name.isdigit() else []
        except OSError:  # it has ended
            continue
        if words:
            parents[int(entry.name)], times[int(entry.name)] = int(words[1]), float(words[11]) + float(words[12])
    ours, found = {os.getpid()}, True
    while found:
        found = {child for child, parent in parents.items() if parent in ours} - ours
        ours |= found
    return sum(times[child] for child in ours - {os.getpid()}) / os.sysconf("SC_CLK_TCK")


def wait(page: Any, condition: str) -> None:
    """Wait for an expression of the page. The page itself may evaluate none."""
    end = time.monotonic() + PATIENCE
    while not page.evaluate(condition):
        if time.monotonic() > end:
            raise UserError(f"no picture after {PATIENCE:.0f} seconds")
        time.sleep(0.05)


def complete(page: Any) -> None:
    """Wait until the picture is complete."""
    wait(page, "measured.idle()")
    page.evaluate("measured.finish()")


def turn(page: Any) -> tuple[float, int]:
    """Turn the view; return the seconds until its picture is complete, and the number of frames drawn for it."""
    seconds, frames = browser_seconds(), page.evaluate("player.frames")
    page.evaluate("measured.turn()")
    complete(page)
    return browser_seconds() - seconds, page.evaluate("player.frames") - frames


def visit(path: Path, size: int, views: int) -> dict[str, Any]:
    """Open a page with its time stopped, and turn the view some times."""
    from playwright.sync_api import sync_playwright

    program = find()
    if program is None:
        raise UserError("no Chromium on the path; install one, or name it in CHROMIUM")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        page = browser.new_context(viewport={"width": size, "height": size}).new_page()
        page.set_default_timeout(1e3 * PATIENCE)
        page.add_init_script(path=SCRIPT)
        began = time.monotonic()
        page.goto(path.as_uri() + "?paused", wait_until="commit")
        wait(page, "Boolean(window.player)")
        loaded = time.monotonic() - began
        complete(page)
        first = time.monotonic() - began
        said, share = page.evaluate("window.said"), page.evaluate("measured.shareDrawn()")
        complete(page)
        turns, version = [turn(page) for _ in range(views)], browser.version
        browser.close()
    return {
        "browser": f"Chromium {version}",
        "load_s": round(loaded, 1),
        "first_picture_s": round(first, 1),
        "progress_steps": sum(text.startswith("Loading") for text in said),
        "share_drawn": round(share, 3),
        "cpu_s_per_view": round(statistics.median(seconds for seconds, _ in turns), 2),
        "frames_per_view": statistics.median(frames for _, frames in turns),
    }


def main(arguments: list[str] | None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, usual in (("gaussians", 1_000_000), ("nodes", 512), ("size", 400), ("views", 5)):
        parser.add_argument(f"--{name}", type=int, default=usual)
    parser.add_argument("--motion", choices=("control-points", "static"), default="control-points")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    device = prepare("cpu", None)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "page.html"
        write_page(synthetic_scene(options.motion, options.gaussians, options.nodes, device), path)
        result = {
            "command": command_line("benchmarks/page_frames.py", sys.argv[1:] if arguments is None else arguments),
            "gaussians": options.gaussians,
            "motion": options.motion,
            "size": options.size,
            "file_mib": round(path.stat().st_size / 2**20, 1),
            **visit(path, options.size, options.views),
            **provenance(device),
        }
    print(json.dumps(result, indent=1))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(run_app(main))
