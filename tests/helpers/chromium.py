"""A real browser for tests: Chromium without a window, its WebGL in software. Tests that need it
are skipped where Playwright or a browser is missing."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = [
    "--no-sandbox",  # tests run as root in containers
    "--headless=new",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


def find() -> str | None:
    """Return the browser's program: the value of CHROMIUM, else one on the path."""
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)


@contextmanager
def chromium() -> Iterator[Any]:
    """Playwright's browser; skips the test where there is none."""
    api = pytest.importorskip("playwright.sync_api", reason="the package playwright is not installed")
    program = find()
    if program is None:
        pytest.skip("no Chromium on the path; install one, or name it in CHROMIUM")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()


def lose_context(page: Any) -> None:
    """Take the graphics device from a page that shows a scene, as drivers do, and wait until the page knows."""
    _change_context(page, "lost", "loseContext")


def restore_context(page: Any) -> None:
    _change_context(page, "restored", "restoreContext")


def _change_context(page: Any, event: str, call: str) -> None:
    page.evaluate(
        """([event, call]) => window.scgs.ready.then(({ player }) => new Promise((done) => {
          window.lose ??= player.gl.getExtension("WEBGL_lose_context");
          player.canvas.addEventListener(`webglcontext${event}`, () => done(), { once: true });
          window.lose[call]();
        }))""",
        [event, call],
    )
