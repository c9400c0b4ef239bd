"""Completion of commands and options in bash, zsh and fish; tyro writes the scripts."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from scgs_warp.apps.arguments import parse
from scgs_warp.apps.cli import run

Shell = Literal["bash", "zsh", "fish"]
PROGRAM = "scgs-warp"
ZSH_FOLDER = ".zfunc"


@dataclass(frozen=True)
class Options:
    """Print the completion script of a shell, or install it for this user."""

    shell: tyro.conf.Positional[Shell]
    """Shell: bash, zsh or fish."""
    install: bool = False
    """Write the script to the place from which the shell loads it, instead of printing it."""


def commands() -> dict[str, Any]:
    """Return the options of every command."""
    from scgs_warp.apps.__main__ import APPS

    found: dict[str, Any] = {}
    for name in APPS:
        app = importlib.import_module(f"scgs_warp.apps.{name}")
        several = getattr(app, "COMMANDS", None)
        found[name] = typing.Union[tuple(several.values())] if several else app.Options  # noqa: UP007
    return found


def script(shell: Shell) -> str:
    """Return the completion script."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(commands(), prog=PROGRAM, args=["--tyro-print-completion", shell])
    return printed.getvalue()


def place(shell: Shell, home: Path) -> Path:
    """Return the file from which the shell loads the completion of this program for a user."""
    data = Path(os.environ.get("XDG_DATA_HOME") or home / ".local/share")
    config = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
    return {
        "bash": data / "bash-completion/completions" / PROGRAM,
        "zsh": home / ZSH_FOLDER / f"_{PROGRAM}",
        "fish": config / "fish/completions" / f"{PROGRAM}.fish",
    }[shell]


def install(shell: Shell, home: Path) -> list[str]:
    """Write the script and, for zsh, the two lines that load it; return what was done."""
    path = place(shell, home)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(script(shell), encoding="utf-8")
    done = [f"{path}: written; a new {shell} completes {PROGRAM}"]
    if shell == "zsh":
        settings = Path(os.environ.get("ZDOTDIR") or home) / ".zshrc"
        before = settings.read_text(encoding="utf-8") if settings.is_file() else ""
        if ZSH_FOLDER not in before:
            lines = f"fpath=(~/{ZSH_FOLDER} $fpath)\nautoload -Uz compinit && compinit\n"
            settings.write_text(
                before + ("" if before.endswith("\n") or not before else "\n") + lines, encoding="utf-8"
            )
            done.append(f"{settings}: two lines added, which load it")
    return done


def main(args: list[str] | None) -> None:
    options = parse(Options, "completion", args)
    print("\n".join(install(options.shell, Path.home())) if options.install else script(options.shell))


def cli(args: list[str] | None = None) -> int:
    return run(main, args)
