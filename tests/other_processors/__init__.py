"""The CPU kernels on another processor: compiled for it by Clang, run as a program of its own, emulated where needed.

``plugin`` sends every launch of a SIMD form there, so that the tests of ``tests/kernels`` judge what comes back against
their float64 versions. ``program`` compiles a module and runs its kernels, ``driver.cc`` is the program's main
function, and ``memory`` copies what a launch reads and writes. ``tests/kernels/test_other_processors.py`` runs it all.
"""
