"""The list of settings: every field, with a default and a meaning; the command that prints it."""

from __future__ import annotations

import dataclasses

import pytest

from scgs_warp.apps import config as app
from scgs_warp.config.listing import settings
from scgs_warp.config.presets import PRESETS, preset, to_dict, with_field


def leaves(values: dict, prefix: str = "") -> dict:
    found = {}
    for name, value in values.items():
        found |= leaves(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return found


@pytest.mark.parametrize("name", PRESETS)
def test_every_field_is_listed_with_its_default(name):
    rows = {row.name: row.default for row in settings(preset(name))}
    assert rows == leaves(to_dict(preset(name)))


def test_every_field_has_a_meaning_and_can_be_set():
    config = preset("cpu")
    for row in settings(config):
        assert len(row.meaning) > 10 and row.meaning.rstrip(")").endswith((".", ". ")), row
        assert row.values and "``" not in row.meaning, row
        if row.name not in ("steps", "preset"):
            assert dataclasses.asdict(with_field(config, row.name, row.default, "test")) == dataclasses.asdict(config)


def test_the_command(capsys):
    assert app.cli(["--list"]) == 0
    said = capsys.readouterr().out
    assert "motion.nodes = 256    (whole number from 1 to 1,000,000)" in said and said.count(" = ") > 90
    assert app.cli(["pruning", "--preset", "paper"]) == 0
    few = capsys.readouterr().out
    assert "densify.min_contribution" in few and "motion.width" not in few
    assert app.cli(["hyperdim"]) == 2
    assert "did you mean motion.hyper_dim?" in capsys.readouterr().err
