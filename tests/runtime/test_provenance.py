"""Commands of results: they run in any checkout and name no folder of this machine."""

from __future__ import annotations

import pytest

from scgs_warp.runtime.provenance import command_line, processor


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


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"model name": "AMD EPYC 9654"}, "AMD EPYC 9654"),
        ({"model name": "AMD EPYC", "cpu family": "26", "model": "2"}, "AMD EPYC, family 26 model 2"),
        ({"model name": "AMD EPYC"}, "AMD EPYC"),
    ],
)
def test_a_vague_name_is_followed_by_the_generation(tmp_path, fields, text):
    lines = "\n".join(f"{key}\t: {value}" for key, value in fields.items())
    (tmp_path / "cpuinfo").write_text(f"processor\t: 0\n{lines}\n\nprocessor\t: 1\nmodel name\t: other\n")
    assert processor(tmp_path / "cpuinfo") == text


def test_a_system_without_that_file_names_its_machine(tmp_path):
    assert processor(tmp_path / "missing")
