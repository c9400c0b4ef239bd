"""List the settings of training: name, default and meaning of every field that ``--set`` takes."""

from __future__ import annotations

import difflib
import json
import sys
import textwrap
from dataclasses import dataclass

import tyro

from scgs_warp.apps.arguments import parse
from scgs_warp.apps.cli import run
from scgs_warp.config.presets import PresetName

WIDTH = 100


@dataclass(frozen=True)
class Options:
    """List every field of the configuration, as train.py --set NAME=VALUE takes it."""

    words: tyro.conf.Positional[tuple[str, ...]] = ()
    """List only fields whose name or meaning contains one of these words."""
    list: bool = True
    """List the fields; this is all that the command does."""
    preset: PresetName = "cpu"
    """Preset whose values are shown as defaults."""


def main(args: list[str] | None) -> None:
    options = parse(Options, "config", args)

    from scgs_warp.config.listing import settings
    from scgs_warp.config.presets import preset
    from scgs_warp.errors import UserError

    rows = settings(preset(options.preset))
    wanted = [word.lower() for word in options.words]
    chosen = [row for row in rows if not wanted or any(word in f"{row.name} {row.meaning}".lower() for word in wanted)]
    if not chosen:
        near = difflib.get_close_matches(options.words[0], [row.name for row in rows], 1, 0.4)
        hint = f"; did you mean {near[0]}?" if near else "; 'scgs-warp config' lists all"
        raise UserError(f"config: no field has {' or '.join(options.words)} in its name or meaning{hint}")
    print(f"{len(chosen)} fields, with the values of --preset {options.preset}\n")
    for row in chosen:
        print(f"{row.name} = {json.dumps(row.default)}    ({row.values})")
        print(textwrap.fill(row.meaning, WIDTH, initial_indent="    ", subsequent_indent="    ") + "\n")


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
