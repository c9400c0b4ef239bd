"""Warp kernels of scgs_warp: arrays in, arrays out. No torch, no allocation, no Python state.

Forms
-----

A file is named after its stage of the pipeline. ``kernels/X.py`` is the portable form: plain Warp, the readable truth,
on any device. ``cpu/X.py`` is the form for CPUs, in SIMD, and ``cuda/X.py`` the one for CUDA, by warps or blocks of
threads; their C++ stands in ``native/``. A kernel has the same name in every form, and its adjoint ``X_adjoint``.

A CPU runs the cpu form where there is one, CUDA the cuda form; otherwise the portable form runs. Where torch is the
portable form, CUDA runs that. The torch op of a stage lives in ``scgs_warp/ops/``, its float64 reference in
``tests/reference/``. The last column names the tests that compare the forms, below ``tests/``; all run on a CPU.

===========  ===========  ================  ==================  ========================================
stage        portable     cpu               cuda                compared in
===========  ===========  ================  ==================  ========================================
projection   projection   projection                            kernels/test_projection
binning      binning      binning           binning             kernels/test_binning
                                                                kernels/cuda/test_binning
compositing  compositing  compositing       compositing         kernels/test_compositing
                                            compositing_blocks  kernels/cuda/test_compositing
                                            slots               kernels/cuda/test_compositing_emulated
neighbors    neighbors    neighbors         node_sums           kernels/test_neighbors
                          neighbor_lists                        kernels/cuda/test_node_sums
skinning     skinning     skinning          node_sums           kernels/test_skinning
                          skinning_adjoint                      kernels/cuda/test_node_sums
                          skinning_palette
harmonics    harmonics    harmonics                             kernels/test_harmonics
ssim         ssim         ssim                                  kernels/test_ssim
adam         adam         adam                                  kernels/test_adam
network      torch        network                               kernels/test_network
                          network_adjoint
roofline                  roofline                              benchmark/test_scaling
===========  ===========  ================  ==================  ========================================

- ``binning.py`` holds the geometry that both sorts share; ``cuda/binning.py`` is plain Warp, so it runs on a CPU too.
- ``cuda/compositing_blocks.py`` uses Warp's tile API instead of native code. It serves more channels than a gradient
  slot of ``cuda/compositing.py`` holds.
- ``cuda/node_sums.py`` replaces the sums by chunks in the adjoints of ``neighbors`` and ``skinning``.
- ``cpu/roofline.py`` measures the machine for benchmarks; it is no stage.
- All other stages have the portable form alone.

Conventions
-----------

- Frames: OpenCV cameras (x right, y down, z forward); ``viewmat`` is world-to-camera; quaternions are ``wxyz``.
  Pixel centres lie at +0.5. Images are planar, ``[C, H, W]``: a row of 16 pixels is one SIMD register.
- Every kernel's first argument is ``first: int``, the grid index at which this launch starts
  (``i = first + wp.tid()``). On a CPU ``scgs_warp.runtime.launch.launch`` splits one grid over threads with it;
  on CUDA it is 0. Kernels therefore use a one-dimensional grid.
- Arguments stand one to a line, grouped under ``# In:`` and ``# Out:``, named ``*_in`` and ``*_out``, with their shape
  in a comment. Inputs are never written. Each output element is written by exactly one grid index (no atomics), so
  the same inputs give the same bits whatever the number of threads.
- Adjoints are written by hand (``enable_backward`` is off); incoming gradients are named ``v_*_in``, results
  ``v_*_out``.
"""
