"""The pytest plugin: loads the device before torch, and runs the tests that a GPU would run."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(TESTS))  # as pytest's pythonpath does, but early enough

import pretended_cuda.device  # noqa: E402, F401
from pretended_cuda import warp_device  # noqa: E402

LEAST_TESTS = 1_000
"""Number of tests below which a run of the whole suite fails: somebody has lost them."""
FOR_CUDA = ("pretended_cuda", "kernels/cuda", "runtime/test_cuda_launch.py")
"""Folders and files of tests that choose the device themselves."""
REFUSED: dict[str, str] = {}
"""Tests that the device cannot run, by the beginning of their name, and why."""


def _needs_gpu(item: pytest.Item) -> bool:
    path = item.path.relative_to(TESTS).as_posix()
    if path.startswith(FOR_CUDA):
        return True
    call = getattr(item, "callspec", None)
    return call is not None and call.params.get("device") == "cuda"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    wanted = [item for item in items if _needs_gpu(item)]
    config.hook.pytest_deselected(items=[item for item in items if not _needs_gpu(item)])
    items[:] = wanted
    for item in items:
        for start, reason in REFUSED.items():
            if item.nodeid.startswith(start):
                item.add_marker(pytest.mark.skip(reason=f"not on the pretended device: {reason}"))
    whole = not config.option.keyword and config.args == config.getini("testpaths")
    if whole and len(items) < LEAST_TESTS:
        raise pytest.UsageError(f"{len(items)} tests for the pretended device; at least {LEAST_TESTS} are known")


@pytest.fixture(autouse=True)
def _form_of_compositing(request: pytest.FixtureRequest):
    """Take the portable form of compositing in whole training runs."""
    warp_device.native_bodies = "training" not in Path(str(request.node.path)).parts
    yield
    warp_device.native_bodies = True
