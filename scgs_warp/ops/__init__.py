"""Torch functions that validate their arguments and launch the kernels, with one file per stage."""
