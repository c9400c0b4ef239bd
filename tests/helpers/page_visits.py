"""Visits of an exported page in a real browser."""

from __future__ import annotations

import base64
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scgs_warp.types import Camera

PATIENCE = 90.0
SIZE = {"width": 640, "height": 520}
RENDER = """async ([time, viewmat, K, width, height, background]) => {
  const { pixels } = await window.scgs.renderAt(time, viewmat, K, width, height, background);
  let text = "";
  for (let i = 0; i < pixels.length; i += 8192) text += String.fromCharCode(...pixels.subarray(i, i + 8192));
  return btoa(text);
}"""


def until(condition: Callable[[], Any]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


class Visit:
    """One visit of a page; whatever it logs or asks for is kept.

    Args:
        prepare: script that runs before those of the page.
        awaited: whether the page is to be ready at once.
    """

    def __init__(
        self,
        browser: Any,
        path: Path,
        query: str = "?paused",
        *,
        prepare: str = "",
        awaited: bool = True,
        **context: Any,
    ) -> None:
        self.context = browser.new_context(viewport=SIZE, **context)
        self.page = self.context.new_page()
        self.page.set_default_timeout(1e3 * PATIENCE)
        self.problems: list[str] = []
        self.requests: list[str] = []
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("console", lambda m: self.problems.append(m.text) if m.type == "error" else None)
        self.page.on("request", lambda request: self.requests.append(request.url))
        if prepare:
            self.page.add_init_script(prepare)
        self.page.goto(path.as_uri() + query)
        if awaited:
            self.page.evaluate("window.scgs.ready.then(() => 1)")

    def ask(self, expression: str, argument: Any = None) -> Any:
        """Value of an expression in ``player``, ``clock`` and ``argument``."""
        return self.page.evaluate(
            f"(argument) => window.scgs.ready.then(({{ player, clock }}) => ({expression}))", argument
        )

    def idle(self) -> bool:
        return self.ask("!player.stale && !player.unsorted && !player.sorting && !player.moving")

    def render(self, camera: Camera, moment: float, background: tuple[float, ...] = (0, 0, 0)) -> np.ndarray:
        """[H, W, 3] an exact frame."""
        arguments = [moment, camera.viewmat.tolist(), camera.K.tolist(), camera.width, camera.height, [*background]]
        bytes_ = base64.b64decode(self.page.evaluate(RENDER, arguments))
        return np.frombuffer(bytes_, np.uint8).reshape(camera.height, camera.width, 4)[..., :3] / 255


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(((a - b) ** 2).mean()))
