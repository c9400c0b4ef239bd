"""Errors in the user's input, reported in one line; apps turn them into exit status 2."""

from __future__ import annotations

import os
import shlex

MAX_MESSAGE = 1000
"""Largest length of a message, limited because names and reasons in it may come from any file."""


class UserError(Exception):
    """A mistake in the user's input: the message names the file, the field and the remedy, in one line.

    Quoted text may come from a stranger's file: line breaks become spaces, and characters that a terminal might obey
    (escape sequences, marks of writing direction) are shown as Python escapes.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


def printable(text: object) -> str:
    """Return the text as one line of bounded length, without characters that a terminal might obey."""
    line = " ".join(str(text).split())
    if not line.isprintable():
        line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    return line if len(line) <= MAX_MESSAGE else f"{line[: MAX_MESSAGE // 2]} ... {line[-MAX_MESSAGE // 2 :]}"


def one_line(error: Exception) -> str:
    """Describe an error in one line; an operating system's error is described by file and reason."""
    if isinstance(error, OSError):
        return printable(f"{error.filename or 'input or output'}: {error.strerror or error}")
    return printable(error)


SHORTAGE = ("allocate memory", "out of memory", "failed to map segment", "can't start new thread")
"""Words of errors that mean a lack of memory."""


class FrameError(UserError):
    """Error that a frame's pixels can no longer be read. The training step that requested them has changed nothing."""


def is_shortage(error: BaseException) -> bool:
    """Return whether an error means that memory ran out: by its type (Python, NumPy), or by the message (PyTorch, the
    loader of libraries) of the error or its cause."""
    if isinstance(error, MemoryError):
        return True
    texts = [str(error), str(error.__cause__ or "")]
    return any(words in text for words in SHORTAGE for text in texts)


def shell_words(*words: object) -> str:
    """Return words, as paths, as they are written in a shell, for the commands in messages."""
    texts = [str(word) for word in words]
    if os.name == "nt":  # whose shells take quotes of another kind
        return " ".join(f'"{text}"' if " " in text else text for text in texts)
    return shlex.join(texts)
