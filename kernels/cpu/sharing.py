"""Threads of a CPU that share the chunks of a grid (``native/sharing.h``), for ``scgs_warp.runtime.cpu_threads``."""

from __future__ import annotations

import warp as wp

from ..native import native_function

wp.set_module_options({"enable_backward": False})


@native_function("sharing.h")
def share_chunks(job: wp.array[wp.int64]): ...


@native_function("sharing.h")
def finish_chunks(job: wp.array[wp.int64]): ...


@native_function("sharing.h")
def serve_chunks(job: wp.array[wp.int64]): ...


@wp.kernel
def share_job(
    first: int,
    # In and out:
    job: wp.array[wp.int64],
):
    """Offer the chunks of a job, and run them with the helpers if enough of these are awake. Grid: 1."""
    share_chunks(job)


@wp.kernel
def finish_job(
    first: int,
    # In and out:
    job: wp.array[wp.int64],
):
    """Run the remaining chunks, and wait some microseconds for those of others. Grid: 1."""
    finish_chunks(job)


@wp.kernel
def serve_job(
    first: int,
    # In and out:
    job: wp.array[wp.int64],
):
    """Help with every job until none has come for a while. Grid: 1."""
    serve_chunks(job)
