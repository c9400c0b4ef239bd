"""Functions that compute as if their caller had not changed torch's settings."""

from __future__ import annotations

import threading

import pytest
import torch

from helpers.torch_settings import SETTINGS, default_dtype
from scgs_warp.runtime.caller_settings import unaffected


@unaffected
def product() -> torch.Tensor:
    """Return a product of matrices."""
    return torch.ones(2, 2) @ torch.ones(2, 2)


@pytest.mark.parametrize("setting", SETTINGS)
def test_settings_of_the_caller_stay_outside(setting):
    with SETTINGS[setting]():
        found, theirs = product(), torch.ones(2, 2) @ torch.ones(2, 2)
    assert found.dtype is torch.float32 and found.device.type == "cpu"
    assert theirs.dtype is not torch.float32 or theirs.device.type == "meta", "the caller's settings are back"
    assert product.__doc__ == "Return a product of matrices."


def test_an_error_gives_the_settings_back():
    @unaffected
    def fails() -> None:
        raise ValueError("as asked")

    with default_dtype():
        with pytest.raises(ValueError, match="as asked"):
            fails()
        assert torch.get_default_dtype() is torch.float64


def test_calls_of_threads_may_overlap():
    """The default type is that of all threads: the call that ends first must not take float32 from the other."""
    begun, overlapping, seen = threading.Event(), threading.Event(), []

    @unaffected
    def first() -> None:
        begun.set()
        overlapping.wait(30)

    @unaffected
    def second() -> None:
        overlapping.set()
        thread.join(30)
        seen.append(torch.ones(1).dtype)

    with default_dtype():
        thread = threading.Thread(target=first)
        thread.start()
        begun.wait(30)
        second()
        assert torch.get_default_dtype() is torch.float64
    assert seen == [torch.float32]


def test_the_compiler_leaves_it_as_it_is():
    compiled = []

    @unaffected
    def doubled(values: torch.Tensor) -> torch.Tensor:
        compiled.append(torch.compiler.is_compiling())
        return 2 * values

    found = torch.compile(lambda values: doubled(values) + 1, backend="eager")(torch.ones(3))
    assert found.tolist() == [3.0, 3.0, 3.0] and compiled == [False]
