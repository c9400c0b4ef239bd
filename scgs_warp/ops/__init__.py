"""Kernels as torch functions: arguments are validated here, once; one file for each stage."""
