"""Validation: every declared bound is kept, and rules between fields are named."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from typing import Any

import pytest

from helpers.paths import ROOT
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
def test_every_number_has_bounds(name):
    """So that ``--set optim.means=-1`` and ``--set loss.ssim=5`` are refused, whatever field is added."""
    bounds = FIELDS[name]
    assert "choices" in bounds or 0 <= bounds["least"] < bounds["most"] <= MAGNITUDE


@pytest.mark.parametrize("name", C.PRESETS)
def test_bounds_accept_the_presets(name):
    assert check(C.preset(name)) == C.preset(name)


def recorded_configurations() -> Iterator[tuple[str, dict[str, Any]]]:
    """Every configuration in a committed JSON file, by file and place."""

    def inside(content: Any, place: str) -> Iterator[tuple[str, dict[str, Any]]]:
        if isinstance(content, dict) and {"densify", "loss", "optim"} <= content.keys():
            yield place, content
        elif isinstance(content, (dict, list)):
            items = content.items() if isinstance(content, dict) else enumerate(content)
            for key, value in items:
                yield from inside(value, f"{place}.{key}")

    for folder in ("tests/fixtures", "benchmarks/results"):
        for path in sorted((ROOT / folder).rglob("*.json")):
            yield from inside(json.loads(path.read_text(encoding="utf-8")), path.name)


def test_bounds_accept_recorded_configurations():
    found = dict(recorded_configurations())
    assert len(found) >= 3
    for place, values in found.items():
        values["data"].pop("folder", None)
        check(C.from_dict(values, place))


@pytest.mark.parametrize("name", FIELDS)
def test_no_number_is_too_large_or_nan(name):
    most = FIELDS[name].get("most", MAGNITUDE)
    for value in (most + 1, math.nan, math.inf, -2 * MAGNITUDE):
        with pytest.raises(UserError, match=f"^file: {name} is .*; it must be at most {most:g}".replace("+", r"\+")):
            check_sizes(put(C.preset("best"), name, value), "file: ")


@pytest.mark.parametrize("name", [name for name, bounds in FIELDS.items() if "least" in bounds])
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
        ("motion.nodes", 100_000, "--nodes 100000: choose at most 20000; a Gaussian follows 4 of them"),
        ("densify.max_gaussians", 99, "--max-gaussians 99: needs at least 100"),
        ("pretrain.steps", 80_000, "steps 40000 leave nothing after 80000 pre-training steps; raise --steps"),
        ("optim.settle", 1.5, "optim.settle is 1.5; it must be at most 1"),
        ("optim.means", -1.0, "optim.means is -1.0; it must be at least 0"),
        ("loss.ssim", 5.0, "loss.ssim is 5.0; it must be at most 1"),
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


def test_a_run_has_a_main_stage():
    steps = C.preset("cpu").steps
    assert check(C.with_field(C.preset("cpu"), "pretrain.steps", steps - 1, "test")).main_steps == 1
    with pytest.raises(UserError, match=f"steps {steps} leave nothing after {steps} pre-training steps"):
        check(C.with_field(C.preset("cpu"), "pretrain.steps", steps, "test"))
