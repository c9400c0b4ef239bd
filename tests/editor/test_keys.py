"""Keyframes as a timeline changes them, against a model of dictionaries."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scgs_warp.edit import Edit, Handle, Target
from scgs_warp.editor import keys
from scgs_warp.errors import UserError

NAMES = ("a", "b", "c")
MOMENTS = st.sampled_from([0.0, 0.5, 1.0, 2.0, 4.0])
Rows = dict[float, dict[str, float]]


def start() -> Edit:
    return Edit(handles=tuple(Handle(name, (row,), 0.0) for row, name in enumerate(NAMES)))


def rows(edit: Edit) -> Rows:
    return {f.at: {name: target.translation[0] for name, target in f.targets.items()} for f in edit.keyframes}


def target(x: float) -> Target:
    return Target.of((x, 0.0, 0.0))


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["key", "move", "copy", "delete", "ease"]),
            st.sampled_from([*NAMES, None]), MOMENTS, MOMENTS, st.integers(1, 9),
        ),
        max_size=25,
    )
)  # fmt: skip
def test_no_key_is_lost(actions):
    edit, model = start(), {}
    for what, name, begin, end, value in actions:
        frame = model.get(begin)
        missing = frame is None or (name is not None and name not in frame)
        if what == "key":
            edit = keys.keyed(edit, begin, {name or "a": target(value)})
            model.setdefault(begin, {})[name or "a"] = float(value)
        elif missing and not (what == "ease" and frame is not None):
            with pytest.raises(UserError):
                if what == "ease":
                    keys.eased(edit, begin, "ease")
                elif what == "delete":
                    keys.removed(edit, name, begin)
                else:
                    keys.moved(edit, name, begin, end, copy=what == "copy")
            continue
        elif what == "ease":
            edit = keys.eased(edit, begin, "ease")
        else:
            taken = dict(frame) if name is None else {name: frame[name]}
            edit = (
                keys.removed(edit, name, begin)
                if what == "delete"
                else keys.moved(edit, name, begin, end, copy=what == "copy")
            )
            if what == "delete" or (what == "move" and begin != end):
                model[begin] = {n: v for n, v in frame.items() if n not in taken}
                if not model[begin]:
                    del model[begin]
            if what != "delete" and begin != end:
                model.setdefault(end, {}).update(taken)
        assert rows(edit) == model
        assert [frame.at for frame in edit.keyframes] == sorted(model)


def test_a_key_stays_within_the_film():
    edit = keys.keyed(start(), 1.0, {"a": target(1.0)})
    with pytest.raises(UserError, match="film of 4 s"):
        keys.moved(edit, "a", 1.0, 4.5)
    assert keys.moved(edit, None, 1.0, 4.0).keyframes[0].at == 4.0
