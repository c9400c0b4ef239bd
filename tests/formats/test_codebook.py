"""Codebooks of 256 numbers, and palettes of rows."""

from __future__ import annotations

import numpy as np
import pytest

from scgs_warp.formats.codebook import LEVELS, encode, make_codebook
from scgs_warp.formats.palette import make_palette


@pytest.mark.parametrize("kind", ["normal", "uniform", "outliers", "two", "constant", "none"])
def test_a_codebook_is_near_the_values(kind):
    random = np.random.default_rng(0)
    values = {
        "normal": random.normal(size=(4000, 3)),
        "uniform": random.uniform(-3, 5, 10_000),
        "outliers": np.concatenate([random.normal(size=9000), [1e3, -1e3, 1e6]]),
        "two": np.tile([1.5, -2.0], 600),
        "constant": np.full(700, 0.1),
        "none": np.zeros(0),
    }[kind]
    book = make_codebook(values)
    assert book.shape == (LEVELS,) and book.dtype == np.float32 and (np.diff(book) >= 0).all()
    codes = encode(values, book)
    assert codes.dtype == np.uint8 and codes.shape == values.shape
    error = np.abs(book[codes] - values)
    nearest = np.abs(values.reshape(-1, 1) - book).min(axis=1, initial=np.inf).reshape(values.shape)
    np.testing.assert_allclose(error, nearest, atol=1e-6)
    if kind in ("two", "constant", "none"):
        assert not error.size or error.max() < 1e-7
    if kind == "normal":  # steps of equal width have 8 / 255 / sqrt(12) = 0.0091
        assert np.sqrt((error**2).mean()) < 0.007
    if kind == "outliers":
        assert error[-3:].max() < 1.0 and np.sqrt((error[:-3] ** 2).mean()) < 0.012


def test_up_to_256_values_are_kept_exactly():
    values = np.random.default_rng(1).normal(size=256).astype(np.float32)
    book = make_codebook(np.tile(values, 20))
    np.testing.assert_array_equal(book[encode(values, book)], values)


def test_a_palette_of_few_kinds_is_exact_and_else_near():
    random = np.random.default_rng(2)
    kinds = random.normal(size=(60, 9)).astype(np.float32)
    rows = kinds[random.integers(0, 60, 900)]
    palette, labels = make_palette(rows, 64)
    assert len(palette) == 60
    np.testing.assert_array_equal(palette[labels], rows)
    rows = (rows + 0.01 * random.normal(size=rows.shape)).astype(np.float32)
    palette, labels = make_palette(rows, 256)
    assert len(palette) <= 256 and labels.min() >= 0 and labels.max() < len(palette)
    error = ((palette[labels] - rows) ** 2).sum(axis=1)
    assert error.max() < 0.2 and np.sqrt(error.mean()) < 0.05
    again = make_palette(rows, 256)
    assert all(np.array_equal(a, b) for a, b in zip((palette, labels), again))


def test_larger_palettes_are_nearer():
    rows = np.random.default_rng(3).normal(size=(2000, 24)).astype(np.float32)
    errors = []
    for size in (16, 128, 1024):
        palette, labels = make_palette(rows, size)
        assert len(palette) <= size
        errors.append(((palette[labels] - rows) ** 2).mean())
    assert errors[0] > errors[1] > errors[2] and errors[2] < 0.5 and errors[0] < 1.0


def test_what_matters_is_nearer():
    rows = np.random.default_rng(4).normal(size=(3000, 9)).astype(np.float32)
    weights = np.where(np.arange(3000) % 10 == 0, 1.0, 0.03)
    errors = []
    for given in (None, weights):
        palette, labels = make_palette(rows, 512, given)
        errors.append(((palette[labels] - rows) ** 2).mean(axis=1))
    assert errors[1][::10].mean() < 0.4 * errors[0][::10].mean() and errors[1].mean() < 1.5 * errors[0].mean()
