"""Warp kernels of scgs_warp: arrays in, arrays out. No torch, no allocation, no Python state.

Forms
-----

A file is named after its stage of the pipeline. ``kernels/X.py`` is the portable form: plain Warp that runs on any
device and is the readable reference. ``cpu/X.py`` is the SIMD form for CPUs, and ``cuda/X.py`` is the form for CUDA,
which works by warps or blocks of threads; the C++ code of both is in ``native/``. A kernel that several forms share has
the same name in each, and the adjoint of kernel ``x`` is ``x_adjoint``. Other kernels exist in one form only: for
example, the CPU's ``skin_rbf`` does in one pass what ``rbf_weights`` and ``skin`` do in two, and its ``finish`` what
correctives, tints, shading and activations do in up to five.

A CPU runs the cpu form where there is one, and CUDA runs the cuda form where there is one; otherwise the portable form
runs. The portable form of the network and of activations is torch. The torch op of a stage is in ``scgs_warp/ops/``,
and its float64 reference is in ``tests/reference/``. The last column names the tests, below ``tests/``, that compare
the forms; all of them run on a CPU.

===========  ===========  ================  ==================  ========================================
stage        portable     cpu               cuda                compared in
===========  ===========  ================  ==================  ========================================
activations  torch        activations                           kernels/test_activations
projection   projection   projection                            kernels/test_projection
binning      binning      binning           binning             kernels/test_binning
                                                                kernels/cuda/test_binning
compositing  compositing  compositing       compositing         kernels/test_compositing
                                            compositing_blocks  kernels/cuda/test_compositing
                                            slots               kernels/cuda/test_compositing_emulated
neighbors    neighbors    neighbors         neighbors           kernels/test_neighbors
                          neighbor_lists    node_sums           kernels/cuda/test_neighbors
                                                                kernels/cuda/test_node_sums
skinning     skinning     skinning          node_sums           kernels/test_skinning
                          skinning_adjoint                      kernels/cuda/test_node_sums
                          skinning_palette
correctives  correctives  correctives                           kernels/test_correctives
shading      shading      shading                               kernels/test_shading
posing       posing       posing                                kernels/test_posing
                          finishing                             kernels/test_finishing
silhouette   silhouette   silhouette                            kernels/test_silhouette
harmonics    harmonics    harmonics         harmonics           kernels/test_harmonics
                                                                kernels/cuda/test_harmonics
ssim         ssim         ssim              ssim                kernels/test_ssim
                                                                kernels/cuda/test_ssim
adam         adam         adam                                  kernels/test_adam
             step_outcome                                       kernels/test_step_outcome
network      torch        network                               kernels/test_network
                          network_adjoint
                          network_pairs
                          network_parts
roofline                  roofline                              benchmark/test_scaling
sharing                   sharing                               runtime/test_launch
===========  ===========  ================  ==================  ========================================

- ``binning.py`` has no kernels: it holds the geometry that the sorts in ``cpu/`` and ``cuda/`` share.
  ``cuda/binning.py`` is plain Warp, so it runs on a CPU too.
- ``cuda/compositing_blocks.py`` uses Warp's tile API instead of native code. It takes over when there are more channels
  than a gradient slot of ``cuda/compositing.py`` holds.
- ``cuda/node_sums.py`` replaces the sums by chunks in the adjoints of ``neighbors`` and ``skinning``.
- ``cpu/roofline.py`` and ``cpu/sharing.py`` are not stages: one measures the machine for benchmarks, the other lets
  threads share the grid of any kernel.
- Every stage that the table does not list has a portable form only.

Conventions
-----------

- Frames: OpenCV cameras (x right, y down, z forward); ``viewmat`` is world-to-camera; quaternions are ``wxyz``.
  Pixel centres lie at +0.5. Images are planar, ``[C, H, W]``: SIMD registers load pixels that lie side by side.
- Every kernel's first argument is ``first: int``, the grid index at which this launch starts
  (``i = first + wp.tid()``). On a CPU ``scgs_warp.runtime.launch.launch`` uses it to split one grid over threads, which
  requires a one-dimensional grid. The exception are kernels that work by blocks of threads: their grid has the
  indices ``(block, lane)``, and ``first`` is the first block.
- Each argument has a line of its own, with its shape in a comment. Arguments are grouped under ``# In:`` and
  ``# Out:`` and named ``*_in`` and ``*_out``. Inputs are never written. Each output element is written by exactly one
  grid index, so the results do not depend on the number of threads. The one atomic operation is a minimum of integers
  (``step_outcome.judge_gradients``), which does not depend on the order either.
- Adjoints are written by hand (``enable_backward`` is off); incoming gradients are named ``v_*_in``, results
  ``v_*_out``.
"""
