"""Export a scene to formats of other programs: ``python apps/export.py --run runs/jj --output jj.glb``."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from scgs_warp.apps.arguments import parse
from scgs_warp.apps.cli import Device, prepare, run
from scgs_warp.export.request import ExportRequest, check_request


@dataclass(frozen=True)
class Options(ExportRequest):
    """Write a scene as a file that other programs open (docs/formats.md)."""

    device: Device = "auto"
    """Where to compute; auto takes a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all cores by default."""
    memory_gib: float | None = None
    """Limit on memory in GiB; by default all free memory. On a GPU it applies to the GPU's memory. Large images are
    drawn in bands, and an image that does not fit is refused with an error that names its size."""


def main(args: list[str] | None) -> None:
    options = parse(Options, "export", args)
    check_request(options)
    device = prepare(options.device, options.threads, options.memory_gib)

    from scgs_warp.export.run import export

    print(export(options, device))


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
