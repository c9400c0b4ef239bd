"""Commands of results: they run in any checkout and name no folder of this machine."""

from __future__ import annotations

import pytest

from scgs_warp.runtime.provenance import command_line


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ([], "python apps/train.py"),
        (["--data", "/home/me/hook", "--steps", "60"], "python apps/train.py --data hook --steps 60"),
        (["--data=/home/me/hook", "--set", "loss.arap=0"], "python apps/train.py --data=hook --set loss.arap=0"),
        (["--data", "data/my scene"], "python apps/train.py --data 'data/my scene'"),
    ],
)
def test_command_line(words, text):
    assert command_line("apps/train.py", words) == text
