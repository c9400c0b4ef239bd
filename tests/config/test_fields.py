"""Fields of the settings: derived values, and bounds that hold for every preset."""

from __future__ import annotations

import dataclasses

from scgs_warp.config import presets as C
from scgs_warp.config.bounds import bounded, chosen, milestone


def test_interval_of_densification_rounds():
    """Rounds are as many in runs of any length, but at least ``every`` steps apart; scaling twice is scaling once."""

    def interval(name: str, *steps: int) -> int:
        made = C.preset(name)
        for count in steps:
            made = C.with_steps(made, count)
        return made.densify.interval

    assert [interval("best", steps) for steps in (160_000, 80_000, 40_000, 8_000)] == [599, 300, 150, 100]
    assert [interval("cpu", steps) for steps in (48_000, 24_000, 4_000)] == [176, 100, 100]
    assert interval("quick") == interval("quick", 24_000) == interval("cpu", 4_000, 24_000) == 100
    few = C.with_field(C.preset("cpu"), "densify.every", 20, "test")
    assert C.with_steps(few, 4_000).densify.interval == 20


def test_only_control_points_have_a_first_stage():
    made = C.with_field(C.preset("best"), "motion.model", "static", "test")
    assert made.pretrain_steps == 0 and made.main_steps == 40_000


def test_rest_steps_follow_the_model():
    made = C.preset("best")
    assert made.rest_steps == made.freeze and made.motion.has_shading
    planes = C.with_field(made, "motion.model", "hexplane", "test")
    assert planes.rest_steps == planes.coarse and not planes.motion.has_shading


def test_metadata_stands_beside_the_default():
    @dataclasses.dataclass(frozen=True)
    class Example:
        size: int = bounded(3, 1, 9)
        degree: int = chosen(2, 0, 3)
        until: int = milestone(50, 0)

    fields = {item.name: item for item in dataclasses.fields(Example)}
    assert Example() == Example(3, 2, 50)
    assert (fields["size"].metadata["least"], fields["size"].metadata["most"]) == (1, 9)
    assert fields["degree"].metadata["choices"] == (0, 3)
    assert fields["until"].metadata["milestone"] and not fields["size"].metadata.get("milestone")
