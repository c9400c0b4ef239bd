"""A slice of the campaign of damaged files (tests/fuzz/files_campaign.py), and proof that it detects failures."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fuzz import files_campaign
from fuzz.files_bytes import BYTES, JSON, TEXT
from fuzz.files_campaign import GOOD, WorkerProcess, campaign, formats, shares, summary
from fuzz.files_forms import mutate
from fuzz.files_lawless import FORMATS as LAWLESS

SLICE = 150
LONG = 1500


def run(cases: int, first: int) -> list[dict]:
    rows = list(campaign(shares(formats(), cases), first))
    failures = [row for row in rows if row["outcome"] not in GOOD]
    assert failures == [], "\n".join(f"{row['format']} --seed {row['seed']}: {row}" for row in failures)
    return rows


def test_damaged_files_are_loaded_or_refused():
    rows = run(SLICE, 0)
    found = summary(rows, 1.0)
    assert len(found["formats"]) > 25 and min(found["outcomes"][name] for name in GOOD) > SLICE / 8


@pytest.mark.slow
def test_many_damaged_files_are_loaded_or_refused():
    assert len(run(LONG, 1000)) >= LONG


def test_the_campaign_sees_what_breaks_the_law(monkeypatch):
    """Each of these readers fails in another way; a worker that hangs or dies is replaced."""
    worker = WorkerProcess([item.name for item in LAWLESS], ["files_lawless"])
    try:
        for item in LAWLESS:
            monkeypatch.setattr(files_campaign, "PATIENCE", 5.0 if item.name == "hang" else 60.0)
            rows = (worker.run(item.name, seed) for seed in range(10))
            found = next(row for row in rows if row["outcome"] != "loaded")  # some damage is none
            assert found["outcome"] == item.name, found
    finally:
        worker.stop()


@pytest.mark.parametrize("mutator", sorted({*BYTES, *JSON, *TEXT}, key=lambda m: m.__name__), ids=lambda m: m.__name__)
def test_damage_comes_from_the_seed_alone(mutator):
    data = json.dumps({"a": [1, 2, {"b": "text"}], "c": 0.5, "d": [[1.0, 2.0], [3.0, 4.0]]}, indent=1).encode()
    made = [mutator(data, np.random.default_rng(seed)) for seed in (1, 2, 3, 1)]
    assert made[0] == made[3] and any(other != data for other in made)


def test_every_kind_of_file_is_damaged_in_its_own_way():
    for suffix in (".json", ".png", ".bin", ".txt"):
        data = b'{"a": [1, 2, 3], "b": {"c": 4.5}}' * (1 if suffix == ".json" else 9)
        made = [mutate(f"x{suffix}", data, np.random.default_rng(seed)) for seed in range(20)]
        assert len(set(made)) > 10 and sum(other != data for other in made) > 15
