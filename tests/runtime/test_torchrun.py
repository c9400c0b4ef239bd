"""Rank of a process, read from what ``torchrun`` sets."""

from __future__ import annotations

import pytest

from scgs_warp.errors import UserError
from scgs_warp.runtime import torchrun


def test_rank_of_a_process(monkeypatch):
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "MASTER_ADDR"):
        monkeypatch.delenv(name, raising=False)
    assert torchrun.process_rank() is None and torchrun.process_label() == ""
    values = {"RANK": "3", "WORLD_SIZE": "8", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "2", "MASTER_ADDR": "localhost"}
    for name, value in values.items():
        monkeypatch.setenv(name, value)
    own = torchrun.process_rank()
    assert own == torchrun.ProcessRank(3, 8, 1, 2) and torchrun.process_label() == " (process 3 of 8)"
    monkeypatch.setattr(torchrun, "available_threads", lambda: 7)
    assert own.threads == 3
    monkeypatch.setattr(torchrun, "available_threads", lambda: 1)
    assert own.threads == 1
    for name, value in (("LOCAL_RANK", "2"), ("RANK", "8"), ("LOCAL_WORLD_SIZE", "two")):
        with monkeypatch.context() as patch, pytest.raises(UserError, match="torchrun"):
            patch.setenv(name, value)
            torchrun.process_rank()
    monkeypatch.delenv("LOCAL_RANK")
    with pytest.raises(UserError, match="LOCAL_RANK"):
        torchrun.process_rank()
