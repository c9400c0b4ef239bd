"""Numbers in JSON: text and booleans are none, though NumPy and Python would convert them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scgs_warp.errors import UserError
from scgs_warp.storage.json_files import as_array, as_number, numbers, read_json


@pytest.mark.parametrize("value", ["1", True, None, [1], {}, math.nan, math.inf, 10**400])
def test_what_is_no_number(value: Any):
    assert as_number(value) is None
    assert as_array([value, 1, 2], (3,)) is None


@pytest.mark.parametrize("value", [["1", "2", "3"], [True, 2, 3], "123", [[1], [2, 3]], [[[[[1]]]]], [1, [2], 3], {}])
def test_what_is_no_array(value: Any):
    assert numbers(value) is None and as_array(value, (3,)) is None


def test_arrays_have_one_of_the_shapes():
    assert as_array([1, 2.5], (3,), (2,)).tolist() == [1.0, 2.5]
    assert as_array([1, 2], (3,)) is None and as_array([[1, 2]], (2,)) is None
    assert np.isnan(numbers([[1, math.nan]])).tolist() == [[False, True]]
    assert as_array([[1, 2], [3, math.inf]], (2, 2)) is None


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\xff", "is no UTF-8 text"),
        (b"[1]", "holds no JSON object"),
        (b"{,}", "not valid JSON, line 1 column 2"),
        (b"[" * 200_000, "JSON nested too deeply"),
        (b'{"a": ' + b"9" * 5000 + b"}", "holds a number of more than 4,300 digits"),
    ],
    ids=["bytes", "list", "comma", "depth", "digits"],
)
def test_damaged_files_are_refused_in_one_line(tmp_path: Path, content: bytes, words: str):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(UserError, match=rf"a\.json: {words}"):
        read_json(tmp_path / "a.json")
