"""Sessions that several files of tests share."""

from __future__ import annotations

import dataclasses

import pytest

from helpers.edit_scenes import bone_skeleton, figure_scene
from scgs_warp.edit import EditSession


@pytest.fixture(scope="module")
def figure() -> EditSession:
    """A session on the built-in figure whose skeleton is that of its bones."""
    scene, _, _ = figure_scene(256)
    session = EditSession(scene)
    session.edit = dataclasses.replace(session.edit, skeleton=bone_skeleton(scene.motion.bones))
    return session


@pytest.fixture
def session(figure: EditSession) -> EditSession:
    """A fork of ``figure``, to be changed."""
    return figure.fork()
