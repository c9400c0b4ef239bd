"""The page that the benchmark of ``--live`` opens."""

from __future__ import annotations

import time

import pytest

from helpers.scripts import benchmark_script
from scgs_warp.errors import UserError
from scgs_warp.export.page_data import pack
from scgs_warp.live.viewer import SceneView

pytest.importorskip("aiohttp")


def test_the_page_fetches_every_scene_and_says_when_it_was_closed():
    """A page that fetches nothing would make ``--live`` look free of cost."""
    live_cost = benchmark_script("live_cost")
    with SceneView("training") as view:
        page = live_cost.Follower(view.server.url)
        for number in (1, 2):
            view.publish(pack({"gaussians": 10 * number}, []), f"step {number}")
            end = time.monotonic() + 60
            while page.scenes < number:  # a loaded machine may take longer to tell than the page waits to be told
                page.settle()
                assert time.monotonic() < end
            assert (page.scenes, page.gaussians) == (number, 10 * number)
        assert view.wanted.is_set()
    page._thread.join(10)
    with pytest.raises(UserError, match="the page was closed"):
        page.settle()


def test_the_page_fetches_a_scene_once_even_if_it_is_told_of_it_twice():
    """A page that comes just when a scene is published hears of it by the greeting and by the broadcast."""
    live_cost = benchmark_script("live_cost")
    with SceneView("training") as view:
        view.publish(pack({"gaussians": 10}, []), "step 1")
        page = live_cost.Follower(view.server.url)
        view.say("step 1")
        for number in (1, 2, 3):
            if number > 1:  # a page that is late fetches only the last of several scenes
                view.publish(pack({"gaussians": 10}, []), f"step {number}")
                view.say(f"step {number}, again")
            end = time.monotonic() + 60
            while page.scenes < number:
                page.settle()
                assert time.monotonic() < end
            time.sleep(0.3)
            assert page.scenes == number
