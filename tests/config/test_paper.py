"""The preset ``paper``: every setting is what the table of docs/paper-preset.md says."""

from __future__ import annotations

import ast
import dataclasses
import json
import re

from helpers.paths import ROOT
from scgs_warp.ablation.cells import flatten
from scgs_warp.config import fields
from scgs_warp.config import presets as C
from scgs_warp.config.presets import parse_value, preset, to_dict, with_field

PAGE = ROOT / "docs/paper-preset.md"
SOURCES = {"supplement", "official code", "supplement, official code", "ours"}


def rows() -> list[list[str]]:
    """The cells of the table of settings."""
    lines = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_the_table_names_every_setting_with_its_value_and_source():
    table = {}
    for names, values, source, remark in rows():
        named, given = (re.findall(r"`([^`]+)`", cell) for cell in (names, values))
        assert len(named) == len(given) and not set(named) & table.keys(), names
        table.update(zip(named, given))
        assert source in SOURCES and (remark or source != "ours"), names
    settings = dict(flatten(to_dict(preset("paper"))))
    assert settings.pop("preset") == "paper"
    assert {name: parse_value(value) for name, value in table.items()} == settings


def test_every_setting_is_given_by_name():
    """A change of a default, which tunes ``best``, leaves ``paper`` as it is."""
    tree = ast.parse((ROOT / "scgs_warp/config/paper.py").read_text(encoding="utf-8"))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)]
    assert len(calls) == 7
    for call in calls:
        section = getattr(fields, call.func.id)  # type: ignore[union-attr]
        wanted = {item.name for item in dataclasses.fields(section)} - {"cache_mib"}  # which does not affect the result
        assert {keyword.arg for keyword in call.keywords} == wanted, section


def test_the_preset_round_trips_and_takes_options():
    made = with_field(preset("paper"), "motion.nodes", 64, "test")
    assert C.from_dict(json.loads(json.dumps(to_dict(made)))) == made


def test_short_runs_keep_the_steps_that_random_gaussians_need():
    short = C.with_steps(preset("paper"), 800)
    assert (short.freeze, short.coarse, short.densify.opacity_reset_every) == (200, 200, 200)
    assert (short.pretrain.steps, short.pretrain.warm_up, short.densify.until) == (100, 20, 500)
    half = C.with_steps(preset("paper"), 40_000)
    assert (half.freeze, half.coarse, half.densify.opacity_reset_every) == (1_500, 1_500, 1_500)
    few = C.with_steps(with_field(preset("paper"), "freeze", 50, "test"), 800)
    assert few.freeze == 50, "a smaller number that was asked for"
    assert C.with_steps(preset("best"), 800).freeze == 30
