"""Fields of JSON that people write."""

from __future__ import annotations

import pytest

from scgs_warp.edit.field_reader import FieldReader, one_line, parse_object, show_value
from scgs_warp.errors import UserError


def test_fields_have_types_and_defaults():
    reader = FieldReader({"x": 2, "n": 3, "v": [1, 2], "b": True, "inner": {"deep": {"y": 1}}}, "a.json")
    assert reader.number("x") == 2.0 and isinstance(reader.number("x"), float)
    assert reader.integer("n", 0, 0, 9) == 3 and reader.integer("missing", 7, 0, 9) == 7
    assert reader.vector("v", 2) == (1.0, 2.0) and reader.vector("missing", 2, default=()) == ()
    assert reader.boolean("b") is True and reader.boolean("missing") is None
    ((name, deep),) = reader.entries("inner")
    assert name == "deep" and deep.path == "inner.deep" and deep.number("y") == 1.0
    reader.done()


def test_a_field_that_nobody_reads_is_refused():
    reader = FieldReader({"x": 1, "colour": 2}, "a.json", "handles[0]")
    reader.number("x")
    with pytest.raises(UserError, match=r"a.json: handles\[0\].colour is not known; known here: x"):
        reader.done()
    reader.done("colour")


@pytest.mark.parametrize("value", [True, "1", [1], float("nan"), 10**400, 2.0])
def test_a_number_is_a_finite_number_within_its_range(value):
    with pytest.raises(UserError, match="x is"):
        FieldReader({"x": value}, "a.json").number("x", None, 0.0, 1.0)


@pytest.mark.parametrize("name", ["می\u200cرود", "\U0001f468\u200d\U0001f467", "יד"])
def test_a_name_may_be_of_any_script(name):
    assert FieldReader({"x": name}, "a.json").text("x") == name


@pytest.mark.parametrize("name", ["", " ", "x" * 101, "a\nb", "\u202egnp", "\x00", 3, None])
def test_what_cannot_be_shown_on_one_line_is_no_name(name):
    with pytest.raises(UserError, match="give a name"):
        FieldReader({"x": name}, "a.json").text("x")


def test_objects_are_strict_json():
    assert parse_object('{"a": 1}', "a.json") == parse_object('\ufeff{"a": 1}', "a.json") == {"a": 1}
    for text in ("[1]", '{"a": Infinity}', '{"a": 1, "a": 2}', "{"):
        with pytest.raises(UserError, match=r"a\.json"):
            parse_object(text, "a.json")


def test_what_a_message_quotes_is_short_and_on_one_line():
    assert show_value(None) == "missing" and len(show_value("x" * 1000)) == 60
    assert show_value(["bras droit é", "右腕"]) == '["bras droit é", "右腕"]', "as it was written"
    assert show_value("a\u202eb") == '"a\\u202eb"', "what turns the line round is not"
    assert one_line("a\nb") == "a\\nb" and len(one_line("x" * 1000)) == 100
