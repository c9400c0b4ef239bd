"""Lists of mutants: wrong changes of the code, each of which the tests should notice.

A list is a text file like a patch. ``== FILE`` begins the mutants of a source file, and ``tests: FILES`` names the
tests that should notice them. Lines that begin with ``-`` are the code, which occurs once in the file, and lines that
begin with ``+`` take its place. ``= TEXT`` after a mutant argues that it changes nothing (an equivalent), and
``# TEXT`` before a mutant says what it means.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

LISTS = Path(__file__).parent / "lists"


@dataclass(frozen=True)
class Mutant:
    """One change of one source file."""

    file: str
    """Path in the repository."""
    code: str
    wrong: str
    """Text that takes the place of ``code``."""
    tests: tuple[str, ...]
    """Paths of the tests that should notice it."""
    equivalent: str = ""
    """Why nothing changes; empty for a mutant that must be noticed."""

    @property
    def name(self) -> str:
        """A name that lasts as long as the mutant itself."""
        digest = hashlib.sha256(f"{self.file}\0{self.code}\0{self.wrong}".encode()).hexdigest()
        return f"{self.file}#{digest[:8]}"

    def apply(self, text: str) -> str:
        """Return the source with the change.

        Raises:
            ValueError: the code does not occur exactly once.
        """
        count = text.count(self.code)
        if count != 1:
            raise ValueError(f"{self.file}: occurs {count} times, not once:\n{self.code}")
        return text.replace(self.code, self.wrong)

    def line(self, text: str) -> int:
        """Return the number of the line at which the changed code begins."""
        return text[: text.index(self.code)].count("\n") + 1


class _Reader:
    """Reader of one list."""

    def __init__(self) -> None:
        self.mutants: list[Mutant] = []
        self._file, self._tests = "", ()
        self._code: list[str] = []
        self._wrong: list[str] = []

    def read(self, line: str) -> None:
        mark, rest = line[:1], line[1:]
        if mark == "-":
            if self._wrong:
                self._end()
            self._code.append(rest)
        elif mark == "+":
            self._wrong.append(rest)
        elif line.startswith("== "):
            self._end()
            self._file, self._tests = line[3:].strip(), ()
        elif line.startswith("tests:"):
            self._end()
            self._tests = tuple(line[6:].split())
        elif line.startswith("= "):
            self._end()
            self.mutants[-1] = replace(self.mutants[-1], equivalent=rest.strip())
        elif not line or mark == "#":
            self._end()
        else:
            raise ValueError(f"{line!r} begins with none of - + = == tests: #")

    def _end(self) -> None:
        if self._code:
            self.mutants.append(Mutant(self._file, "\n".join(self._code), "\n".join(self._wrong), self._tests))
        self._code, self._wrong = [], []

    def finish(self) -> list[Mutant]:
        self._end()
        return self.mutants


def read_list(path: Path) -> list[Mutant]:
    """Read the mutants of one list.

    Raises:
        ValueError: a line is none of a list.
    """
    reader = _Reader()
    for line in path.read_text(encoding="utf-8").splitlines():
        reader.read(line)
    return reader.finish()


def read_all() -> list[Mutant]:
    """Read the mutants of all lists, in order of the lists' names."""
    return [mutant for path in sorted(LISTS.glob("*.txt")) for mutant in read_list(path)]
