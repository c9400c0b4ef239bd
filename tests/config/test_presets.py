"""Settings: presets are complete, milestones scale, mistakes are named."""

from __future__ import annotations

import json

import pytest

from scgs_warp.config import presets as C
from scgs_warp.config.validation import check
from scgs_warp.errors import UserError
from scgs_warp.training.step import SETTLED, settling


@pytest.mark.parametrize("name", C.PRESETS)
def test_presets_are_complete_and_round_trip(name):
    made = check(C.preset(name))
    assert made.preset == name
    assert C.from_dict(json.loads(json.dumps(C.to_dict(made)))) == made


def test_paper_preset_is_the_supplements_where_that_measured_best():
    made = C.preset("paper")
    assert (made.pretrain.steps, made.pretrain.densify_until, made.main_steps) == (10_000, 7_500, 70_000)
    assert (made.freeze, made.motion.nodes, made.motion.neighbors) == (3_000, 512, 4)
    assert made.loss.arap_until >= made.main_steps, "rigidity to the end: docs/quality.md"
    assert (made.motion.layers, made.motion.position_frequencies, made.motion.time_frequencies) == (8, 10, 6)
    assert made.pretrain.progressive_every == 1_000


def test_steps_scale_every_milestone():
    made = C.with_steps(C.preset("paper"), 8_000)
    assert made.steps == 8_000
    assert (made.pretrain.steps, made.pretrain.densify_until, made.freeze) == (1_000, 750, 300)
    assert (made.densify.until, made.optim.means_until, made.loss.arap_until) == (4_000, 6_600, 8_000)
    assert made.densify.every == 100 and made.loss.arap_refresh == 200, "intervals are no milestones"


def test_as_many_rounds_of_densification_however_long_the_run():
    """But each looks at a hundred views, or at as many as were asked for; and scaling twice is scaling once."""

    def interval(name: str, *steps: int) -> int:
        made = C.preset(name)
        for count in steps:
            made = C.with_steps(made, count)
        return made.densify.interval

    assert [interval("paper", steps) for steps in (160_000, 80_000, 40_000, 8_000)] == [599, 300, 150, 100]
    assert [interval("cpu", steps) for steps in (48_000, 24_000, 4_000)] == [176, 100, 100]
    assert interval("quick") == interval("quick", 24_000) == interval("cpu", 4_000, 24_000) == 100
    few = C.with_field(C.preset("cpu"), "densify.every", 20, "test")
    assert C.with_steps(few, 4_000).densify.interval == 20


def test_only_control_points_have_a_first_stage():
    made = C.with_field(C.preset("paper"), "motion.model", "static", "test")
    assert made.pretrain_steps == 0 and made.main_steps == 80_000


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


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("motion.neighbors", 0),
        ("motion.neighbors", 17),
        ("motion.nodes", 4),
        ("densify.max_gaussians", 1),
        ("sh_degree", 4),
        ("data.downscale", 0),
        ("pretrain.steps", 80_000),
        ("optim.settle", 1.5),
    ],
)
def test_what_cannot_run_is_refused(name, value):
    with pytest.raises(UserError):
        check(C.with_field(C.preset("paper"), name, value, "test"))


def test_constant_rates_settle_in_the_last_share_of_the_run():
    config = C.preset("paper")
    begin = round(0.85 * config.main_steps)
    factors = [settling(step, config) for step in range(0, config.main_steps + 1, 500)]
    assert factors[begin // 500] == 1.0 and factors == sorted(factors, reverse=True)
    assert factors[-1] == SETTLED < settling(begin + 100, config) < 1.0
    assert settling(config.main_steps, C.with_field(config, "optim.settle", 0.0, "test")) == 1.0


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
