"""Records of an edit that Python makes: their fields are checked as those of files are."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import Edit, EditSession, Exaggerate, Film, Handle, Hold, Keyframe, Playback, Shot, Target, View
from scgs_warp.errors import UserError


@pytest.mark.parametrize(
    ("kind", "fields", "words"),
    [
        (Playback, {"seconds": math.nan}, "playback: seconds is NaN; give a number from 0.001 to 3600"),
        (Playback, {"speed": "fast"}, 'playback: speed is "fast"; give a number'),
        (Playback, {"repeat": "never"}, "playback: repeat .* choose one of once, loop, swing"),
        (Playback, {"map": ((0.0, 0.0), (0.0, 1.0))}, r"playback: map\[1\] is \[0, 1\]; give rising"),
        (Playback, {"map": 3}, "playback: map is 3; give a list"),
        (Playback, {"map": [(0.0, math.inf)]}, r"playback: map\[0\] is .*; give 2 numbers"),
        (Hold, {"nodes": "all"}, 'hold: nodes is "all"; give a list'),
        (Hold, {"nodes": [-1]}, "hold: nodes names control point -1; give whole numbers from 0 on"),
        (Hold, {"nodes": [0], "time": math.nan}, "hold: time is NaN; give a number from 0 to 1"),
        (Hold, {"nodes": [0], "rings": 1.5}, "hold: rings is 1.5; give a whole number"),
        (Hold, {"nodes": [0], "frame": "moon"}, "hold: frame .* choose one of body, world"),
        (Exaggerate, {"factor": math.inf}, "exaggerate: factor is Infinity; give a number"),
        (Exaggerate, {"about": -1.0}, "exaggerate: about is -1.0; give a number from 0 to 1"),
        (Exaggerate, {"nodes": [0.5]}, "exaggerate: nodes names control point 0.5"),
        (Film, {"seconds": math.nan}, "film: seconds is NaN; give a number"),
        (Film, {"fps": 0.0}, "film: fps is 0.0; give a number from 0.01 to 1000"),
        (Film, {"size": 512.5}, "film: size is 512.5; give a whole number from 16 to 8192"),
        (Film, {"background": (0.0, 0.0, 2.0)}, "film: background .* give 3 numbers from 0 to 1"),
        (Film, {"shot": "turntable"}, 'film: shot is "turntable"; give Shot'),
        (Shot, {"kind": "drone"}, "shot: kind .* choose one of turntable, fixed, orbit"),
        (Shot, {"views": View()}, "shot: views is .*; give a list of View"),
        (Shot, {"views": [View(), View()]}, "shot: views has two at one moment; give"),
        (Shot, {"up": (0.0, 0.0, 0.0)}, "shot: up has no direction; give"),
        (Shot, {"fov": 180.0}, "shot: fov is 180.0; give a number from 1 to 150"),
        (View, {"at": -1.0}, "view: at is -1.0; give a number"),
        (View, {"elevation": 90.0}, "view: elevation is 90.0; give a number from -80 to 80"),
        (View, {"distance": 0.0}, "view: distance is 0.0; give a number"),
        (View, {"target": (0.0, math.nan, 0.0)}, "view: target is .*; give 3 numbers"),
        (Target, {"translation": "up"}, 'target: translation is "up"; give 3 numbers'),
        (Target, {"rotation": (1.0, 0.0, 0.0)}, "target: rotation is .*; give 4 finite numbers"),
        (Handle, {"name": "a", "nodes": []}, "handle 'a': nodes is missing or empty; list control points"),
        (Handle, {"name": "a", "nodes": [-1]}, "handle 'a': nodes names control point -1"),
        (
            Keyframe,
            {"at": 0.0, "targets": {"a": (0, 0, 1)}},
            "keyframe: targets is .*; give a mapping of names",
        ),
        (Edit, {"holds": Hold([0])}, "edit: holds is .*; give a list of Hold"),
        (Edit, {"exaggerate": 1.5}, "edit: exaggerate is 1.5; give Exaggerate"),
        (Edit, {"film": 4.0}, "edit: film is 4.0; give Film"),
        (Edit, {"keyframes": [Keyframe(1.0), Keyframe(1.0)]}, "edit: keyframes has two at 1 s; leave one"),
    ],
)
def test_a_wrong_field_is_named_with_a_remedy(kind, fields, words):
    with pytest.raises(UserError, match=words) as caught:
        kind(**fields)
    assert "\n" not in str(caught.value)


def test_numpy_lists_and_tensors_are_taken():
    assert Hold([2, 1, 1]) == Hold(np.array([1, 2])) == Hold((1, 2)) == Hold(torch.tensor([1, 2]))
    assert Playback(map=[[0, 0], [1, 1]]) == Playback(map=np.array([[0, 0], [1, 1]])) == Playback(map=((0, 0), (1, 1)))
    assert Film(background=np.zeros(3), size=np.int64(64)) == Film(background=(0, 0, 0), size=64)
    assert Target(torch.tensor([0.0, 0.5, 0.0])) == Target([0, 0.5, 0]) == Target.of(np.array([0, 0.5, 0]))
    edit = Edit(
        holds=[Hold([0])], keyframes=[Keyframe(2.0), Keyframe(1)], film=Film(shot=Shot(views=[View(2), View(1)]))
    )
    assert [frame.at for frame in edit.keyframes] == [1.0, 2.0] and isinstance(edit.holds, tuple)
    assert [view.at for view in edit.film.shot.views] == [1.0, 2.0]
    assert hash(edit.film) == hash(Film(shot=Shot(views=(View(1.0), View(2.0)))))


@pytest.mark.parametrize(
    "edit",
    [
        Edit(pins=[10**6]),
        Edit(handles=[Handle("a", [10**6])]),
        Edit(holds=[Hold([10**6])]),
        Edit(exaggerate=Exaggerate(nodes=[10**6])),
    ],
)
def test_control_points_that_do_not_exist_are_refused(edit):
    session = EditSession(bar_scene())
    for take in (session.apply, lambda edit: EditSession(session.scene, edit)):
        with pytest.raises(UserError, match=f"control point 1000000: there are {len(session)}"):
            take(edit)
    assert session.edit == Edit()
