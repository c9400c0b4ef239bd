"""Permission of the operating system to use the tile registers of AMX."""

from __future__ import annotations

import pytest

from scgs_warp.runtime import matrix_tiles


class Kernel:
    """A system that lets every program use tiles."""

    @staticmethod
    def syscall(*arguments: int) -> int:
        assert arguments == (158, 0x1023, 18)
        return 0


def test_tiles_need_linux_on_x86(monkeypatch):
    monkeypatch.setattr(matrix_tiles.ctypes, "CDLL", lambda name: Kernel)
    monkeypatch.setattr(matrix_tiles.sys, "platform", "linux")
    monkeypatch.setattr(matrix_tiles.platform, "machine", lambda: "x86_64")
    assert matrix_tiles.may_use_tiles.__wrapped__() is True
    for name, value in (("platform", "darwin"), ("platform", "win32")):
        monkeypatch.setattr(matrix_tiles.sys, name, value)
        assert not matrix_tiles.may_use_tiles.__wrapped__()
    monkeypatch.setattr(matrix_tiles.sys, "platform", "linux")
    monkeypatch.setattr(matrix_tiles.platform, "machine", lambda: "aarch64")
    assert not matrix_tiles.may_use_tiles.__wrapped__()


@pytest.mark.parametrize("refused", [-1, None])
def test_tiles_need_permission(refused, monkeypatch):
    class Library:
        @staticmethod
        def syscall(*arguments: int) -> int:
            assert arguments == (158, 0x1023, 18)
            if refused is None:
                raise OSError
            return refused

    monkeypatch.setattr(matrix_tiles.sys, "platform", "linux")
    monkeypatch.setattr(matrix_tiles.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(matrix_tiles.ctypes, "CDLL", lambda name: Library)
    assert not matrix_tiles.may_use_tiles.__wrapped__()
