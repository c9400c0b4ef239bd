"""What the user did wrong, said in one line; apps turn it into exit status 2."""

from __future__ import annotations

LONGEST = 1000
"""Letters of a message: names and reasons in it may come from anywhere."""


class UserError(Exception):
    """A mistake in the user's input: the message names the file, the field and the remedy, in one line.

    What it quotes may come from a stranger's file: line breaks become spaces, and what a terminal might obey
    (escape sequences, marks that turn the direction of writing) is shown as Python would write it.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


def printable(text: object) -> str:
    """In one line of a bearable length, without what a terminal might obey."""
    line = " ".join(str(text).split())
    if not line.isprintable():
        line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"


def one_line(error: Exception) -> str:
    """What went wrong; of the system's errors the file and the reason."""
    if isinstance(error, OSError):
        return printable(f"{error.filename or 'input or output'}: {error.strerror or error}")
    return printable(error)


class FrameError(UserError):
    """The pixels of a frame cannot be read any more. The step that asked for them has changed nothing."""


def is_shortage(error: BaseException) -> bool:
    """Whether it says that there is no more memory: Python and NumPy have an error for it, PyTorch has a text."""
    return isinstance(error, MemoryError) or "allocate memory" in str(error) or "out of memory" in str(error)
