"""Benchmarks of a frame, a rasterisation, a training step, an edit and a pull.

``run`` measures a ``plan``, and ``scaling`` sweeps over sizes. ``workloads`` and ``editing`` define what is timed,
``scenes`` the synthetic scene, ``timing`` and ``memory`` how it is measured, ``roofline`` the least possible times, and
``gsplat`` compares with another renderer.
"""
