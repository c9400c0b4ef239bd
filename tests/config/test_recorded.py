"""Configurations of older versions: newer fields take the value that does what those versions did."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from helpers.paths import ROOT
from scgs_warp.ablation.cells import flatten
from scgs_warp.config import presets, recorded
from scgs_warp.config.fields import TrainConfig

OLD = Path(ROOT / "tests/fixtures/config-3132a41")
"""Files that 3132a41 wrote with ``to_dict`` of its presets."""


def test_a_run_of_the_former_paper_stays_what_it_was():
    """Every recorded field, and for the newer ones the value that stands for their absence."""
    old = json.loads((OLD / "paper.json").read_text())
    values = dict(flatten(old))
    before = {name: default["before"] for name, default in recorded._fields(TrainConfig()) if "before" in default}
    read = dict(flatten(presets.to_dict(presets.from_dict(old))))
    assert before and not before.keys() & values.keys()
    assert read == {**values, **before}
    assert read != dict(flatten(presets.to_dict(presets.preset("paper")))), "paper has other values today"


def test_best_is_the_former_paper_in_half_the_steps():
    """Field by field; whoever tunes ``best`` names the changed fields here."""
    values = dict(flatten(json.loads((OLD / "paper.json").read_text())))
    best = dict(flatten(presets.to_dict(presets.preset("best"))))
    former = presets.from_dict(json.loads((OLD / "paper.json").read_text()))
    halved = dict(flatten(presets.to_dict(presets.with_steps(former, 40_000)))) | {"evaluate_every": 5_000}
    changed = {
        **{name: value for name, value in halved.items() if name in values and values[name] != value},
        "preset": "best",
        "motion.hyper_dim": 1,
        "motion.hyper_dim_filled": 1,
        "motion.node_weight": True,
        "pretrain.warm_up": 50,
    }
    assert {name: best[name] for name, value in values.items() if best[name] != value} == changed
    newer = {name: default["before"] for name, default in recorded._fields(TrainConfig()) if "before" in default}
    added = {
        "pretrain.silhouette": 0.5,
        "pretrain.arap_by": "auto",
        "pretrain.fade": "auto",
        "pretrain.pooled": True,
        "pretrain.body_turn": True,
        "motion.correctives": True,
        "optim.correctives": 8e-4,
        "motion.tints": True,
        "motion.turns": True,
        "loss.arap_slack": 0.5,
        "loss.log_error": 0.002,
        "loss.log_error_from": 0.58,
        "sharpness": 0.5,
        "loss.pooled": "auto",
        "motion.hyper_stretch": 8**0.5,
        "flow_points": 4_000,
        "densify.least_views": 2,
        "densify.clear_distance": 0.25,
        "densify.faint_share": 0.01,
        "densify.faint_at": "resets",
        "loss.depth": 0.2,
        "loss.stereo": True,
        "loss.random_background": 0.1,
        "optim.network_scale": 0.0,
        "motion.bfloat16_adjoint": True,
    }
    assert {name: best[name] for name in best.keys() - values.keys()} == {**newer, **added}


@pytest.mark.parametrize("name", ["quick", "cpu", "paper"])
def test_a_recorded_configuration_keeps_what_it_did(name):
    values = json.loads((OLD / f"{name}.json").read_text())
    read = presets.to_dict(presets.from_dict(values))
    assert read["loss"].pop("log_error") == 0.0 and read["sharpness"] == 0.0
    assert not read["loss"]["random_background"]
    assert not read["motion"]["turns"]
    assert not read["motion"]["tints"] and not read["motion"]["correctives"]
    for section, fields in values.items():
        own = read[section]
        assert (own if not isinstance(fields, dict) else {name: own[name] for name in fields}) == fields


def test_a_partial_configuration_follows_its_preset():
    assert presets.from_dict({"preset": "cpu", "motion": {"nodes": 64}}).loss.log_error == 0.002
    values = presets.to_dict(presets.preset("cpu"))
    assert presets.from_dict(values).loss.log_error == 0.002


def test_values_that_are_given_stay():
    values = presets.to_dict(presets.preset("cpu"))
    values["loss"]["log_error"] = 0.004
    assert recorded.with_newer_fields(values) == values


def test_what_changes_no_bit_may_be_missing():
    values = json.loads((OLD / "cpu.json").read_text())
    del values["evaluate_every"], values["data"]["cache_mib"]
    assert recorded.with_newer_fields(values)["loss"]["log_error"] == 0.0


def test_a_file_without_an_older_field_is_partial():
    values = json.loads((OLD / "cpu.json").read_text())
    del values["half_size"]
    assert recorded.with_newer_fields(values) == values
