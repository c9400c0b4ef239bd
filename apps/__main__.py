"""The console script: ``scgs-warp train ...`` is ``python apps/train.py ...``."""

from __future__ import annotations

import importlib
import sys

APPS = ("train", "evaluate", "view", "edit", "bench", "ablate", "synthesize", "capture", "export")


def main() -> int:
    arguments = sys.argv[1:]
    if arguments[:1] == ["--version"]:
        from scgs_warp import __version__

        print(f"scgs-warp {__version__}")
        return 0
    if not arguments or arguments[0] not in APPS:
        wanted = not arguments or arguments[0] in ("-h", "--help")
        print(
            f"usage: scgs-warp {{{','.join(APPS)}}} [options]; 'scgs-warp train --help' explains each option",
            file=sys.stdout if wanted else sys.stderr,
        )
        return 0 if wanted else 2
    app = importlib.import_module(f"scgs_warp.apps.{arguments[0]}")
    return app.cli(arguments[1:])


if __name__ == "__main__":
    sys.exit(main())
