"""Check and measure everything that needs a GPU: agreement, the same bits, races, tests, timings beside gsplat's.

    python benchmarks/gpu_check.py --build-gsplat --data data/dnerf/lego     # all parts, about 25 minutes
    python benchmarks/gpu_check.py --seconds 580                             # a call that ends in time; repeat it
    python benchmarks/gpu_check.py --parts agreement,frame                   # some of the parts
    python benchmarks/gpu_check.py --device cpu --quick                      # the same logic, small, anywhere

Parts run in order of worth, each in a process of its own. The outcome is one JSON, which is written whole after every
part, and within those that take minutes. A later call at the same commit on the same GPU continues it: what has passed
or failed is not repeated, tests that have passed are not either, and training resumes.

The exit status is 0 if all parts have passed, 1 if one has failed, 3 if one is still to be run, and 2 for a mistake in
the call.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from pathlib import Path
from typing import Any

import scgs_warp  # noqa: F401  (sets the environment before torch is loaded)

import torch  # isort: skip
import gpu_agreement
import gpu_gsplat
import gpu_sanitizer
import gpu_speed
import gpu_tests
import gpu_training
import gpu_trust
from gpu_calls import Plan, end_with_parent, run_parts
from gpu_session import NOT_RUN, ROOT, Call, Part, Record, identity, run_part, setting

from scgs_warp.errors import UserError
from scgs_warp.runtime import environment
from scgs_warp.runtime.progress import say
from scgs_warp.runtime.provenance import commit

PARTS: dict[str, Part] = {
    "agreement": Part(gpu_agreement.agreement, 80.0),
    "bits": Part(gpu_agreement.bits, 70.0),
    "sanitizer": Part(gpu_sanitizer.sanitizer, 150.0),
    "tests": Part(gpu_tests.tests, 280.0, continues=True),
    "frame": Part(gpu_speed.frame, 40.0, timed=True),
    "step": Part(gpu_speed.step, 40.0, timed=True),
    "gsplat": Part(gpu_gsplat.gsplat, 60.0, timed=True),
    "paper": Part(gpu_training.paper, 150.0, continues=True, timed=True),
    "best": Part(gpu_training.best, 330.0, continues=True, timed=True),
    "forms": Part(gpu_speed.forms, 40.0, timed=True),
    "raster": Part(gpu_speed.raster, 30.0, timed=True),
    "fuzz": Part(gpu_trust.fuzz, 90.0),
    "crowded": Part(gpu_trust.crowded, 20.0),
    "share": Part(gpu_trust.share, 60.0),
}
NEED_A_GPU = ("sanitizer", "gsplat")
PRETENDED = "pretended"
"""Name of the device on which the tests run the GPU's code without a GPU."""
MEASURED = "gpu_check_cuda.json"
"""Name that only figures of a real GPU may have."""


