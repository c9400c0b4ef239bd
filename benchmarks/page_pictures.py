"""Draw the docs' pictures of the editor and of an exported page, in Chromium with WebGL in software.

    python benchmarks/page_pictures.py --run runs/figure-quick --output docs/images

``--run`` is a run of the built-in figure. The right hand is pulled up by the mouse (``editor-pull.gif``), the raised
arm gets keyframes (``editor.jpg``), and the page of the unedited run is shown at two times (``page.jpg``).
"""

from __future__ import annotations

import argparse
import io
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from provenance import ROOT

sys.path.insert(0, str(ROOT / "tests"))

from helpers.chromium import chromium
from helpers.editor_windows import Window, serve, until
from scgs_warp.apps.cli import prepare
from scgs_warp.apps.cli import run as run_app
from scgs_warp.export.page import PageOptions, write_page
from scgs_warp.geometry.cameras import orbit_camera
from scgs_warp.scene.scene import Scene

HAND = (-0.43, -0.2, -0.5)
"""Near the right hand at time 0, world units."""
UP, ASIDE = 0.55, 0.12
"""Shares of the figure's height by which the drag moves the pointer."""
STEPS = 22
"""Frames of the film during the drag."""
SIZE = {"width": 1280, "height": 800}
POINTER = [(0, 0), (0, 17), (4, 13), (7, 20), (10, 19), (7, 12), (12, 12)]


def picture(window: Window, pointer: tuple[float, float] | None = None) -> Image.Image:
    """The window as it is, with the mouse's pointer, which screenshots leave out."""
    image = Image.open(io.BytesIO(window.page.screenshot())).convert("RGB")
    if pointer is not None:
        outline = [(pointer[0] + x, pointer[1] + y) for x, y in POINTER]
        ImageDraw.Draw(image).polygon(outline, fill=(255, 255, 255), outline=(0, 0, 0))
    return image


def shown(window: Window) -> None:
    """Wait until what the server knows is drawn; during a drag, too."""
    until(lambda: window.editor.worker.idle and window.ask("!player.stale && !player.unsorted && !player.sorting"))


def film_pull(window: Window) -> list[Image.Image]:
    """Pull the right hand up; return the frames."""
    session, page = window.editor.session, window.page
    places = window.editor.worker.call(lambda: session.node_positions(0.0))
    hand = session.part_at(HAND, 0.0)
    tip = places[min(session.skeleton.part(hand).nodes, key=lambda node: places[node, 2])]
    camera = orbit_camera(session.scene.overview, session.scene.overview.azimuth, 300)
    right, down = camera.viewmat[:2, :3].numpy()
    goal = tip - np.ptp(places[:, 2]) * (UP * down + ASIDE * right)
    (x, y), (end_x, end_y) = window.on_screen(tip), window.on_screen(goal)
    page.mouse.move(x, y)
    until(lambda: window.ask("player.tools.lit") >= 0)
    shown(window)
    frames = [picture(window, (x, y))] * 3
    page.mouse.down()
    for step in range(1, STEPS + 1):
        share = (1 - np.cos(np.pi * step / STEPS)) / 2
        at = x + share * (end_x - x), y + share * (end_y - y)
        page.mouse.move(*at)
        page.wait_for_timeout(150)
        shown(window)
        frames.append(picture(window, at))
    page.mouse.up()
    page.mouse.move(end_x - 150, end_y + 60)
    window.still()
    until(lambda: page.locator("#status").inner_text() == "saved")
    return [*frames, *[picture(window, (end_x - 150, end_y + 60))] * 6]


def keyed(window: Window) -> Image.Image:
    """Key the raised arm, turn it further at other moments, and show tracks, rings and trajectories."""
    page = window.page
    page.keyboard.press("k")
    until(lambda: page.locator(".key").count() > 1)
    window.ask("studio.link.ask('rename_part', { name: studio.link.state.part, to: 'right hand' })")
    until(lambda: window.ask("studio.link.state.part") == "right hand")
    for at, turns in ((1.2, [0, 60, -20]), (2.4, [0, 20, 25])):
        window.ask("player.seek(argument / player.seconds)", at)
        degrees = window.ask("studio.link.state.target.degrees")
        window.ask(
            "studio.link.ask('put', { at: argument[0], degrees: argument[1] })", [at, np.add(degrees, turns).tolist()]
        )
        until(lambda at=at: any(abs(frame.at - at) < 1e-6 for frame in window.editor.session.edit.keyframes))
    page.locator("#view").focus()
    for at, turn in ((0.0, 0.0), (2.4, 0.5)):
        window.ask("(player.seek(argument[0] / player.seconds), player.orbit.turn(argument[1], 0))", [at, turn])
        page.keyboard.press("v")
    until(lambda: page.locator(".key.camera").count() == 2)
    window.ask("(player.orbit.turn(-0.5, 0), player.seek(0), studio.display('ribbons', true))")
    window.ask("studio.link.ask('choose_part', { name: 'right hand' })")
    page.keyboard.press("2")
    page.mouse.move(200, 300)
    page.evaluate("document.querySelectorAll('#panel details').forEach((one, k) => { one.open = k === 3; })")
    page.evaluate("document.activeElement.blur()")
    window.still()
    return picture(window)


def page_twice(browser: Any, scene: Scene, folder: Path) -> Image.Image:
    """The exported page at two times, from two sides."""
    path = folder / "page.html"
    write_page(scene, path, PageOptions("The built-in figure"))
    page = browser.new_page(viewport={"width": 480, "height": 480})
    views = []
    for second, turn in ((0.0, 0.0), (3.0, 1.2)):
        page.goto(f"{path.as_uri()}?paused&t={second}")
        page.evaluate(
            "argument => window.scgs.ready.then(({ player }) => { player.orbit.turn(argument, 0); player.changed(); })",
            turn,
        )
        page.evaluate("window.scgs.ready.then(({ player }) => { window.player = player; })")
        page.wait_for_timeout(1500)
        until(lambda: page.evaluate("!player.stale && !player.unsorted && !player.sorting && !player.moving"))
        views.append(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    sheet = Image.new("RGB", (970, 480), (255, 255, 255))
    for column, view in enumerate(views):
        sheet.paste(view, (490 * column, 0))
    return sheet


def main(arguments: list[str] | None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "images")
    options = parser.parse_args(arguments)
    prepare("cpu", None)
    scene = Scene.load(options.run)
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        page_twice(browser, scene, Path(folder)).save(options.output / "page.jpg", quality=85)
        editor = serve(scene, Path(folder))
        try:
            window = Window(browser, editor, size=SIZE)
            window.still()
            frames = [frame.resize((640, 400), Image.Resampling.LANCZOS) for frame in film_pull(window)]
            colors = frames[len(frames) // 2].quantize(128, dither=Image.Dither.NONE)
            frames = [frame.quantize(palette=colors, dither=Image.Dither.NONE) for frame in frames]
            frames[0].save(
                options.output / "editor-pull.gif",
                save_all=True,
                append_images=frames[1:],
                duration=110,
                loop=0,
                optimize=True,
            )
            keyed(window).save(options.output / "editor.jpg", quality=82)
            window.close()
        finally:
            editor.stop()


if __name__ == "__main__":
    sys.exit(run_app(main))
