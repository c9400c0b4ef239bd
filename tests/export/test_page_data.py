"""Packed columns of a page."""

from __future__ import annotations

import numpy as np
import pytest

from scgs_warp.errors import UserError
from scgs_warp.export.page_data import Column, integers, pack, quantise, unpack


def test_columns_come_back(tmp_path):
    random = np.random.default_rng(3)
    walk = random.normal(size=500).cumsum()
    columns = [
        quantise("fine", walk, 1e-4, delta=True),
        quantise("coarse", walk, 1e-4, most_bits=5),
        quantise("constant", np.full(500, 2.5), 1e-3),
        integers("whole", random.integers(0, 700, 500)),
        integers("none", np.zeros(0, int)),
    ]
    facts, values = unpack(pack({"fact": 1.5}, columns))
    assert facts["fact"] == 1.5
    for column in columns:
        assert np.array_equal(values[column.name], column.values()), column.name
    assert np.abs(values["fine"] - walk).max() <= 0.51e-4 and 16 < columns[0].bits < 24
    assert 0.4 * np.ptp(walk) / 31 < np.abs(values["coarse"] - walk).max() <= 0.51 * np.ptp(walk) / 31
    assert (values["constant"] == 2.5).all()
    assert pack({"fact": 1.5}, columns) == pack({"fact": 1.5}, columns)


def test_differences_may_pass_zero():
    codes = np.array([5, 0, 1023, 1], np.uint32)
    _, values = unpack(pack({}, [Column("x", codes, 10, delta=True)]))
    assert values["x"].tolist() == [5, 0, 1023, 1]


def test_differences_are_stored_modulo_the_codes_range():
    """5, -5, 1023, -1022 in ten bits, the lowest eight first; bits that no code has are 0."""
    planes = Column("x", np.array([5, 0, 1023, 1], np.uint32), 10, delta=True).planes()
    assert list(planes) == [5, 0xFB, 0xFF, 2, 0, 3, 3, 0]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused_by_name(value):
    with pytest.raises(UserError, match="web page: scale2 is not finite"):
        quantise("scale2", np.array([0.0, value, 1.0]), 1e-3)


def test_scarce_codes_are_for_what_is_common():
    values = np.random.default_rng(1).normal(size=5000)
    for outlier in (1e4, -1e4):
        column = quantise("x", np.append(values, outlier), 1e-3, most_bits=8)
        most = np.abs(values).max()
        assert column.step < 3 * most / 255 and np.abs(column.values()[:-1] - values).max() < 0.51 * column.step
    far = quantise("x", 1e3 + values, 1e-3, most_bits=8)
    assert np.abs(far.values() - values - 1e3).max() < 0.51 * np.ptp(values) / 255
