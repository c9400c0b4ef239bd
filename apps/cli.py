"""What every app shares: device and threads, one-line errors, exit status 2."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Literal

from scgs_warp import environment
from scgs_warp.errors import UserError, is_shortage

Device = Literal["auto", "cpu", "cuda"]


def choose_device(device: Device) -> str:
    """``auto`` takes a GPU where there is one.

    Raises:
        UserError: ``cuda`` was asked for and there is none.
    """
    import torch

    present = torch.cuda.is_available()
    if device == "cuda" and not present:
        raise UserError(
            "--device cuda: torch finds no CUDA GPU here; use --device cpu, or install a CUDA build of torch"
        )
    return "cuda" if present and device != "cpu" else "cpu"


def run(main: Callable[[list[str] | None], None], args: list[str] | None = None) -> int:
    """Run an app; a user's mistake becomes one line on stderr and status 2, Ctrl-C status 130."""
    try:
        main(args)
    except UserError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except OSError as error:
        if isinstance(error, BrokenPipeError):  # the reader (head, a pager) has seen enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        print(f"error: {error.filename or 'input or output'}: {error.strerror or error}", file=sys.stderr)
        return 2
    except (MemoryError, RuntimeError) as error:
        if not is_shortage(error):
            raise
        print("error: there is not enough memory for this; free some, or give less at once", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    return 0


def prepare(device: Device, threads: int | None) -> str:
    """Set threads and denormals before the first tensor operation, then choose the device."""
    if threads is not None and threads < 1:
        raise UserError(f"--threads {threads}: must be at least 1")
    environment.configure(threads)
    return choose_device(device)
