"""Settings: presets are complete, milestones scale, mistakes are named."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from scgs_warp.config import presets as C
from scgs_warp.config.validation import check
from scgs_warp.errors import UserError


@pytest.mark.parametrize("name", C.PRESETS)
def test_presets_are_complete_and_round_trip(name):
    made = check(C.preset(name))
    assert made.preset == name
    assert C.from_dict(json.loads(json.dumps(C.to_dict(made)))) == made


def test_best_preset_is_half_the_supplements_schedule():
    made = C.preset("best")
    assert (made.pretrain.steps, made.pretrain.densify_until, made.main_steps) == (5_000, 3_750, 35_000)
    assert (made.freeze, made.motion.nodes, made.motion.neighbors) == (1_500, 512, 4)
    assert (made.loss.arap, made.loss.arap_end, made.loss.arap_until) == (1e-2, 1e-2, 40_000)
    assert (made.motion.hyper_dim, made.motion.node_weight) == (1, True), "docs/quality.md"
    assert (made.motion.layers, made.motion.position_frequencies, made.motion.time_frequencies) == (8, 10, 6)
    assert made.pretrain.progressive_every == 500


def test_steps_scale_every_milestone():
    made = C.with_steps(C.preset("best"), 8_000)
    assert made.steps == 8_000
    assert (made.pretrain.steps, made.pretrain.densify_until, made.freeze) == (1_000, 750, 300)
    assert (made.densify.until, made.optim.means_until, made.loss.arap_until) == (4_000, 6_600, 8_000)
    assert made.densify.every == 100 and made.loss.arap_refresh == 200, "intervals are no milestones"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"preset": "fast"}, "preset is 'fast'"),
        ({"step": 3}, "unknown field 'step'"),
        ({"motion": {"node": 3}}, "unknown field 'motion.node'"),
        ({"motion": 3}, "motion must be an object"),
        ({"steps": "many"}, "steps is 'many'"),
        ({"steps": True}, "steps is True"),
        ({"motion": {"model": "fluid"}}, "motion.model is 'fluid'"),
        ({"loss": {"ssim": None}}, "loss.ssim is None"),
    ],
)
def test_mistakes_name_file_and_field(values, message):
    with pytest.raises(UserError, match=r"my\.json") as caught:
        C.from_dict(values, "my.json")
    assert message in str(caught.value)


def test_values_as_people_write_them():
    config = C.preset("cpu")
    for text, expected in (("True", True), ("False", False), ("true", True)):
        assert (
            C.with_field(config, "pretrain.progressive", C.parse_value(text), "--set").pretrain.progressive is expected
        )
    for text in ("300", "300.0", "3e2"):
        assert C.with_field(config, "motion.nodes", C.parse_value(text), "--set").motion.nodes == 300
    assert C.with_field(config, "data.only_cameras", C.parse_value("1"), "--set").data.only_cameras == "1"
    for name, text, wanted in (
        ("motion.nodes", "12.5", "a whole number"),
        ("pretrain.progressive", "1", "true or false"),
        ("optim.means", "fast", "a number"),
        ("data.frames", "true", "text"),
    ):
        with pytest.raises(UserError, match=f"; give {wanted}$"):
            C.with_field(config, name, C.parse_value(text), "--set")


def test_values_as_scripts_compute_them():
    given = {"motion": {"nodes": np.int64(64), "mask": np.bool_(True)}, "loss": {"arap": np.float32(0.5)}}
    config = C.from_dict(given)
    assert (type(config.motion.nodes), type(config.motion.mask), type(config.loss.arap)) == (int, bool, float)
    assert C.whole_number(np.arange(3)[2], "steps") == 2 and json.dumps(C.to_dict(config))
    with pytest.raises(UserError, match=r"motion\.nodes is array\(\[1, 2\]\); give a whole number"):
        C.from_dict({"motion": {"nodes": np.array([1, 2])}})


def test_a_file_that_begins_with_the_mark_of_windows(tmp_path):
    (tmp_path / "config.json").write_text('\ufeff{"steps": 100}', encoding="utf-8")
    assert C.read_config(tmp_path / "config.json") == {"steps": 100}


def test_unreadable_files(tmp_path):
    with pytest.raises(UserError, match="cannot be read"):
        C.read_config(tmp_path / "none.json")
    path = tmp_path / "bad.json"
    path.write_text("{")
    with pytest.raises(UserError, match="not valid JSON"):
        C.read_config(path)
    path.write_text("[]")
    with pytest.raises(UserError, match="must hold a JSON object"):
        C.read_config(path)


def test_too_few_steps():
    with pytest.raises(UserError, match="--steps 3"):
        C.with_steps(C.preset("cpu"), 3)


def test_presets_begin_at_rest_for_as_long_as_the_published_ones():
    """3,000 of 40,000 steps (Deformable-3D-GS) to 3,000 of 23,000 (4D-GS)."""
    for config in (C.preset("best"), C.preset("cpu"), C.preset("quick"), C.with_steps(C.preset("cpu"), 900)):
        assert 0.07 <= config.coarse / config.steps <= 0.13
        assert config.rest_steps == config.freeze


@pytest.mark.parametrize("name", ["cpu", "quick"])
def test_images_are_whole_while_gaussians_are_still_added(name):
    """Gaussians that only whole images ask for must still be made."""
    config = C.preset(name)
    assert config.pretrain_steps < config.half_size < config.pretrain_steps + 0.6 * config.densify.until


@pytest.mark.parametrize("name", C.PRESETS)
def test_no_milestone_falls_to_step_0_in_a_short_run(name):
    """A milestone of 0 means never or from the start; no other may come to mean that."""

    def milestones(config, prefix=""):
        for item in dataclasses.fields(config):
            value = getattr(config, item.name)
            if dataclasses.is_dataclass(value):
                yield from milestones(value, f"{prefix}{item.name}.")
            elif item.metadata.get("milestone"):
                yield f"{prefix}{item.name}", value

    given = C.preset(name)
    made = dict(milestones(C.with_steps(given, 10)))
    assert len(made) > 10 and min(value for _, value in milestones(given)) >= 0
    assert {label for label, value in milestones(given) if value > 0} == {k for k, value in made.items() if value > 0}


@pytest.mark.parametrize("name", ["steps", "preset"])
def test_fields_that_stand_for_many_are_no_single_fields(name):
    config = C.preset("cpu")
    with pytest.raises(UserError, match=f"give --{name} instead"):
        C.with_field(config, name, getattr(config, name), "test")


def test_settings_that_change_no_bit_do_not_last():
    made = C.preset("cpu")
    values = C.lasting(C.to_dict(made))
    assert not {"evaluate_every", "checkpoint_seconds"} & values.keys() and "cache_mib" not in values["data"]
    assert values["steps"] == made.steps and values["data"]["downscale"] == made.data.downscale
    assert values["motion"] == dataclasses.asdict(made.motion)
