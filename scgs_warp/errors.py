"""What the user did wrong, said in one line; apps turn it into exit status 2."""

from __future__ import annotations


class UserError(Exception):
    """A mistake in the user's input: the message names the file, the field and the remedy, without a line break."""


def one_line(error: Exception) -> str:
    """What went wrong; of the system's errors the file and the reason."""
    if isinstance(error, OSError):
        return f"{error.filename or 'input or output'}: {error.strerror or error}"
    return " ".join(str(error).split())


class FrameError(UserError):
    """The pixels of a frame cannot be read any more. The step that asked for them has changed nothing."""
