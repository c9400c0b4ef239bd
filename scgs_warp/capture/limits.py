"""Limits of the settings that captures of a video and of a rig have in common."""

from __future__ import annotations

from typing import Protocol

from ..errors import UserError


class CommonSettings(Protocol):
    """Settings of a capture."""

    @property
    def size(self) -> int: ...

    @property
    def fov(self) -> float | None: ...

    @property
    def features(self) -> int: ...

    @property
    def least(self) -> float: ...

    @property
    def seed(self) -> int: ...


def check_limits(request: CommonSettings) -> None:
    """Check the common values of a request.

    Raises:
        UserError: naming the option, its value and the remedy.
    """
    if not 64 <= request.size <= 8192:
        raise UserError(f"--size {request.size}: give 64 to 8192 pixels")
    if request.fov is not None and not 5.0 <= request.fov <= 170.0:
        raise UserError(f"--fov {request.fov:g}: give 5 to 170 degrees")
    if not 64 <= request.features <= 32768:
        raise UserError(f"--features {request.features}: give 64 to 32768")
    if not 0.0 <= request.least <= 1.0:
        raise UserError(f"--least {request.least:g}: give a share from 0 to 1")
    if not 0 <= request.seed < 2**31:
        raise UserError(f"--seed {request.seed}: give 0 or more")
