"""Validation: every declared bound is kept, and rules between fields are named."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import pytest

from helpers.tiny import tiny_config
from scgs_warp.config import presets as C
from scgs_warp.config.validation import MAGNITUDE, check, check_sizes
from scgs_warp.errors import UserError


def numbers(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and metadata of every field that holds a number."""
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            yield from numbers(value, f"{prefix}{item.name}.")
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            yield f"{prefix}{item.name}", item.metadata


def put(config: Any, name: str, value: float) -> Any:
    """Replace a field by its dotted name, whatever its type."""
    first, _, rest = name.partition(".")
    return dataclasses.replace(config, **{first: put(getattr(config, first), rest, value) if rest else value})


FIELDS = dict(numbers(C.preset("best")))


@pytest.mark.parametrize("name", FIELDS)
def test_no_number_is_too_large_or_nan(name):
    most = FIELDS[name].get("most") or MAGNITUDE
    for value in (most + 1, math.nan, math.inf, -2 * MAGNITUDE):
        with pytest.raises(UserError, match=f"^file: {name} is .*; it must be at most {most:g}".replace("+", r"\+")):
            check_sizes(put(C.preset("best"), name, value), "file: ")


@pytest.mark.parametrize("name", [name for name, bounds in FIELDS.items() if bounds.get("least") is not None])
def test_no_number_is_below_its_bound(name):
    least = FIELDS[name]["least"]
    with pytest.raises(UserError, match=f"^{name} is .*; it must be at least {least}$|skip|frequencies"):
        check(put(C.preset("best"), name, least - 1))


@pytest.mark.parametrize("name", [name for name, bounds in FIELDS.items() if "choices" in bounds])
def test_choices_are_inclusive(name):
    low, high = FIELDS[name]["choices"]
    for value in (low, high):
        check(put(C.preset("best"), name, value))
    for value in (low - 1, high + 1):
        with pytest.raises(UserError, match=f"^{name} is {value}; choose {low} to {high}$"):
            check(put(C.preset("best"), name, value))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("motion.nodes", 4, "--nodes 4: needs at least 5"),
        ("densify.max_gaussians", 99, "--max-gaussians 99: needs at least 100"),
        ("pretrain.steps", 80_000, "steps 40000 leave nothing after 80000 pre-training steps; raise --steps"),
        ("optim.settle", 1.5, "optim.settle is 1.5; it is a share of the run"),
        ("motion.skip", 8, "motion.skip is 8; it must be below motion.layers, 8"),
        ("motion.skip", 0, "motion.skip is 0; choose 1 to 7"),
        ("motion.plane_times", 1, "motion.plane_times is 1; choose 2 to 4096, or 0"),
        ("loss.hexplane_smooth", -1.0, "loss.hexplane_smooth is -1.0; it must be at least 0"),
    ],
)
def test_rules_name_the_field_and_the_remedy(name, value, message):
    with pytest.raises(UserError) as caught:
        check(C.with_field(C.preset("best"), name, value, "test"))
    assert str(caught.value).startswith(message)


def test_a_configuration_that_can_run_comes_back():
    config = tiny_config()
    assert check(config) is config
