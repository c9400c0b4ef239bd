"""A training run from its folder of data on."""

from __future__ import annotations

from helpers.nerfstudio_files import write
from helpers.tiny import tiny_config


def test_long_reading_shows_how_far_it_is(tmp_path, monkeypatch, capsys):
    from scgs_warp.training import run

    write(tmp_path)
    config = tiny_config(20, data={"cache_mib": 3})
    train, test = run.load_splits(config, tmp_path)
    assert train.cache is test.cache and train.cache.budget == 3 * 2**20
    assert "reading" not in capsys.readouterr().err, "it was quick"
    monkeypatch.setattr(run, "QUIET_SECONDS", -1.0)
    run.load_splits(config, tmp_path)
    said = capsys.readouterr()
    assert "reading train images" in said.out + said.err and "reading test images 2/2" in said.out + said.err


def test_a_number_of_frames_that_there_are_not_is_noted(tmp_path, capsys):
    from scgs_warp.training import run

    write(tmp_path)
    count = sum(len(split) for split in run.load_splits(tiny_config(20), tmp_path))
    for least in (count, count + 1):
        run.load_splits(tiny_config(20, data={"min_frames": least}), tmp_path)
        said = capsys.readouterr()
        note = f"has {count} frames, none without an image; min_frames {least} has no effect"
        assert (note in said.out + said.err) is (least > count)
