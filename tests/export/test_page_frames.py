"""What a page draws when, and at which resolution."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from helpers.chromium import chromium
from helpers.edit_scenes import bar_scene
from helpers.page_visits import Visit, until
from scgs_warp.export.page import write_page


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def bar(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("page") / "bar.html"
    write_page(bar_scene(shaded=True), path)
    return path


def screen(visit: Visit) -> np.ndarray:
    until(visit.idle)
    with Image.open(io.BytesIO(visit.page.screenshot())) as image:
        return np.asarray(image.convert("RGB"))


def test_gaussians_are_not_projected_again_for_another_order(browser, bar):
    visit = Visit(browser, bar)
    begin = screen(visit)
    projected = visit.page.evaluate(
        """() => window.scgs.ready.then(({ player: p }) => {
          const { renderer } = p, use = renderer.use, counts = [];
          let count = 0;
          renderer.use = function (program, textures) {
            count += program === renderer.splat ? 1 : 0;
            use.call(renderer, program, textures);
          };
          const draw = () => { p.stale = true; p.frame(); counts.push(count); };
          p.takeOrder(p.order.slice().reverse(), p.amount);
          draw();
          p.takeOrder(p.order.slice().reverse(), p.amount);
          draw();
          p.time = 0.5;
          draw();
          p.orbit.azimuth += 0.1;
          draw();
          p.orbit.azimuth -= 0.1;
          p.time = 0;
          draw();
          delete renderer.use;
          return counts;
        })"""
    )
    assert projected == [0, 0, 1, 2, 3]
    visit.ask("player.changed()")
    assert (begin > 25).mean() > 0.02 and np.array_equal(screen(visit), begin)
    visit.context.close()


@pytest.mark.parametrize("rests", [False, True])
def test_frames_of_seconds_are_one_movement_unless_it_rests(browser, bar, rests):
    """Slow machines draw fewer pixels while something moves, however slow they are."""
    visit = Visit(browser, bar)
    coarse = visit.page.evaluate(
        """(rests) => window.scgs.ready.then(({ player: p }) => {
          Object.assign(p, { coarse: 1, interval: 25 });
          for (let now = 1e7, k = 0; k < 10; k++, now += 4000) {
            p.changed();
            p.tick(now);
            p.stale = false;
            if (rests) p.tick(now + 10);
          }
          return p.coarse;
        })""",
        rests,
    )
    assert coarse == 1 if rests else coarse < 0.8
    visit.context.close()