def options_of(arguments: list[str]) -> argparse.Namespace:
    """Parse the command line.

    Raises:
        UserError: an unknown part, or no data.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--quick", action="store_true", help="small scenes and one test, to try the script itself")
    parser.add_argument("--parts", help=f"parts to run, of {','.join(PARTS)}; by default all that the device can run")
    parser.add_argument("--again", default="", help="parts to run although they have ended")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="duration of this call")
    parser.add_argument("--data", type=Path, help="data set of the parts that train; by default the built-in scene")
    parser.add_argument("--build-gsplat", action="store_true", help="compile gsplat in the background, in minutes")
    parser.add_argument(
        "--output", type=Path, help=f"JSON; by default benchmarks/results/{MEASURED}, without a GPU in runs/"
    )
    parser.add_argument("--work", type=Path, help="folder of runs to continue; by default runs/gpu_check-OUTPUT")
    parser.add_argument("--commit", help="commit of a copy that has no .git")
    parser.add_argument("--inside", help=argparse.SUPPRESS)
    parser.add_argument("--until", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    default = [name for name in PARTS if options.device == "cuda" or name not in NEED_A_GPU]
    options.parts = options.parts.split(",") if options.parts else default
    options.again = options.again.split(",") if options.again else []
    if unknown := [part for part in options.parts + options.again if part not in PARTS]:
        raise UserError(f"{', '.join(unknown)}: no such part; choose from {', '.join(PARTS)}")
    if options.data is not None and not options.data.is_dir():
        raise UserError(f"--data {options.data}: no such folder")
    return options


def gpu_of(device: str) -> str | None:
    """Return the name of the GPU.

    Raises:
        UserError: torch or Warp finds none.
    """
    if device == "cpu":
        return None
    if not torch.cuda.is_available():
        raise UserError("torch finds no GPU; use --device cpu --quick to try the script")
    if not environment.warp_finds_gpu():
        raise UserError("torch finds a GPU, but Warp does not: the NVIDIA driver must be of version 580 or newer")
    return torch.cuda.get_device_name()


def places(options: argparse.Namespace, gpu: str | None) -> tuple[Path, Path]:
    """Return the JSON file and the folder of files to continue with.

    Raises:
        UserError: the file has the name of measured figures, and there is nothing to measure.
    """
    real = gpu not in (None, PRETENDED) and not options.quick
    kind = PRETENDED if gpu == PRETENDED else options.device
    name = MEASURED if real else f"gpu_check_{kind}{'_quick' if options.quick else ''}.json"
    output = options.output or ROOT / ("benchmarks/results" if real else "runs") / name
    if output.name == MEASURED and not real:
        raise UserError(f"{output}: only figures of a real GPU at full size may have this name; give another --output")
    work = options.work or ROOT / "runs" / f"gpu_check-{output.stem}"
    output.parent.mkdir(parents=True, exist_ok=True)
    work.mkdir(parents=True, exist_ok=True)
    return output, work


def inside(options: argparse.Namespace) -> int:
    """Run one part in this process."""
    end_with_parent()
    environment.configure()
    record = Record.load(options.output)
    judged = record.content["gpu"] not in (None, PRETENDED)
    made = setting(options.device, options.quick, judged)
    call = Call(made, options.until, options.work, options.data, {}, lambda report: None)
    run_part(options.inside, PARTS[options.inside], record, call)
    return 0


def whole(options: argparse.Namespace, words: list[str]) -> int:
    """Run the parts that are still to be run."""
    deadline = time.time() + options.seconds
    gpu = gpu_of(options.device)
    output, work = places(options, gpu)
    record = Record.open(output, identity(options.commit or commit(), gpu, options.device, options.quick), say)
    for name in options.again:
        record.content["parts"].pop(name, None)
    if options.build_gsplat and "gsplat" in options.parts and record.state("gsplat") in (None, NOT_RUN):
        say(gpu_gsplat.start_build())
    inner: list[Any] = ["--device", options.device, "--output", output.resolve(), "--work", work.resolve()]
    inner += ["--quick"] if options.quick else []
    inner += ["--data", options.data.resolve()] if options.data else []
    chosen = {name: part for name, part in PARTS.items() if name in options.parts}
    blocked = gpu_gsplat.building if options.device == "cuda" else lambda: None
    run_parts(Plan(chosen, record, options.quick, deadline, [str(word) for word in inner], work, blocked))
    status = record.conclude(list(chosen))
    summary = {0: "all parts have passed", 1: "SOME PART HAS FAILED", 3: "some part is still to be run"}[status]
    say(f"{summary}: {output}")
    if any(record.state(name) not in ("passed", "failed") for name in chosen):
        say(f"continue with: python benchmarks/gpu_check.py {shlex.join(words)}".rstrip())
    return status


def main(arguments: list[str] | None = None) -> int:
    words = sys.argv[1:] if arguments is None else arguments
    try:
        options = options_of(words)
        return inside(options) if options.inside else whole(options, words)
    except UserError as error:
        print(f"gpu_check: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
