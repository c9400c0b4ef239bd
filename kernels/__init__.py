"""Warp kernels of scgs_warp: arrays in, arrays out. No torch, no allocation, no Python state.

Conventions, for every file of this folder:

- One file per stage of the pipeline, named after it; the torch op of the same name lives in ``scgs_warp/ops/``, its
  slow float64 twin in ``tests/reference/``.
- Frames: OpenCV cameras (x right, y down, z forward); ``viewmat`` is world-to-camera; quaternions are ``wxyz``.
  Pixel centres lie at +0.5. Images are planar, ``[C, H, W]``: a row of 16 pixels is one SIMD register.
- Every kernel's first argument is ``first: int``, the grid index at which this launch starts
  (``i = first + wp.tid()``). On a CPU ``scgs_warp.runtime.launch.launch`` splits one grid over threads with it;
  on CUDA it is 0. Kernels therefore use a one-dimensional grid.
- Arguments stand one to a line, grouped under ``# In:`` and ``# Out:``, named ``*_in`` and ``*_out``, with their shape
  in a comment. Inputs are never written. Each output element is written by exactly one grid index (no atomics), so
  the same inputs give the same bits whatever the number of threads.
- Adjoints are written by hand (``enable_backward`` is off): a kernel ``X`` has its adjoint in ``X_adjoint``, whose
  incoming gradients are named ``v_*_in`` and whose results ``v_*_out``.
"""
