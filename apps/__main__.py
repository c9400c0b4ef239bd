"""Console script: ``scgs-warp train ...`` is ``python apps/train.py ...``."""

from __future__ import annotations

import difflib
import importlib
import sys

APPS = {
    "train": "reconstruct a scene from images",
    "evaluate": "score a run on held-out views",
    "view": "render a film of a scene",
    "edit": "move parts of a scene, in the browser or by script",
    "export": "write a scene for other programs, or as a web page",
    "capture": "make a data set from a video",
    "synthesize": "make a data set from an animated mesh",
    "config": "list the settings of training",
    "ablate": "compare settings in a table",
    "bench": "measure speed on this machine",
}
COMPLETION = "completion"
USAGE = """usage: scgs-warp COMMAND [options]

Reconstruct a moving scene from a video with known cameras, film it, and edit it.

{commands}

'scgs-warp COMMAND --help' explains the options of a command, 'scgs-warp completion bash|zsh|fish --install' lets the
shell complete them, 'scgs-warp --version' names the version. 'python -m scgs_warp' is the same program."""


def usage() -> str:
    return USAGE.format(commands="\n".join(f"  {name:11} {what}" for name, what in APPS.items()))


def main(arguments: list[str] | None = None) -> int:
    words = sys.argv[1:] if arguments is None else arguments
    if words[:1] in (["help"], ["-h"], ["--help"]):
        words = [words[1], "--help"] if words[1:] and words[1] in APPS else []
    if words[:1] in (["--version"], ["-V"], ["version"]):
        from scgs_warp import __version__

        print(f"scgs-warp {__version__}")
        return 0
    if not words:
        print(usage())
        return 0
    if words[0] == COMPLETION:
        from scgs_warp.apps import completion

        return completion.cli(words[1:])
    if words[0] not in APPS:
        near = difflib.get_close_matches(words[0], APPS, 1)
        hint = f"did you mean {near[0]}?" if near else f"give one of {', '.join(APPS)}"
        print(f"error: no command {words[0]!r}; {hint} ('scgs-warp --help' lists all)", file=sys.stderr)
        return 2
    app = importlib.import_module(f"scgs_warp.apps.{words[0]}")
    return app.cli(words[1:])


if __name__ == "__main__":
    sys.exit(main())
