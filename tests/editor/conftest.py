"""A browser, and the editor with a figure in it, for the tests that drive its page."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from helpers.chromium import chromium
from helpers.edit_scenes import figure_scene
from helpers.editor_windows import serve
from helpers.studios import Page
from scgs_warp.editor import Editor
from scgs_warp.scene.scene import Scene


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def figure() -> Scene:
    return figure_scene(nodes=200, points=4000)[0]


@pytest.fixture
def editor(figure, tmp_path) -> Iterator[Editor]:
    made = serve(figure, tmp_path)
    yield made
    made.stop()


@pytest.fixture
def page(editor) -> Iterator[Page]:
    """A page of the test's own ``editor``."""
    made = Page(editor)
    yield made
    made.close()
