"""A browser window with the editor in it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from scgs_warp.edit import EditSession
from scgs_warp.editor import Editor
from scgs_warp.editor.autosave import Autosave
from scgs_warp.scene.scene import Scene

PATIENCE = 120.0
SIZE = {"width": 900, "height": 700}


def until(condition: Callable[[], Any]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


def serve(scene: Scene, folder: Any) -> Editor:
    session = EditSession(scene)
    session.parts()
    keeper = Autosave(session, folder)
    keeper.start(restore=True)
    return Editor(session, folder, title="figure", port=0, autosave=keeper)


class Window:
    """One window with the editor in it."""

    def __init__(self, browser: Any, editor: Editor, query: str = "", size: dict[str, int] = SIZE, **kind: Any) -> None:
        self.editor, self.problems = editor, []
        self.context = browser.new_context(viewport=size, **kind)
        self.page = self.context.new_page()
        self.page.set_default_timeout(1e3 * PATIENCE)
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("console", lambda m: self.problems.append(m.text) if m.type == "error" else None)
        self.page.goto(editor.url + query)
        self.page.evaluate("window.scgs.ready.then(() => 1)")

    def ask(self, expression: str, argument: Any = None) -> Any:
        """Value of an expression in ``player``, ``clock``, ``studio`` and ``argument``."""
        return self.page.evaluate(
            f"(argument) => window.scgs.ready.then(({{ player, clock, studio }}) => ({expression}))", argument
        )

    def still(self) -> None:
        def settled() -> bool:
            idle = "!player.stale && !player.unsorted && !player.sorting && !player.moving && !player.tools.drag"
            return self.editor.worker.idle and self.ask(f"{idle} && !studio.link.state.dragging")

        until(settled)

    def part_on_screen(self, part: int) -> tuple[float, float]:
        x, y = self.ask(
            """(() => { const { tools } = player, v = player.view(), n = tools.members[argument], s = [0, 0, 0];
            for (const m of n) for (let k = 0; k < 3; k++) s[k] += player.places[3 * m + k] / n.length;
            const [x, y, z] = v.rows.map((r, k) => r[0] * s[0] + r[1] * s[1] + r[2] * s[2] + v.shift[k]);
            const b = player.canvas.getBoundingClientRect(), { width, height } = player.canvas;
            return [(v.lens[0] * x / z + v.lens[2]) * b.width / width + b.left,
              (v.lens[1] * y / z + v.lens[3]) * b.height / height + b.top]; })()""",
            part,
        )
        return x, y

    def on_screen(self, place: Any) -> tuple[float, float]:
        """Where the page shows a place, [3] world units."""
        x, y = self.ask(
            """(() => { const { centre, scale } = player.model.facts.normalisation, v = player.view();
            const p = argument.map((value, k) => (value - centre[k]) * scale), { width, height } = player.canvas;
            const [x, y, z] = v.rows.map((r, k) => r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + v.shift[k]);
            const b = player.canvas.getBoundingClientRect();
            return [(v.lens[0] * x / z + v.lens[2]) * b.width / width + b.left,
              (v.lens[1] * y / z + v.lens[3]) * b.height / height + b.top]; })()""",
            [float(value) for value in place],
        )
        return x, y

    def lowest_limb(self) -> int:
        """The foot that nothing hides."""
        session = self.editor.session
        names = [part.name for part in session.parts()]
        found = []
        for name in names:
            x, y = self.part_on_screen(names.index(name))
            event = {"clientX": x, "clientY": y}
            seen = self.ask(
                "(() => { const p = player.tools.surface(argument); return p ? player.tools.nearest(p) : -1; })()",
                event,
            )
            if len(session.chain(name)) > 1 and seen in session.skeleton.part(name).nodes:
                found.append((y, names.index(name)))
        return max(found)[1]

    def drag(self, start: tuple[float, float], shift: tuple[float, float]) -> None:
        mouse = self.page.mouse
        mouse.move(*start)
        mouse.down()
        mouse.move(start[0] + shift[0], start[1] + shift[1], steps=5)
        mouse.up()
        self.still()

    def close(self) -> None:
        assert self.problems == []
        self.context.close()

    def choose_limb(self) -> tuple[str, tuple[float, float]]:
        """Click on the lowest limb; return its name and where it was clicked."""
        part = self.lowest_limb()
        name, place = self.editor.session.parts()[part].name, self.part_on_screen(part)
        self.page.mouse.click(*place)
        until(lambda: self.ask("studio.link.state.part") == name)
        return name, place

    def rings(self, *steps: int) -> list[tuple[float, float]]:
        """Where the pivot of the rings is on the screen, and points of the first ring, by their numbers."""
        found = self.ask(
            """(() => { const g = player.tools.gizmo, b = player.canvas.getBoundingClientRect();
            return [g.pivot, ...argument.map((k) => g.ring(0)[k])].map((point) => {
              const [x, y] = g.seen(point); return [x + b.left, y + b.top]; }); })()""",
            list(steps),
        )
        return [(x, y) for x, y in found]
