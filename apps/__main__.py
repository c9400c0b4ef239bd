"""Console script: ``scgs-warp train ...`` is ``python apps/train.py ...``."""

from __future__ import annotations

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
    "ablate": "compare settings in a table",
    "bench": "measure speed on this machine",
}


def main(arguments: list[str] | None = None) -> int:
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == ["--version"]:
        from scgs_warp import __version__

        print(f"scgs-warp {__version__}")
        return 0
    if not arguments or arguments[0] not in APPS:
        if arguments and arguments[0] not in ("-h", "--help"):
            print(f"error: no command {arguments[0]!r}; give one of {', '.join(APPS)}", file=sys.stderr)
            return 2
        print("usage: scgs-warp COMMAND [options]; 'scgs-warp COMMAND --help' explains its options\n")
        print("\n".join(f"  {name:11} {what}" for name, what in APPS.items()))
        return 0
    app = importlib.import_module(f"scgs_warp.apps.{arguments[0]}")
    return app.cli(arguments[1:])


if __name__ == "__main__":
    sys.exit(main())
